"""Image files: read whole or refused with one line; their times; written whole or not at all.

What OpenCV leaves to its user is done here, before it decodes: the container is walked to
its end, so that a file that broke off is refused and not half grey; sizes are limited by the
header; kinds that would be changed silently (CMYK, float, several pages) are refused.

The orientation that a file asks for (EXIF, TIFF) is *not* applied: the calibration of a camera
belongs to its sensor's rows and columns, however the camera was held. Alpha is dropped.
Colour profiles and gamma are not applied.
"""

import json
import math
import os
import re
import stat
import struct
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any, cast

import numpy as np

from heliotrope.errors import FormatError, InputError
from heliotrope.files.text import write_file
from heliotrope.imaging.frame import Frame, Pixels

#: What :func:`find_images` looks for; :func:`read_image` goes by the content, not by these.
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
#: Pixels of the largest image that is read unless another limit is given.
LIMIT = 64_000_000
#: Sides below this show no target, px.
SMALLEST = 16

_KINDS = "PNG, JPEG, TIFF, BMP or WebP"
_OTHERS = {
    b"GIF8": "a GIF", b"%PDF": "a PDF", b"\0\0\0\x0cjP  ": "a JPEG 2000", b"SIMPLE  =": "a FITS",
    b"PK\x03\x04": "a ZIP", b"<svg": "an SVG", b"<!DO": "an HTML", b"II+\0": "a BigTIFF",
    b"MM\0+": "a BigTIFF",
}  # fmt: skip
_RATE = 1.0 / math.sqrt(12.0)  # deviation of what is rounded to whole units


@dataclass(frozen=True)
class _Image:
    """A container that was walked to its end."""

    kind: str
    size: tuple[int, int]
    clean: bytes  # what OpenCV gets: nothing in it that would warn, rotate or colour
    exif: bytes = b""  # a TIFF structure
    texts: dict[str, str] = field(default_factory=dict)
    changed: datetime | None = None  # PNG's tIME


# -- reading ---------------------------------------------------------------------------


def read_image(
    path: str | Path, *, limit: int = LIMIT, zone: tzinfo | None = None, mtime: bool = False
) -> Frame:
    """Return the image of a file, and when it was taken if the file says so.

    Parameters
    ----------
    path
        A PNG, JPEG, TIFF (8 or 16 bit), BMP or WebP, whatever its suffix.
    limit
        The greatest number of pixels; checked in the header, before anything is decoded.
    zone
        Of times in EXIF and in file names that state none; without it these are not used.
    mtime
        Whether the file's time of change stands in where there is no better one; its
        deviation is unknown (NaN).

    Returns
    -------
    Frame
        uint8, or uint16 if the file has 16 bits; grey (H, W) or blue-green-red (H, W, 3). Its
        time is, in this order: EXIF DateTimeOriginal with its offset; PNG's "Creation Time";
        a time in the file's name (2023-05-13T15-53-57Z, 20230513_155357Z); PNG's tIME, last
        because it is by definition the time of the last change; None. A stated time counts as
        rounded to its last digit: whole seconds have a deviation of 1/√12 s. Exposure and gain
        (ISO/100) are EXIF's.

    Raises
    ------
    FormatError
        If there is no such image, or it is broken, truncated, too large, too small or of a
        kind that cannot be kept as it is: CMYK, float, several pages, animated.
    """
    file = Path(path)
    data, changed = _content(file, limit)
    image = _walk(file, data, limit)
    pixels = _decode(file, image)
    kept = _own_values(image.texts.get("Heliotrope", ""))
    exposure, gain = _exposure(image.exif)
    time, deviation = _time(file, image, zone)
    if time is None and mtime:
        time = datetime.fromtimestamp(changed, UTC)
    return Frame(
        pixels,
        str(file),
        time,
        kept.get("time_deviation_s", deviation) if time else math.nan,
        kept.get("exposure_s", exposure),
        kept.get("gain", gain),
        int(kept.get("count", 1)),
    )


def find_images(folder: str | Path, recursive: bool = False) -> list[Path]:
    """Return the image files of a folder by their suffix, 2.png before 10.png.

    Hidden files are left out: they are what others are still writing.

    Raises
    ------
    InputError
        If there is no such folder or it cannot be read.
    """
    place = Path(folder)
    try:
        if not stat.S_ISDIR(place.stat().st_mode):
            raise InputError(f"{place}: this is no folder; give one with images")
        found = [
            item
            for item in (place.rglob("*") if recursive else place.iterdir())
            if item.suffix.lower() in IMAGE_SUFFIXES
            and not any(part.startswith(".") for part in item.relative_to(place).parts)
            and not item.is_dir()
        ]
    except OSError as error:
        raise InputError(
            f"{place}: cannot be read ({error.strerror}); give a folder with images"
        ) from None
    return sorted(found, key=_natural)


def _natural(path: Path) -> tuple[list[tuple[int, str, int]], str]:
    parts = re.split(r"([0-9]+)", str(path).casefold())
    return [(1, "", int(p)) if p.isdecimal() else (0, p, 0) for p in parts], str(path)


def _content(file: Path, limit: int) -> tuple[bytes, float]:
    """Return the bytes of a file of a plausible size, and when it was changed."""
    most = 8 * limit + 2**24  # four channels of 16 bit, and what is written about them
    try:
        state = file.stat()
        if stat.S_ISDIR(state.st_mode):
            raise FormatError(file, f"this is a folder; give an image file ({_KINDS})")
        if not stat.S_ISREG(state.st_mode):
            raise FormatError(file, "this is a device or a pipe; give an image file")
        if state.st_size > most:
            raise FormatError(
                file,
                f"{state.st_size / 2**20:.0f} MiB are more than {limit / 1e6:.3g} million "
                "pixels can have; this is no image, or the limit must be raised",
            )
        data = file.read_bytes()
    except FileNotFoundError:
        if file.is_symlink():
            text = f"a link to {file.readlink()}, which does not exist; give an image file"
            raise FormatError(file, text) from None
        raise FormatError(file, "there is no such file; give an image file") from None
    except OSError as error:
        raise FormatError(file, f"cannot be read ({error.strerror}); give an image") from None
    if not data:
        raise FormatError(file, f"the file is empty; it should be an image ({_KINDS})")
    return data, state.st_mtime


def _walk(file: Path, data: bytes, limit: int) -> _Image:
    walkers: tuple[tuple[bytes, Callable[[Path, bytes, int], _Image]], ...] = (
        (b"\x89PNG\r\n\x1a\n", _png), (b"\xff\xd8\xff", _jpeg), (b"II*\0", _tiff),
        (b"MM\0*", _tiff), (b"BM", _bmp), (b"RIFF", _webp),
    )  # fmt: skip
    for start, walker in walkers:
        if data.startswith(start):
            try:
                return walker(file, data, limit)
            except (struct.error, IndexError, TypeError):
                raise FormatError(file, "its header is damaged; copy the file again") from None
    if data[4:8] == b"ftyp":
        what = "an AVIF, a HEIC or a video"
    else:
        what = next((w for start, w in _OTHERS.items() if data.startswith(start)), "")
    if not what:
        raise FormatError(file, f"this is no image that is known here; give a {_KINDS}")
    raise FormatError(file, f"this is {what} file; convert it to a {_KINDS}")


def _truncated(file: Path, where: str, size: int) -> FormatError:
    text = f"the file ends after {size} bytes, {where}; it is truncated, copy it again"
    return FormatError(file, text)


def _check_size(file: Path, width: int, height: int, limit: int) -> tuple[int, int]:
    if width < SMALLEST or height < SMALLEST:
        text = f"{width} × {height} px; an image needs {SMALLEST} × {SMALLEST} px or more"
        raise FormatError(file, text)
    if width * height > limit:
        text = f"{width} × {height} px are {width * height / 1e6:.3g} million, above the limit of "
        raise FormatError(file, f"{text}{limit / 1e6:.3g} million; reduce it or raise the limit")
    return width, height


# -- containers ------------------------------------------------------------------------


def _png(file: Path, data: bytes, limit: int) -> _Image:
    """Walk the chunks with their checksums (PNG, third edition, 5.3)."""
    position, kept = 8, [data[:8]]
    size, exif, changed = (0, 0), b"", None
    texts: dict[str, str] = {}
    while True:
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 12 + length
        name = kind.decode("latin-1") if kind.isalpha() else "?"
        if end > len(data):
            raise _truncated(file, f"in its chunk {name} from byte {position}", len(data))
        body = data[position + 8 : end - 4]
        whole = zlib.crc32(data[position + 4 : end - 4]) == int.from_bytes(data[end - 4 : end])
        critical = not kind[0] & 0x20
        if critical and not whole:
            text = "its checksum is wrong: the file is damaged, copy it again"
            raise FormatError(file, text, f"chunk {name} at byte {position}")
        if (kind == b"IHDR") != (position == 8):
            raise FormatError(file, "its chunks are out of order: damaged, copy it again")
        if kind == b"IHDR":
            width, height = struct.unpack_from(">II", body)
            size = _check_size(file, width, height, limit)
        elif kind == b"acTL":
            raise FormatError(file, "this PNG is animated; save one of its frames")
        elif kind == b"eXIf" and whole:
            exif = body
        elif kind == b"tEXt" and whole and b"\0" in body:
            key, _, value = body.partition(b"\0")
            texts[key.decode("latin-1")] = value.decode("latin-1")
        elif kind == b"tIME" and whole:
            with suppress(ValueError, struct.error):
                y, mo, d, h, mi, sec = struct.unpack(">HBBBBB", body)
                changed = datetime(y, mo, d, h, mi, sec, tzinfo=UTC)
        if critical:
            kept.append(data[position:end])
        position = end
        if kind == b"IEND":
            return _Image("PNG", size, b"".join(kept), exif, texts, changed)
        if position + 8 > len(data):
            raise _truncated(file, "before its chunk IEND", len(data))


_MARKER = re.compile(rb"\xff+[^\x00\xff\xd0-\xd7]")


def _jpeg(file: Path, data: bytes, limit: int) -> _Image:
    """Walk the segments and scans up to the end marker (ITU-T T.81, B.1)."""
    position, kept = 2, [data[:2]]
    size, exif, scans = (0, 0), b"", 0
    while True:
        marker = _MARKER.match(data, position)
        if not marker:
            if position + 2 > len(data):
                raise _truncated(file, "before its end marker", len(data))
            raise FormatError(file, "no marker: damaged, copy it again", f"byte {position}")
        code, start = data[marker.end() - 1], marker.end()
        if code == 0xD9:
            break
        (length,) = struct.unpack_from(">H", data, start)
        end = start + length
        if end > len(data):
            raise _truncated(file, f"in its segment from byte {position}", len(data))
        if 0xC0 <= code <= 0xCF and code not in (0xC4, 0xC8, 0xCC):
            size = _check_jpeg(file, data[start + 2 : end], limit)
        elif code == 0xE1 and data[start + 2 : start + 8] == b"Exif\0\0" and not exif:
            exif = data[start + 8 : end]
        elif code == 0xDA:
            scans += 1
            behind = _MARKER.search(data, end)
            if not behind:
                raise _truncated(file, "before its end marker", len(data))
            end = behind.start()
        # Of what applications add, the colours depend on APP0 and APP14 alone.
        if not (0xE0 < code <= 0xEF and code != 0xEE) and code != 0xFE:
            kept.append(data[position:end])
        position = end
    if not (size[0] and scans):
        raise FormatError(file, "there is no picture between its markers: damaged, copy it again")
    return _Image("JPEG", size, b"".join([*kept, b"\xff\xd9"]), exif)


def _check_jpeg(file: Path, body: bytes, limit: int) -> tuple[int, int]:
    bits, height, width, channels = struct.unpack_from(">BHHB", body)
    if channels == 4:
        raise FormatError(file, "its colours are CMYK; convert it to RGB or grey")
    if bits != 8 or channels not in (1, 3):
        raise FormatError(file, f"{channels} channels of {bits} bits; convert it to RGB of 8 bits")
    return _check_size(file, width, height, limit)


_TYPES = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 6: "b", 7: "s", 8: "h", 9: "i", 10: "ii"}


def _directory(data: bytes, offset: int) -> tuple[dict[int, tuple[Any, ...]], int, dict[int, int]]:
    """Return a TIFF directory: values of tags, the next one's offset, places of the entries.

    A value that lies outside of the data is left out; a directory that does raises
    struct.error (TIFF 6.0, section 2).
    """
    order = "<" if data[:2] == b"II" else ">"
    (count,) = struct.unpack_from(order + "H", data, offset)
    values: dict[int, tuple[Any, ...]] = {}
    places = {}
    for i in range(count):
        place = offset + 2 + 12 * i
        tag, kind, number = struct.unpack_from(order + "HHI", data, place)
        code = _TYPES.get(kind)
        if not code or number > len(data):
            continue
        form = f"{order}{number}s" if code == "s" else order + code * number
        length = struct.calcsize(form)
        at = place + 8
        if length > 4:
            (at,) = struct.unpack_from(order + "I", data, at)
        if at + length <= len(data):
            values[tag] = struct.unpack_from(form, data, at)
            places[tag] = place
    (following,) = struct.unpack_from(order + "I", data, offset + 2 + 12 * count)
    return values, following, places


def _tiff(file: Path, data: bytes, limit: int) -> _Image:
    order = "<" if data[:2] == b"II" else ">"
    (offset,) = struct.unpack_from(order + "I", data, 4)
    tags, following, places = _directory(data, offset)
    size = _check_size(file, tags.get(256, (0,))[0], tags.get(257, (0,))[0], limit)
    channels = tags.get(277, (1,))[0]
    _check_tiff(file, tags, channels)
    seen = {offset}
    while following and following not in seen:
        seen.add(following)
        other, following, _ = _directory(data, following)
        if not other.get(254, (0,))[0] & 1:  # bit 0: a smaller version of another page
            raise FormatError(file, "this TIFF has several pages; save each as a file of its own")
    starts, lengths = tags.get(273, tags.get(324)), tags.get(279, tags.get(325))
    if not starts or not lengths or len(starts) != len(lengths):
        raise FormatError(file, "its directory names no strips: damaged, copy it again")
    if max(a + b for a, b in zip(starts, lengths, strict=True)) > len(data):
        raise _truncated(file, "before the end of its pixels", len(data))
    # OpenCV would turn the image by its orientation and multiply it with its alpha.
    patched = bytearray(data)
    for tag in {274, 338} & places.keys():
        struct.pack_into(order + "H", patched, places[tag] + 8, 1)
    return _Image("TIFF", size, bytes(patched), data)


def _check_tiff(file: Path, tags: dict[int, tuple[Any, ...]], channels: int) -> None:
    bits = tags.get(258, (1,))
    form = tags.get(339, (1,))[0]
    photometric = tags.get(262, (1,))[0]
    if photometric == 5:
        raise FormatError(file, "its colours are CMYK; convert it to RGB or grey")
    if form == 3:
        raise FormatError(file, f"its pixels are floats of {bits[0]} bits; convert it to 16 bits")
    if form not in (1, 4) or set(bits) not in ({1}, {8}, {16}):
        raise FormatError(file, f"pixels of {bits[0]} bits, form {form}; convert it to 16 bits")
    if photometric not in (0, 1, 2, 3, 6) or channels > 4:
        raise FormatError(file, f"{channels} channels of kind {photometric}; convert it to RGB")


def _bmp(file: Path, data: bytes, limit: int) -> _Image:
    (start, header) = struct.unpack_from("<II", data, 10)
    if header < 40:
        raise FormatError(file, "a BMP of OS/2; convert it to a PNG")
    width, height, _, bits, packed = struct.unpack_from("<iiHHI", data, 18)
    size = _check_size(file, width, abs(height), limit)
    rows = (width * bits + 31) // 32 * 4 * abs(height)
    if packed in (0, 3) and start + rows > len(data):
        raise _truncated(file, "before the end of its pixels", len(data))
    return _Image("BMP", size, data)


def _webp(file: Path, data: bytes, limit: int) -> _Image:
    """Walk the chunks (WebP Container Specification, 2.5 to 2.7)."""
    length, form = struct.unpack_from("<I4s", data, 4)
    if form != b"WEBP":
        raise FormatError(file, f"this is a RIFF file but no WebP; give a {_KINDS}")
    if length + 8 > len(data):
        raise _truncated(file, f"of {length + 8} that its header states", len(data))
    position, size, exif = 12, (0, 0), b""
    while position + 8 <= length + 8:
        kind, count = struct.unpack_from("<4sI", data, position)
        body = data[position + 8 : position + 8 + count]
        if kind == b"VP8X" and body[0] & 2:
            raise FormatError(file, "this WebP is animated; save one of its frames")
        if kind == b"VP8 ":
            width, height = struct.unpack_from("<HH", body, 6)
            size = _check_size(file, width & 0x3FFF, height & 0x3FFF, limit)
        elif kind == b"VP8L":
            (both,) = struct.unpack_from("<I", body, 1)
            size = _check_size(file, (both & 0x3FFF) + 1, (both >> 14 & 0x3FFF) + 1, limit)
        elif kind == b"EXIF":
            exif = body.removeprefix(b"Exif\0\0")
        position += 8 + count + count % 2
    if not size[0]:
        raise FormatError(file, "there is no picture in it: damaged, copy it again")
    return _Image("WebP", size, data, exif)


# -- decoding --------------------------------------------------------------------------

_ALONE = threading.Lock()
_THEIRS = re.compile(
    rb"libpng |Corrupt JPEG|Premature end|Inva?lid .*JPEG|Inconsistent prog|Warning: unknown JFIF"
)


@contextmanager
def _overheard() -> Iterator[list[str]]:
    """Keep what C libraries write to stderr meanwhile; what is not theirs is passed on.

    libjpeg says in no other way that what it decoded is damaged.
    """
    heard: list[str] = []
    with _ALONE:
        try:
            before = os.dup(2)
        except OSError:  # no stderr at all
            before = os.open(os.devnull, os.O_WRONLY)
        inside = os.memfd_create("stderr")
        try:
            os.dup2(inside, 2)
            yield heard
        finally:
            os.dup2(before, 2)
            written = os.pread(inside, 2**16, 0)
            os.close(inside)
            for line in written.splitlines(keepends=True):
                if _THEIRS.match(line):
                    heard.append(line.decode(errors="replace").strip())
                else:
                    os.write(before, line)
            os.close(before)


def _decode(file: Path, image: _Image) -> Pixels:
    import cv2

    how = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    with _overheard() as heard:
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            pixels = cv2.imdecode(np.frombuffer(image.clean, np.uint8), how)
        except cv2.error:
            pixels = None
        finally:
            cv2.utils.logging.setLogLevel(level)
    # A camera that fills up its scans says nothing of their content.
    bad = [text for text in heard if "extraneous" not in text and "arning" not in text]
    if pixels is None or (bad and image.kind == "JPEG"):
        reason = f" ({bad[0]})" if bad else ""
        raise FormatError(file, f"this {image.kind} is damaged{reason}; copy it again")
    if pixels.ndim == 3:
        pixels = pixels[:, :, 0] if pixels.shape[2] < 3 else pixels[:, :, :3]
    found = (pixels.shape[1], pixels.shape[0])
    if found != image.size or pixels.dtype not in (np.uint8, np.uint16):
        raise FormatError(
            file,
            f"decoded to {found} px of {pixels.dtype} where its header says {image.size}; "
            "convert it to a PNG",
        )
    return cast("Pixels", np.ascontiguousarray(pixels))


# -- when it was taken -----------------------------------------------------------------

_NAMED = re.compile(
    r"(?<!\d)(\d{4})-?(\d\d)-?(\d\d)[T_ -](\d\d)[-:_.]?(\d\d)[-:_.]?(\d\d)(?!\d)"
    r"(?:[.,](\d{1,6})(?!\d))?(Z|\+\d\d[:-]?\d\d(?!\d))?"
)


def _time(file: Path, image: _Image, zone: tzinfo | None) -> tuple[datetime | None, float]:
    for time, unit in (
        _exif_time(image.exif, zone),
        _text_time(image.texts.get("Creation Time", "")),
        _name_time(file.stem, zone),
        (image.changed, 1.0),
    ):
        if time is not None:
            return time, unit * _RATE
    return None, math.nan


def _tags(exif: bytes) -> dict[int, tuple[Any, ...]]:
    """Return EXIF's tags together with those of the image; none if they are damaged."""
    try:
        order = {b"II": "<", b"MM": ">"}[exif[:2]]
        tags, _, _ = _directory(exif, struct.unpack_from(order + "I", exif, 4)[0])
        inner, _, _ = _directory(exif, tags[0x8769][0]) if 0x8769 in tags else ({}, 0, {})
    except (struct.error, KeyError, IndexError, TypeError):
        return {}
    return tags | inner


def _text(tags: dict[int, tuple[Any, ...]], tag: int) -> str:
    value = tags.get(tag, (b"",))[0]
    return value.split(b"\0")[0].decode("latin-1").strip() if isinstance(value, bytes) else ""


def _exif_time(exif: bytes, zone: tzinfo | None) -> tuple[datetime | None, float]:
    tags = _tags(exif)
    match = re.fullmatch(r"(\d{4}):(\d\d):(\d\d) (\d\d):(\d\d):(\d\d)", _text(tags, 0x9003))
    if not match:
        return None, math.nan
    fraction = _text(tags, 0x9291)
    fraction = fraction if fraction.isdecimal() and fraction.isascii() else ""
    return _stated(match.groups(), fraction, _text(tags, 0x9011), zone)


def _name_time(name: str, zone: tzinfo | None) -> tuple[datetime | None, float]:
    match = _NAMED.search(name)
    if not match:
        return None, math.nan
    return _stated(match.groups()[:6], match[7] or "", match[8] or "", zone)


def _stated(
    numbers: tuple[str, ...], fraction: str, offset: str, zone: tzinfo | None
) -> tuple[datetime | None, float]:
    """Return a time and the unit of its last digit, s; None without a zone."""
    match = re.fullmatch(r"([+-])(\d\d)[:-]?(\d\d)", offset)
    if match:
        minutes = 60 * int(match[2]) + int(match[3])
        minutes = -minutes if match[1] == "-" else minutes
        zone = timezone(timedelta(minutes=minutes)) if abs(minutes) < 1440 else None
    elif offset == "Z":
        zone = UTC
    if zone is None:
        return None, math.nan
    try:
        y, mo, d, h, mi, sec = map(int, numbers)
        time = datetime(y, mo, d, h, mi, sec, tzinfo=zone)
    except ValueError:
        return None, math.nan
    digits = fraction[:6]
    return time + timedelta(microseconds=int(digits.ljust(6, "0") or 0)), 10.0 ** -len(digits)


def _text_time(text: str) -> tuple[datetime | None, float]:
    """Read PNG's recommended form (RFC 1123), or ISO 8601."""
    time = None
    with suppress(ValueError, TypeError):
        time = datetime.fromisoformat(text)
    if time is None:
        with suppress(ValueError, TypeError, IndexError):
            time = parsedate_to_datetime(text)
    if time is None or time.tzinfo is None:
        return None, math.nan
    fraction = re.search(r":\d\d\.(\d{1,6})", text)
    return time, 10.0 ** -(len(fraction[1]) if fraction else 0)


def _exposure(exif: bytes) -> tuple[float, float]:
    """Return the exposure, s, and the gain, ISO/100; NaN where EXIF says nothing."""
    tags = _tags(exif)
    top, bottom = (*tags.get(0x829A, (0, 0)), 0)[:2]
    speed = tags.get(0x8827, (0,))[0]
    good = isinstance(top, int) and isinstance(bottom, int) and top > 0 and bottom > 0
    gain = speed / 100.0 if isinstance(speed, int) and speed > 0 else math.nan
    return (top / bottom if good else math.nan), gain


def _own_values(text: str) -> dict[str, float]:
    """Return the numbers that :func:`write_image` left in a PNG."""
    values = None
    with suppress(ValueError):
        values = json.loads(text)
    items = values.items() if isinstance(values, dict) else ()
    return {k: v for k, v in items if isinstance(v, int | float) and 0 < v < math.inf}


# -- writing ---------------------------------------------------------------------------


def write_image(image: Frame | Pixels, path: str | Path, *, quality: int = 95) -> None:
    """Write a PNG, JPEG or TIFF by its suffix; it is there whole or not at all.

    Parameters
    ----------
    image
        A frame, or grey (H, W) or blue-green-red (H, W, 3) pixels, uint8 or uint16.
    path
        The file; an existing one is replaced in one step. A PNG keeps the frame's time,
        exposure, gain and count, and :func:`read_image` gives them back; the others keep
        the pixels alone.
    quality
        Of a JPEG, 1 to 100.

    Raises
    ------
    InputError
        If the suffix is unknown, a JPEG should hold 16 bits, or it cannot be written.
    """
    file = Path(path)
    data = _encode(image, file.suffix.lower(), quality, str(file))
    write_file(file, lambda stream: stream.write(data))


def _encode(image: Frame | Pixels, suffix: str, quality: int, name: str) -> bytes:
    import cv2

    frame = image if isinstance(image, Frame) else Frame(image, name)
    if suffix not in (".png", ".jpg", ".jpeg", ".tif", ".tiff"):
        raise InputError(f"{name}: images are written as .png, .jpg or .tif, not as {suffix!r}")
    jpeg = suffix in (".jpg", ".jpeg")
    if jpeg and frame.pixels.dtype != np.uint8:
        raise InputError(f"{name}: a JPEG holds 8 bits, the frame has 16; write a PNG or a TIFF")
    if not 1 <= quality <= 100:
        raise InputError(f"{name}: quality {quality}; give 1 to 100")
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if jpeg else []
    done, encoded = cv2.imencode(suffix, frame.pixels, options)
    if not done:
        raise InputError(f"{name}: OpenCV cannot write {frame.pixels.shape} as {suffix}")
    data = encoded.tobytes()
    return _with_texts(data, frame) if suffix == ".png" else data


def _with_texts(data: bytes, frame: Frame) -> bytes:
    """Return a PNG with what is known of the frame, in chunks behind its header."""
    texts = {}
    if frame.time is not None:
        texts["Creation Time"] = frame.time.isoformat()
    values = {
        "time_deviation_s": frame.time_deviation,
        "exposure_s": frame.exposure,
        "gain": frame.gain,
        "count": frame.count,
    }
    known = {k: v for k, v in values.items() if math.isfinite(v) and (k, v) != ("count", 1)}
    if known:
        texts["Heliotrope"] = json.dumps(known)
    chunks = b""
    for key, text in texts.items():
        body = b"tEXt" + key.encode("latin-1") + b"\0" + text.encode("latin-1")
        chunks += struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return data[:33] + chunks + data[33:]
