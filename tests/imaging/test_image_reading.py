"""Image files: each kind comes back as it is; bad ones get one line and nothing on stderr."""

import io
import math
import os
import re
import struct
import sys
import zlib
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from heliotrope.errors import FormatError, InputError
from heliotrope.imaging.files import find_images, read_image, write_image
from heliotrope.imaging.frame import Frame

_SECOND = 1.0 / math.sqrt(12.0)


def _scene(shape: tuple[int, ...] = (60, 80, 3)) -> np.ndarray[Any, np.dtype[np.uint8]]:
    noise = np.random.default_rng(5).integers(0, 256, shape, dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0), dtype=np.uint8)


COLOUR = _scene()
GREY = np.ascontiguousarray(COLOUR[:, :, 0])
DEEP = COLOUR.astype(np.uint16) * 257 + 3


def _encode(suffix: str, pixels: np.ndarray[Any, Any]) -> bytes:
    done, data = cv2.imencode(suffix, pixels)
    assert done
    return bytes(data.tobytes())


def _chunk(kind: bytes, body: bytes) -> bytes:
    tail = struct.pack(">I", zlib.crc32(kind + body))
    return struct.pack(">I", len(body)) + kind + body + tail


def _png(colour: int, bits: int, size: tuple[int, int], rows: bytes, *extra: bytes) -> bytes:
    head = struct.pack(">IIBBBBB", *size, bits, colour, 0, 0, 0)
    chunks = [_chunk(b"IHDR", head), *extra, _chunk(b"IDAT", zlib.compress(rows))]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks) + _chunk(b"IEND", b"")


def _ifd(order: str, entries: dict[int, tuple[int, list[Any]]], base: int) -> bytes:
    """Write a TIFF directory at ``base`` with its long values behind it."""
    head, behind = struct.pack(order + "H", len(entries)), b""
    end = base + 2 + 12 * len(entries) + 4
    for tag, (kind, values) in sorted(entries.items()):
        form = {2: f"{len(values[0])}s" if kind == 2 else "", 3: "H", 4: "I", 5: "II"}[kind]
        count = len(values[0]) if kind == 2 else len(values) // (2 if kind == 5 else 1)
        flat = struct.pack(order + (form if kind == 2 else form[0] * len(values)), *values)
        if len(flat) > 4:
            value = struct.pack(order + "I", end + len(behind))
            behind += flat
        else:
            value = flat.ljust(4, b"\0")
        head += struct.pack(order + "HHI", tag, kind, count) + value
    return head + bytes(4) + behind


def _tiff(pixels: bytes, order: str = "<", **change: Any) -> bytes:
    """Write a TIFF of 32 × 20 pixels in one strip."""
    tags: dict[int, tuple[int, list[Any]]] = {
        256: (3, [32]), 257: (3, [20]), 258: (3, [8]), 259: (3, [1]), 262: (3, [1]),
        273: (4, [0]), 277: (3, [1]), 278: (3, [20]), 279: (4, [len(pixels)]), 339: (3, [1]),
    }  # fmt: skip
    for name, value in change.items():
        tags[int(name[1:])] = (3, value)
    tags[273] = (4, [8 + len(_ifd(order, tags, 8))])
    mark = b"II*\0" if order == "<" else b"MM\0*"
    return mark + struct.pack(order + "I", 8) + _ifd(order, tags, 8) + pixels


def _exif(order: str, original: str, **more: tuple[int, list[Any]]) -> bytes:
    inner: dict[int, tuple[int, list[Any]]] = {0x9003: (2, [original.encode() + b"\0"])}
    inner |= {int(name[1:], 16): entry for name, entry in more.items()}
    outer = {0x0112: (3, [6]), 0x8769: (4, [0])}
    start = 8 + len(_ifd(order, outer, 8))
    outer[0x8769] = (4, [start])
    mark = b"II*\0" if order == "<" else b"MM\0*"
    return mark + struct.pack(order + "I", 8) + _ifd(order, outer, 8) + _ifd(order, inner, start)


def _with_exif(jpeg: bytes, exif: bytes) -> bytes:
    body = b"Exif\0\0" + exif
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


RAMP = bytes(range(32)) * 20
ROWS = b"".join(b"\0" + bytes(range(32)) for _ in range(20))
SCAN = b"\xff\xda"


# -- good images -----------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp"])
@pytest.mark.parametrize("pixels", [COLOUR, GREY], ids=["colour", "grey"])
def test_what_loses_nothing_comes_back_equal(
    suffix: str, pixels: np.ndarray[Any, Any], tmp_path: Path
) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(_encode(suffix, pixels))
    frame = read_image(path)
    assert np.array_equal(frame.pixels, pixels)
    assert frame.name == str(path)
    assert frame.time is None
    assert math.isnan(frame.time_deviation)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("pixels", [DEEP, DEEP[:, :, 1]], ids=["colour", "grey"])
def test_sixteen_bits_stay(suffix: str, pixels: np.ndarray[Any, Any], tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(_encode(suffix, np.ascontiguousarray(pixels)))
    frame = read_image(path)
    assert frame.pixels.dtype == np.uint16
    assert np.array_equal(frame.pixels, pixels)


@pytest.mark.parametrize("suffix", [".jpg", ".webp"])
def test_what_loses_little_comes_back_alike(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(_encode(suffix, COLOUR))
    found = read_image(path).pixels
    assert found.shape == COLOUR.shape
    assert np.abs(found.astype(float) - COLOUR).mean() < 4.0


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".webp"])
def test_alpha_is_dropped_and_changes_no_colour(suffix: str, tmp_path: Path) -> None:
    alpha = np.full((60, 80, 1), 7, dtype=np.uint8)
    path = tmp_path / f"a{suffix}"
    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else []
    _, data = cv2.imencode(suffix, np.dstack([COLOUR, alpha]), options)
    path.write_bytes(data.tobytes())
    found = read_image(path).pixels
    assert found.shape == (60, 80, 3)
    assert np.abs(found.astype(float) - COLOUR).max() == 0.0


def test_alpha_of_a_tiff_is_not_multiplied_in(tmp_path: Path) -> None:
    four = np.random.default_rng(2).integers(0, 256, (20, 32, 4), dtype=np.uint8)
    path = tmp_path / "a.tif"
    path.write_bytes(_tiff(four.tobytes(), t258=[8] * 4, t262=[2], t277=[4], t338=[2]))
    assert np.array_equal(read_image(path).pixels, four[:, :, 2::-1])


def test_palette_one_bit_and_grey_with_alpha(tmp_path: Path) -> None:
    palette = _chunk(b"PLTE", bytes(range(96)))
    cases = {
        "palette": (_png(3, 8, (32, 20), ROWS, palette, _chunk(b"tRNS", bytes(32))), [5, 4, 3]),
        "one": (_png(0, 1, (32, 20), (b"\0" + b"\x40" * 4) * 20), 255),
        "alpha": (_png(4, 8, (16, 20), ROWS), [2, 2, 2]),
    }
    for name, (data, wanted) in cases.items():
        path = tmp_path / f"{name}.png"
        path.write_bytes(data)
        frame = read_image(path)
        assert frame.pixels.dtype == np.uint8
        assert frame.pixels[3, 1].tolist() == wanted, name
    path = tmp_path / "one.tif"
    path.write_bytes(_tiff(b"\x40" * 80, t258=[1]))
    assert read_image(path).pixels[0, :3].tolist() == [0, 255, 0]


def test_the_sensors_orientation_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(_with_exif(_encode(".jpg", COLOUR), _exif(">", "2023:05:13 15:53:57")))
    assert cv2.imread(str(path)).shape == (80, 60, 3)  # what OpenCV does by itself
    assert read_image(path).pixels.shape == COLOUR.shape
    for order in "<>":
        path.write_bytes(_tiff(RAMP, order, t274=[3]))
        assert read_image(path).pixels[0, :3].tolist() == [0, 1, 2]


def test_the_content_counts_and_not_the_suffix(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(_encode(".png", COLOUR))
    assert np.array_equal(read_image(path).pixels, COLOUR)


def test_harmless_faults_are_no_reason_to_refuse(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.png"
    profile = _chunk(b"iCCP", b"x\0\0garbage")
    path.write_bytes(_png(0, 8, (32, 20), ROWS, profile) + b"behind it")
    assert np.array_equal(read_image(path).pixels, np.frombuffer(RAMP, np.uint8).reshape(20, 32))
    path.write_bytes(PNG[:8] + _chunk(b"IDAT", b"") + PNG[8:])
    assert np.array_equal(read_image(path).pixels, COLOUR)
    path.write_bytes(JPEG)
    jpeg = read_image(path).pixels
    for data in (JPEG[:-2] + b"\xff\xff\xff\xd9behind it", JPEG[:20] + b"x" + JPEG[20:]):
        path.write_bytes(data)
        assert np.array_equal(read_image(path).pixels, jpeg)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("quality", [30, 75, 95])
@pytest.mark.parametrize("level", [0, 7, 255])
def test_a_scene_without_light_or_with_too_much_is_no_torn_jpeg(
    level: int, quality: int, tmp_path: Path
) -> None:
    path = tmp_path / "a.jpg"
    for pixels in (_scene((240, 320, 3)), _scene((240, 320))):
        pixels[80:] = level
        for more in ([], [cv2.IMWRITE_JPEG_OPTIMIZE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 7]):
            done, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality, *more])
            assert done
            path.write_bytes(data.tobytes())
            assert read_image(path).pixels.shape == pixels.shape


@pytest.mark.parametrize("orientation", range(1, 9))
def test_sixteen_bits_of_colour_keep_the_sensors_orientation(
    orientation: int, tmp_path: Path
) -> None:
    deep = np.random.default_rng(4).integers(0, 2**16, (20, 32, 3), dtype=np.uint16)
    path = tmp_path / "a.tif"
    path.write_bytes(_tiff(deep.tobytes(), t258=[16] * 3, t262=[2], t277=[3], t274=[orientation]))
    assert np.array_equal(read_image(path).pixels, deep[:, :, ::-1])
    path.write_bytes(_tiff(RAMP, t274=[orientation]))
    assert np.array_equal(read_image(path).pixels, np.frombuffer(RAMP, np.uint8).reshape(20, 32))


def test_a_smaller_version_is_no_second_page(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(PAGES + _ifd("<", {254: (4, [1])}, len(TIFF)))
    assert read_image(path).size == (32, 20)


# -- bad input -------------------------------------------------------------------------


def _flip(data: bytes, *places: int) -> bytes:
    changed = bytearray(data)
    for place in places:
        changed[place] ^= 0x5A
    return bytes(changed)


def _middle(data: bytes) -> bytes:
    """Return a JPEG without the middle of its scan."""
    start = data.index(SCAN) + 40
    return data[:start] + data[-2:]


def _cmyk(data: bytes) -> bytes:
    at = data.index(b"\xff\xc0")
    return data[: at + 9] + b"\4" + data[at + 10 :]


def _animated() -> bytes:
    stream = io.BytesIO()
    frames = [Image.fromarray(COLOUR), Image.fromarray(COLOUR[::-1])]
    frames[0].save(stream, "WEBP", save_all=True, append_images=frames[1:])
    return stream.getvalue()


def _huge(data: bytes) -> bytes:
    """Return a PNG whose header alone states 100 megapixels."""
    head = struct.pack(">IIBBBBB", 10_000, 10_000, 8, 2, 0, 0, 0)
    return data[:8] + _chunk(b"IHDR", head) + data[33:]


PNG, JPEG, TIFF = _encode(".png", COLOUR), _encode(".jpg", COLOUR), _tiff(RAMP)
#: Colour that is hidden by its alpha.
CLEAR = np.dstack([COLOUR, np.zeros(COLOUR.shape[:2], COLOUR.dtype)])
BMP, WEBP = _encode(".bmp", COLOUR), _encode(".webp", COLOUR)
PAGES = TIFF[:130] + struct.pack("<I", len(TIFF)) + TIFF[134:]
BAD: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "the file is empty; use an image (PNG, JPEG, TIFF, BMP or WebP)"),
    "text": (b"not an image at all", "not a supported image format; use a PNG"),
    "gif": (b"GIF89a" + bytes(50), "this is a GIF file; convert it to a PNG"),
    "pdf": (b"%PDF-1.7", "this is a PDF file"),
    "heic": (b"\0\0\0\x18ftypheic", "this is an AVIF, a HEIC or a video file"),
    "png start": (PNG[:12], "this PNG is truncated: it ends after 12 bytes"),
    "png half": (PNG[: len(PNG) // 2], "this PNG is truncated: it ends after 3786 bytes"),
    "png no end": (PNG[:-12], f"is truncated: it ends after {len(PNG) - 12} bytes"),
    "png damaged": (_flip(PNG, 500), "this PNG is damaged (broken PNG file (bad header checksum"),
    "png few rows": (_png(0, 8, (32, 20), ROWS[:300]), "this PNG is truncated"),
    "png text": (PNG[:33] + _flip(_chunk(b"tEXt", b"a\0b"), -1) + PNG[33:], "PNG is damaged"),
    "png small": (
        _png(0, 8, (15, 20), ROWS), "15 × 20 px; an image must have at least 16 × 16 px"
    ),
    "png huge": (
        _huge(PNG), "10000 × 10000 px are 100 million, above the limit of 64 million; reduce"
    ),
    "png animated": (
        _png(0, 8, (32, 20), ROWS, _chunk(b"acTL", bytes(8))), "this PNG is animated"
    ),
    "png transparent": (_encode(".png", CLEAR), "every pixel is transparent, so the image"),
    "jpeg half": (JPEG[: len(JPEG) // 2], "this JPEG is truncated: it ends after 1031 bytes"),
    "jpeg start": (JPEG[:30], "this JPEG is truncated: it ends after 30 bytes"),
    "jpeg no end": (JPEG[:-2], "this JPEG is truncated"),
    "jpeg header only": (JPEG[: JPEG.index(SCAN)] + b"\xff\xd9", "JPEG is damaged (cannot load"),
    "jpeg middle": (_middle(JPEG), "this JPEG is damaged: part of its scan is missing"),
    "jpeg grey middle": (_middle(_encode(".jpg", GREY)), "part of its scan is missing"),
    "jpeg cmyk": (_cmyk(JPEG), "its colours are CMYK; convert the image to RGB or grey"),
    "jpeg twelve": (
        JPEG.replace(b"\xff\xc0\x00\x11\x08", b"\xff\xc0\x00\x11\x0c"),
        "cannot be read (cannot handle 12-bit layers); convert it to a PNG",
    ),
    "tiff half": (TIFF[:-200], f"is truncated: it ends after {len(TIFF) - 200} bytes"),
    "tiff start": (TIFF[:60], "this TIFF is damaged"),
    "tiff pages": (
        PAGES + _ifd("<", {254: (4, [0])}, len(TIFF)), "this TIFF has several pages"
    ),
    "tiff cmyk": (_tiff(RAMP * 4, t258=[8] * 4, t262=[5], t277=[4]), "its colours are CMYK"),
    "tiff float": (_tiff(RAMP * 4, t258=[32], t339=[3]), "its pixels are 32-bit floats"),
    "tiff signed": (_tiff(RAMP * 2, t258=[16], t339=[2]), "pixels of 16 bits, format 2; convert"),
    "tiff lab": (_tiff(RAMP * 3, t258=[8] * 3, t262=[8], t277=[3]), "3 channels, 8;"),
    "tiff no strips": (_tiff(RAMP, t279=[1, 2]), "its TIFF directory lists no strips"),
    "bigtiff": (b"II+\0" + bytes(40), "this is a BigTIFF file; convert it"),
    "bmp half": (BMP[: len(BMP) // 2], "this BMP is truncated"),
    "bmp old": (BMP[:14] + struct.pack("<I", 12) + BMP[18:], "this BMP cannot be read (Unsupp"),
    "webp half": (WEBP[: len(WEBP) // 2], "this WebP is damaged ("),
    "webp animated": (
        _animated(), "this WebP is animated; save one of its frames"
    ),
    "webp none": (b"RIFF" + struct.pack("<I", 4) + b"WEBP", "this WebP is damaged ("),
    "wave": (b"RIFF" + struct.pack("<I", 36) + b"WAVEfmt ", "this is a RIFF file but not WebP"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_files_get_one_line(
    case: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.png"
    path.write_bytes(BAD[case][0])
    with pytest.raises(FormatError, match=re.escape(BAD[case][1])) as error:
        read_image(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)
    written = capfd.readouterr()
    assert (written.out, written.err) == ("", "")


def test_bad_places_get_one_line(tmp_path: Path) -> None:
    link, pipe = tmp_path / "link.png", tmp_path / "pipe.png"
    link.symlink_to(tmp_path / "gone.png")
    os.mkfifo(pipe)
    cases: dict[Path, str] = {
        tmp_path: "this is a folder; specify an image file",
        tmp_path / "none.png": "no such file",
        link: f"a link to {tmp_path / 'gone.png'}, which does not exist",
        pipe: "this is a device or a pipe",
        tmp_path / ("x" * 300): "cannot be read (File name too long)",
    }
    for path, text in cases.items():
        with pytest.raises(FormatError, match=re.escape(text)):
            read_image(path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(PNG)
    path.chmod(0)
    with pytest.raises(FormatError, match="Permission denied"):
        read_image(path)


def test_the_limit_is_an_argument(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(PNG)
    assert read_image(path, limit=60 * 80).size == (80, 60)
    with pytest.raises(FormatError, match=r"above the limit of 0\.0048 million"):
        read_image(path, limit=60 * 80 - 1)
    path.write_bytes(PNG + bytes(2**24 + 8 * 4800))
    with pytest.raises(FormatError, match=r"MiB are more than an image of 0\.0048 million pixels"):
        read_image(path, limit=4800)


@pytest.mark.parametrize(
    "data", [PNG, JPEG, TIFF, BMP, WEBP], ids=["png", "jpg", "tif", "bmp", "webp"]
)
def test_any_damage_is_refused_or_read_but_never_worse(
    data: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(11)
    path = tmp_path / "a"
    for k in range(40):
        changed = bytearray(data[: rng.integers(1, len(data))] if k % 2 else data)
        for place in rng.integers(0, min(len(changed), 150), 4):
            changed[place] = rng.integers(256)
        path.write_bytes(changed)
        with suppress(FormatError):
            read_image(path)
    assert capfd.readouterr().err == ""


# -- times -----------------------------------------------------------------------------


def test_exif_time_with_its_offset(tmp_path: Path) -> None:
    more: dict[str, tuple[int, list[Any]]] = {
        "t9011": (2, [b"+02:00\0"]),
        "t829a": (5, [1, 250]),
        "t8827": (3, [400]),
    }
    path = tmp_path / "20200101_000000Z.jpg"
    for order in "<>":
        path.write_bytes(_with_exif(JPEG, _exif(order, "2023:05:13 15:53:57", **more)))
        frame = read_image(path)
        assert frame.time == datetime(2023, 5, 13, 13, 53, 57, tzinfo=UTC)
        assert frame.time_deviation == pytest.approx(_SECOND)
        assert (frame.exposure, frame.gain) == (1 / 250, 4.0)
    fraction = _exif("<", "2023:05:13 15:53:57", **more, t9291=(2, [b"25\0"]))
    path.write_bytes(_with_exif(JPEG, fraction))
    frame = read_image(path)
    assert frame.time == datetime(2023, 5, 13, 13, 53, 57, 250_000, tzinfo=UTC)
    assert frame.time_deviation == pytest.approx(0.01 * _SECOND)


def test_a_time_without_a_zone_is_not_guessed(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(_with_exif(JPEG, _exif("<", "2023:05:13 15:53:57")))
    assert read_image(path).time is None
    zone = timezone(timedelta(hours=2))
    assert read_image(path, zone=zone).time == datetime(2023, 5, 13, 13, 53, 57, tzinfo=UTC)
    for nonsense in ("0000:00:00 00:00:00", "2023:13:13 15:53:57", "13 May"):
        path.write_bytes(_with_exif(JPEG, _exif("<", nonsense)))
        assert read_image(path, zone=zone).time is None


def test_exif_of_other_containers(tmp_path: Path) -> None:
    exif = _exif("<", "2023:05:13 15:53:57", t9011=(2, [b"Z\0\0\0"]))
    path = tmp_path / "a"
    path.write_bytes(_png(0, 8, (32, 20), ROWS, _chunk(b"eXIf", exif)))
    wanted = datetime(2023, 5, 13, 15, 53, 57, tzinfo=UTC)
    assert read_image(path).time == wanted
    canvas = b"\x08" + bytes(3) + (79).to_bytes(3, "little") + (59).to_bytes(3, "little")
    body = (
        b"VP8X"
        + struct.pack("<I", 10)
        + canvas
        + WEBP[12:]
        + b"EXIF"
        + struct.pack("<I", len(exif))
        + exif
        + bytes(len(exif) % 2)
    )
    path.write_bytes(b"RIFF" + struct.pack("<I", len(body) + 4) + b"WEBP" + body)
    assert read_image(path).time == wanted


def test_times_of_a_png(tmp_path: Path) -> None:
    changed = _chunk(b"tIME", struct.pack(">HBBBBB", 2024, 1, 2, 3, 4, 5))
    path = tmp_path / "a.png"
    path.write_bytes(_png(0, 8, (32, 20), ROWS, changed))
    assert read_image(path).time == datetime(2024, 1, 2, 3, 4, 5, tzinfo=UTC)
    named = tmp_path / "x_20230513_155357Z.png"
    named.write_bytes(path.read_bytes())
    assert read_image(named).time == datetime(2023, 5, 13, 15, 53, 57, tzinfo=UTC)
    for text in (b"Sat, 13 May 2023 17:53:57 +0200", b"2023-05-13T15:53:57Z"):
        extra = _chunk(b"tEXt", b"Creation Time\0" + text)
        path.write_bytes(_png(0, 8, (32, 20), ROWS, changed, extra))
        assert read_image(path).time == datetime(2023, 5, 13, 15, 53, 57, tzinfo=UTC)
    path.write_bytes(_png(0, 8, (32, 20), ROWS, _chunk(b"tEXt", b"Creation Time\0yesterday")))
    assert read_image(path).time is None


@pytest.mark.parametrize(
    ("name", "wanted", "unit"),
    [
        ("2023-05-13T15-53-57Z", "2023-05-13T15:53:57+00:00", 1.0),
        ("20230513_155357Z_flux", "2023-05-13T15:53:57+00:00", 1.0),
        ("cam1_20230513T155357.25Z", "2023-05-13T15:53:57.250000+00:00", 0.01),
        ("20230513-155357+0200", "2023-05-13T15:53:57+02:00", 1.0),
        ("20230513_155357", None, math.nan),
        ("20230513_155357-0001", None, math.nan),
        ("20231513_155357Z", None, math.nan),
        ("120230513_155357Z", None, math.nan),
        ("img_0042", None, math.nan),
    ],
)
def test_times_in_names(name: str, wanted: str | None, unit: float, tmp_path: Path) -> None:
    path = tmp_path / f"{name}.png"
    path.write_bytes(PNG)
    frame = read_image(path)
    assert (frame.time.isoformat() if frame.time else None) == wanted
    assert frame.time_deviation == pytest.approx(unit * _SECOND, nan_ok=True)


def test_the_time_of_the_file_only_when_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(PNG)
    os.utime(path, (1_700_000_000, 1_700_000_000))
    assert read_image(path).time is None
    frame = read_image(path, mtime=True)
    assert frame.time == datetime.fromtimestamp(1_700_000_000, UTC)
    assert math.isnan(frame.time_deviation)


# -- writing and finding ---------------------------------------------------------------


def test_a_png_gives_back_the_whole_frame(tmp_path: Path) -> None:
    time = datetime(2023, 5, 13, 15, 53, 57, 123_456, tzinfo=timezone(timedelta(hours=2)))
    frame = Frame(DEEP, "x", time, 0.004, 0.0025, 2.0, 8)
    write_image(frame, tmp_path / "a.png")
    found = read_image(tmp_path / "a.png")
    assert np.array_equal(found.pixels, DEEP)
    assert (found.time, found.time_deviation) == (time, 0.004)
    assert (found.exposure, found.gain, found.count) == (0.0025, 2.0, 8)
    assert np.array_equal(cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED), DEEP)


def test_pixels_are_written_in_each_format(tmp_path: Path) -> None:
    for suffix in (".tif", ".TIFF", ".png"):
        write_image(DEEP, tmp_path / f"a{suffix}")
        assert np.array_equal(read_image(tmp_path / f"a{suffix}").pixels, DEEP)
    write_image(COLOUR, tmp_path / "good.jpg", quality=98)
    write_image(COLOUR, tmp_path / "poor.jpg", quality=20)
    off = [
        np.abs(read_image(tmp_path / f"{n}.jpg").pixels.astype(float) - COLOUR).mean()
        for n in ("good", "poor")
    ]
    assert off[0] < 2.0 < off[1]
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "a.TIFF",
        "a.png",
        "a.tif",
        "good.jpg",
        "poor.jpg",
    ]


def test_what_cannot_be_written(tmp_path: Path) -> None:
    def refused(text: str, act: Callable[[], None]) -> None:
        with pytest.raises(InputError, match=text):
            act()

    refused(r"not as '\.gif'", lambda: write_image(COLOUR, tmp_path / "a.gif"))
    refused("a JPEG holds 8 bits", lambda: write_image(DEEP, tmp_path / "a.jpg"))
    refused("quality must be .* not 0", lambda: write_image(COLOUR, tmp_path / "a.jpg", quality=0))
    refused("cannot be written", lambda: write_image(COLOUR, tmp_path / "no" / "a.png"))
    refused(r"must be \(H, W\)", lambda: write_image(COLOUR[:, :, :2], tmp_path / "a.png"))
    assert list(tmp_path.iterdir()) == []


def test_images_are_found_in_natural_order(tmp_path: Path) -> None:
    for name in ("10.png", "9.PNG", "b2.jpeg", "b10.tif", "B1.webp", "notes.txt", ".9.png.7.tmp"):
        (tmp_path / name).touch()
    (tmp_path / ".hidden.png").touch()
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "1.bmp").touch()
    plain = ["9.PNG", "10.png", "B1.webp", "b2.jpeg", "b10.tif"]
    assert [p.name for p in find_images(tmp_path)] == plain
    assert [p.name for p in find_images(tmp_path, recursive=True)] == [*plain, "1.bmp"]
    with pytest.raises(InputError, match="cannot be read"):
        find_images(tmp_path / "none")
    with pytest.raises(InputError, match="not a folder"):
        find_images(tmp_path / "10.png")


def test_opencv_is_loaded_when_an_image_is_read() -> None:
    import subprocess

    code = "import sys, heliotrope.imaging.files; sys.exit('cv2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
