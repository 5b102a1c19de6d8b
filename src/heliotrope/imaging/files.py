"""Image files: each is read completely or rejected, dated, and written completely or not at all.

Pillow opens every file, checks that it is complete and decodes it. Pillow does not support 16-bit
colour, so OpenCV decodes such files once Pillow has checked them.

The orientation stored in a file (EXIF, TIFF) is *not* applied, because a camera's calibration
refers to the rows and columns of its sensor, however the camera was held. Alpha is dropped; a file
that is transparent everywhere is rejected. Colour profiles and gamma are not applied.
"""

import io
import json
import math
import re
import stat
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from email.utils import parsedate_to_datetime
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from PIL import (
    BmpImagePlugin,
    Image,
    ImageFile,
    JpegImagePlugin,
    PngImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
)

from heliotrope.errors import FormatError, InputError
from heliotrope.files.limits import PIXELS, check_entries
from heliotrope.files.text import read_bytes, write_file
from heliotrope.imaging.frame import Frame, Pixels

#: Suffixes that `find_images` accepts; `read_image` relies on the content instead.
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
#: Suffixes of pictures that `read_image` rejects; such files in a folder are reported by name.
OTHER_SUFFIXES = (".gif", ".heic", ".heif", ".avif", ".jp2", ".fits")
#: Default limit of `read_image`, pixels.
LIMIT = PIXELS
#: Smallest side of an image that can show a target, px.
SMALLEST = 16

_KINDS = "PNG, JPEG, TIFF, BMP or WebP"
# Use the openers directly, because the pixel limit of Image.open applies to the whole process.
_OPENERS: dict[bytes, tuple[str, Callable[[io.BytesIO], ImageFile.ImageFile]]] = {
    b"\x89PNG\r\n\x1a\n": ("PNG", PngImagePlugin.PngImageFile),
    b"\xff\xd8\xff": ("JPEG", JpegImagePlugin.jpeg_factory),
    b"II*\0": ("TIFF", TiffImagePlugin.TiffImageFile),
    b"MM\0*": ("TIFF", TiffImagePlugin.TiffImageFile),
    b"BM": ("BMP", BmpImagePlugin.BmpImageFile),
    b"RIFF": ("WebP", WebPImagePlugin.WebPImageFile),
}
_OTHERS = {
    b"GIF8": "a GIF",
    b"%PDF": "a PDF",
    b"\0\0\0\x0cjP  ": "a JPEG 2000",
    b"SIMPLE  =": "a FITS",
    b"PK\x03\x04": "a ZIP",
    b"<svg": "an SVG",
    b"<!DO": "an HTML",
    b"II+\0": "a BigTIFF",
    b"MM\0+": "a BigTIFF",
}
#: Exceptions that Pillow raises for damaged files; it also issues warnings about some damage.
_FAULTS = (
    SyntaxError,
    OSError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    EOFError,
    RuntimeError,
    struct.error,
    zlib.error,
    UserWarning,
    Image.DecompressionBombError,
)
_ROUNDING = 1.0 / math.sqrt(12.0)  # Standard deviation of a value rounded to whole units.


@dataclass(frozen=True)
class _Container:
    """A file opened by Pillow; ``texts`` and ``changed`` are the text and time chunks of a PNG."""

    kind: str
    image: ImageFile.ImageFile
    data: bytes
    exif: Mapping[int, Any]
    texts: dict[str, str] = field(default_factory=dict)
    changed: datetime | None = None


# -- reading ---------------------------------------------------------------------------


def read_image(
    path: str | Path, *, limit: int = LIMIT, zone: tzinfo | None = None, mtime: bool = False
) -> Frame:
    """Return the image in a file, with the time at which it was taken if the file states it.

    Parameters
    ----------
    path
        A PNG, JPEG, TIFF (8 or 16 bit), BMP or WebP; its suffix does not matter.
    limit
        Maximum number of pixels, checked in the header before anything is decoded.
    zone
        Time zone of times in EXIF and in file names that state none. By default such times are
        ignored.
    mtime
        Whether to fall back on the file's modification time, whose standard deviation is unknown
        (NaN).

    Returns
    -------
    Frame
        uint8, or uint16 if the file has 16 bits; grey (H, W) or blue-green-red (H, W, 3). The time
        of the frame is the first of these that is present: EXIF DateTimeOriginal with its offset;
        PNG's "Creation Time"; a time in the file name (2023-05-13T15-53-57Z, 20230513_155357Z);
        PNG's tIME, which by definition is the time of the last change; otherwise None. A time is
        assumed to be rounded to its last digit, so whole seconds have a standard deviation of 1/√12
        s. Exposure and gain (ISO/100) come from EXIF.

    Raises
    ------
    FormatError
        If there is no such image; if it is damaged, truncated, too large, too small or transparent
        everywhere; or if it cannot be represented unchanged, as with CMYK, floating-point values,
        several pages or animation.
    """
    file = Path(path)
    data, changed = _content(file, limit)
    container = _open(file, data, limit)
    pixels = _decode(file, container)
    kept = _own_values(container.texts.get("Heliotrope", ""))
    exposure, gain = _exposure(container.exif)
    time, deviation = _time(file, container, zone)
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


def find_images(
    folder: str | Path, recursive: bool = False, suffixes: tuple[str, ...] = IMAGE_SUFFIXES
) -> list[Path]:
    """Return the image files in a folder, selected by suffix; 2.png comes before 10.png.

    Hidden files are left out, because other programs use them for files that are still being
    written.

    Parameters
    ----------
    folder
        The folder.
    recursive
        Whether to search subfolders too.
    suffixes
        Suffixes in lower case.

    Raises
    ------
    InputError
        If the folder does not exist or cannot be read.
    """
    place = Path(folder)
    try:
        if not stat.S_ISDIR(place.stat().st_mode):
            raise InputError(f"{place}: not a folder; use a folder with images")
        images = [
            item
            for item in check_entries(place, place.rglob("*") if recursive else place.iterdir())
            if item.suffix.lower() in suffixes
            and not any(part.startswith(".") for part in item.relative_to(place).parts)
            and not item.is_dir()
        ]
    except OSError as error:
        raise InputError(
            f"{place}: cannot be read ({error.strerror}); use a folder with images"
        ) from None
    return sorted(images, key=_natural)


def _natural(path: Path) -> tuple[list[tuple[int, str, int]], str]:
    parts = re.split(r"([0-9]+)", str(path).casefold())
    return [(1, "", int(p)) if p.isdecimal() else (0, p, 0) for p in parts], str(path)


def _content(file: Path, limit: int) -> tuple[bytes, float]:
    """Return the bytes and the modification time of a file, if its size is plausible."""
    most = 8 * limit + 2**24  # Four channels of 16 bits, and room for metadata.
    try:
        state = file.stat()
        if stat.S_ISDIR(state.st_mode):
            raise FormatError(file, f"this is a folder; specify an image file ({_KINDS})")
        if not stat.S_ISREG(state.st_mode):
            raise FormatError(file, "this is a device or a pipe; specify an image file")
        if state.st_size > most:
            raise FormatError(
                file,
                f"{state.st_size / 2**20:.0f} MiB are more than an image of {limit / 1e6:.3g} "
                "million pixels can take; check that it is an image, or raise the limit",
            )
        data = read_bytes(file, most)
    except FileNotFoundError:
        if file.is_symlink():
            text = f"a link to {file.readlink()}, which does not exist; specify an image file"
            raise FormatError(file, text) from None
        raise FormatError(file, "no such file; specify an image file") from None
    except OSError as error:
        raise FormatError(file, f"cannot be read ({error.strerror}); use another image") from None
    if not data:
        raise FormatError(file, f"the file is empty; use an image ({_KINDS})")
    return data, state.st_mtime


# -- containers ------------------------------------------------------------------------


def _open(file: Path, data: bytes, limit: int) -> _Container:
    """Open a file and check everything that can be checked without decoding it."""
    kind, opener = _opener(file, data)
    if kind == "PNG" and any(name == b"acTL" for name, _, _ in _chunks(data)):
        raise FormatError(file, "this PNG is animated; save one of its frames")
    try:
        image = opener(io.BytesIO(data))
        _check_size(file, *image.size, limit)
        if kind == "PNG":
            return _png(image, data)
        if kind == "TIFF":
            _check_tiff(file, cast("TiffImagePlugin.TiffImageFile", image), data)
        elif kind == "WebP" and cast("WebPImagePlugin.WebPImageFile", image).is_animated:
            raise FormatError(file, "this WebP is animated; save one of its frames")
        if image.mode == "CMYK":
            raise FormatError(file, "its colours are CMYK; convert the image to RGB or grey")
        return _Container(kind, image, data, _exif(image.getexif))
    except _FAULTS as error:
        raise _damaged(file, kind, len(data), error) from None


def _opener(file: Path, data: bytes) -> tuple[str, Callable[[io.BytesIO], ImageFile.ImageFile]]:
    for start, (kind, opener) in _OPENERS.items():
        if data.startswith(start):
            if kind == "WebP" and data[8:12] != b"WEBP":
                raise FormatError(file, f"this is a RIFF file but not WebP; use a {_KINDS}")
            return kind, opener
    if data[4:8] == b"ftyp":
        what = "an AVIF, a HEIC or a video"
    else:
        what = next((w for start, w in _OTHERS.items() if data.startswith(start)), "")
    if not what:
        raise FormatError(file, f"not a supported image format; use a {_KINDS}")
    raise FormatError(file, f"this is {what} file; convert it to a {_KINDS}")


def _damaged(file: Path, kind: str, size: int, error: Exception) -> FormatError:
    """Return the error for a file that Pillow cannot read."""
    if isinstance(error, FormatError):
        return error
    reason = " ".join(str(error).split()) or type(error).__name__
    if "truncated" in reason.lower() or "chunk b''" in reason:
        text = f"this {kind} is truncated: it ends after {size} bytes; copy it again"
    elif "cannot handle" in reason or "nsupported" in reason or "nknown" in reason:
        text = f"this {kind} cannot be read ({reason}); convert it to a PNG of 8 or 16 bits"
    else:
        text = f"this {kind} is damaged ({reason}); copy it again"
    return FormatError(file, text)


def _check_size(file: Path, width: int, height: int, limit: int) -> None:
    if width < SMALLEST or height < SMALLEST:
        text = f"{width} × {height} px; an image must have at least {SMALLEST} × {SMALLEST} px"
        raise FormatError(file, text)
    if width * height > limit:
        text = f"{width} × {height} px are {width * height / 1e6:.3g} million, above the limit of "
        raise FormatError(file, f"{text}{limit / 1e6:.3g} million; reduce it or raise the limit")


def _png(image: ImageFile.ImageFile, data: bytes) -> _Container:
    """Verify all checksums, and keep the chunks that say when and how the image was taken."""
    image.verify()
    exif: Mapping[int, Any] = {}
    texts: dict[str, str] = {}
    changed = None
    for kind, body, _ in _chunks(data):
        if kind == b"eXIf":
            exif = _exif(partial(_loaded_exif, body))
        elif kind == b"tEXt" and b"\0" in body:
            key, _, value = body.partition(b"\0")
            texts[key.decode("latin-1")] = value.decode("latin-1")
        elif kind == b"tIME":
            with suppress(ValueError, struct.error):
                y, mo, d, h, mi, sec = struct.unpack(">HBBBBB", body)
                changed = datetime(y, mo, d, h, mi, sec, tzinfo=UTC)
    # After verify() the image is unusable, so open it again.
    again = PngImagePlugin.PngImageFile(io.BytesIO(data))
    return _Container("PNG", again, data, exif, texts, changed)


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes, bytes]]:
    """Yield the type, the content and all the bytes of each chunk of a PNG."""
    position = 8
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        whole = data[position : position + 12 + length]
        yield kind, whole[8:-4], whole
        position += len(whole)
        if kind == b"IEND":
            return


def _check_tiff(file: Path, image: TiffImagePlugin.TiffImageFile, data: bytes) -> None:
    tags = image.tag_v2
    bits, form = tags.get(258, (1,)), tags.get(339, (1,))[0]
    photometric, channels = tags.get(262, 1), tags.get(277, 1)
    if photometric == 5:
        raise FormatError(file, "its colours are CMYK; convert the image to RGB or grey")
    if form == 3:
        raise FormatError(
            file, (f"its pixels are {bits[0]}-bit floats; convert the image to 16 bits")
        )
    if form not in (1, 4) or set(bits) not in ({1}, {8}, {16}):
        raise FormatError(
            file,
            (f"unsupported pixels of {bits[0]} bits, format {form}; convert the image to 16 bits"),
        )
    if photometric not in (0, 1, 2, 3, 6) or channels > 4:
        raise FormatError(
            file,
            f"unsupported colour format: {channels} channels, {photometric}; convert the image "
            "to RGB",
        )
    starts, lengths = (tags.get(a, tags.get(b, ())) for a, b in ((273, 324), (279, 325)))
    if len(starts) != len(lengths):
        raise FormatError(
            file, "its TIFF directory lists no strips, so the file is damaged; copy it again"
        )
    if any(not kind & 1 for kind in _further_pages(data)):
        raise FormatError(file, "this TIFF has several pages; save each as a separate file")


def _further_pages(data: bytes) -> Iterator[int]:
    """Yield the NewSubfileType of each page after the first; bit 0 marks a reduced version."""
    stream, directory = io.BytesIO(data), TiffImagePlugin.ImageFileDirectory_v2(data[:8])
    visited: set[int] = set()
    while directory.next and directory.next not in visited:
        visited.add(directory.next)
        stream.seek(directory.next)
        directory.load(stream)
        if len(visited) > 1:
            yield directory.get(254, 0)


# -- decoding --------------------------------------------------------------------------


def _decode(file: Path, container: _Container) -> Pixels:
    kind, image, data = container.kind, container.image, container.data
    size = image.size
    if _is_transparent(image):
        text = "every pixel is transparent, so the image is blank; save it without alpha"
        raise FormatError(file, text)
    orientation = image.tag_v2.get(274, 1) if kind == "TIFF" else 1  # type: ignore[attr-defined]
    try:
        pixels = _deep_colour(file, container) if _is_deep_colour(container) else _eight_bit(image)
    except _FAULTS as error:
        raise _damaged(file, kind, len(data), error) from None
    if kind == "JPEG" and _is_torn(pixels, data):
        raise FormatError(file, "this JPEG is damaged: part of its scan is missing; copy it again")
    # Pillow and OpenCV both rotate a TIFF according to its orientation; this reverses the rotation.
    pixels = _turned_back(pixels, orientation)
    if pixels.shape[1::-1] != size and pixels.shape[:2] != size:
        raise FormatError(
            file,
            f"decoded to {pixels.shape[1]} × {pixels.shape[0]} px where its header says "
            f"{size[0]} × {size[1]}; convert it to a PNG",
        )
    return cast("Pixels", np.ascontiguousarray(pixels))


def _is_transparent(image: ImageFile.ImageFile) -> bool:
    """Return whether alpha is 0 everywhere; a file that cannot be decoded is rejected later."""
    if image.mode not in ("RGBA", "LA", "PA"):
        return False
    with suppress(*_FAULTS):
        return bool(np.asarray(image.getchannel("A")).max() == 0)
    return False


def _is_deep_colour(container: _Container) -> bool:
    """Return whether Pillow would reduce an image from 16 to 8 bits."""
    image = container.image
    if image.mode.startswith("I;16"):
        return False
    if container.kind == "PNG":
        return container.data[24] == 16
    if container.kind == "TIFF":
        tags = cast("TiffImagePlugin.TiffImageFile", image).tag_v2
        return bool(max(tags.get(258, (1,))) == 16)
    return False


def _eight_bit(image: ImageFile.ImageFile) -> Pixels:
    """Return the pixels decoded by Pillow, with 8 bits or as 16-bit grey."""
    import cv2

    image.load()
    if image.mode.startswith("I;16"):
        return np.array(image, dtype=np.uint16)
    if image.mode in ("1", "L"):
        return np.array(image.convert("L"))
    if image.mode not in ("P", "PA", "LA", "RGB", "RGBA", "RGBX", "YCbCr"):
        raise ValueError(f"unsupported pixels of mode {image.mode}")
    image.info.pop("transparency", None)
    colour = image if image.mode == "RGB" else image.convert("RGB")
    return cast("Pixels", cv2.cvtColor(np.asarray(colour), cv2.COLOR_RGB2BGR))


def _deep_colour(file: Path, container: _Container) -> Pixels:
    """Decode 16-bit colour with OpenCV, as blue-green-red."""
    import cv2

    data = container.data
    if container.kind == "PNG":
        # libpng writes complaints about profiles and texts to standard error, so these chunks are
        # removed. Bit 5 of the first letter marks a chunk that is not needed for decoding.
        data = data[:8] + b"".join(w for kind, _, w in _chunks(data) if not kind[0] & 0x20)
    how = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), how)
    if pixels is None or pixels.dtype != np.uint16:
        raise FormatError(file, f"this {container.kind} is damaged; copy it again")
    return cast("Pixels", pixels[:, :, :3] if pixels.ndim == 3 else pixels)


def _turned_back(pixels: Pixels, orientation: int) -> Pixels:
    """Undo an EXIF orientation: return pixels in the rows and columns of the sensor."""
    back: dict[int, Callable[[Any], Any]] = {
        2: lambda p: p[:, ::-1],
        3: lambda p: p[::-1, ::-1],
        4: lambda p: p[::-1],
        5: lambda p: p.swapaxes(0, 1),
        6: np.rot90,
        7: lambda p: p[::-1, ::-1].swapaxes(0, 1),
        8: lambda p: np.rot90(p, -1),
    }
    return cast("Pixels", back[orientation](pixels) if orientation in back else pixels)


def _is_torn(pixels: Pixels, data: bytes) -> bool:
    """Return whether the scan of a JPEG ends before its picture does.

    libjpeg then fills the rest with one value, and its warning does not reach Pillow's callers. If
    a scene really has one value throughout, as at night, every block is coded with the same bits,
    so the scan ends in repeating bits. This is not true with restart markers (DRI) or progressive
    scans (SOF2), so such files are not checked.
    """
    last = pixels[-8:, -128:]
    header = data[: data.find(b"\xff\xda")]
    if (last != last[0, 0]).any() or b"\xff\xdd" in header or b"\xff\xc2" in header:
        return False
    scan = data[: data.rfind(b"\xff\xd9")][-1024:].replace(b"\xff\0", b"\xff")
    bits = np.unpackbits(np.frombuffer(scan[:-1], np.uint8))  # The last byte holds fill bits.
    return not any(np.array_equal(bits[-4 * n : -n], bits[-3 * n :]) for n in range(4, 512))


# -- when it was taken -----------------------------------------------------------------

_NAMED = re.compile(
    r"(?<!\d)(\d{4})-?(\d\d)-?(\d\d)[T_ -](\d\d)[-:_.]?(\d\d)[-:_.]?(\d\d)(?!\d)"
    r"(?:[.,](\d{1,6})(?!\d))?(Z|\+\d\d[:-]?\d\d(?!\d))?"
)


def _time(file: Path, container: _Container, zone: tzinfo | None) -> tuple[datetime | None, float]:
    for time, unit in (
        _exif_time(container.exif, zone),
        _text_time(container.texts.get("Creation Time", "")),
        _name_time(file.stem, zone),
        (container.changed, 1.0),
    ):
        if time is not None:
            return time, unit * _ROUNDING
    return None, math.nan


def _exif(get: Callable[[], Image.Exif]) -> Mapping[int, Any]:
    """Return the EXIF tags together with the image tags; an empty mapping if damaged."""
    try:
        exif = get()
        return dict(exif) | exif.get_ifd(0x8769)
    except _FAULTS:
        return {}


def _loaded_exif(body: bytes) -> Image.Exif:
    exif = Image.Exif()
    exif.load(body)
    return exif


def _text(tags: Mapping[int, Any], tag: int) -> str:
    value = tags.get(tag, "")
    return value.split("\0")[0].strip() if isinstance(value, str) else ""


def _exif_time(tags: Mapping[int, Any], zone: tzinfo | None) -> tuple[datetime | None, float]:
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
    """Return a time and the unit of its last digit, s; the time is None if it has no zone."""
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
    """Read a time in the form that PNG recommends (RFC 1123), or in ISO 8601."""
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


def _exposure(tags: Mapping[int, Any]) -> tuple[float, float]:
    """Return the exposure, s, and the gain, ISO/100; NaN for what EXIF does not state."""
    values = []
    for tag, unit in ((0x829A, 1.0), (0x8827, 0.01)):
        value = tags.get(tag)
        value = value[0] if isinstance(value, tuple) and value else value
        try:
            number = float(value) * unit  # type: ignore[arg-type]
        except (TypeError, ValueError, ArithmeticError):
            number = math.nan
        values.append(number if 0.0 < number < math.inf else math.nan)
    return values[0], values[1]


def _own_values(text: str) -> dict[str, float]:
    """Return the numbers that `write_image` stored in a PNG."""
    values = None
    with suppress(ValueError, RecursionError):
        values = json.loads(text)
    items = values.items() if isinstance(values, dict) else ()
    return {k: v for k, v in items if isinstance(v, int | float) and 0 < v < math.inf}


# -- writing ---------------------------------------------------------------------------


def write_image(image: Frame | Pixels, path: str | Path, *, quality: int = 95) -> None:
    """Write a PNG, JPEG or TIFF, as the suffix says, completely or not at all.

    Parameters
    ----------
    image
        A frame, or grey (H, W) or blue-green-red (H, W, 3) pixels, uint8 or uint16.
    path
        The file; an existing file is replaced atomically. A PNG stores the frame's time, exposure,
        gain and count, and `read_image` restores them; the other formats store only the pixels.
    quality
        JPEG quality, 1 to 100.

    Raises
    ------
    InputError
        If the suffix is unknown, if a 16-bit image is to be written as JPEG, or if the file cannot
        be written.
    """
    file = Path(path)
    data = encode_image(image, file.suffix.lower(), quality, str(file))
    write_file(file, lambda stream: stream.write(data))


def encode_image(
    image: Frame | Pixels, suffix: str, quality: int = 95, name: str = "image"
) -> bytes:
    """Return the bytes that `write_image` would write; error messages quote ``name``.

    Raises
    ------
    InputError
        See `write_image`.
    """
    import cv2

    frame = image if isinstance(image, Frame) else Frame(image, name)
    if suffix not in (".png", ".jpg", ".jpeg", ".tif", ".tiff"):
        raise InputError(f"{name}: images can be written as .png, .jpg or .tif, not as {suffix!r}")
    jpeg = suffix in (".jpg", ".jpeg")
    if jpeg and frame.pixels.dtype != np.uint8:
        raise InputError(f"{name}: a JPEG holds 8 bits, the frame has 16; write a PNG or a TIFF")
    if not 1 <= quality <= 100:
        raise InputError(f"{name}: quality must be between 1 and 100, not {quality}")
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if jpeg else []
    done, encoded = cv2.imencode(suffix, frame.pixels, options)
    if not done:
        raise InputError(f"{name}: OpenCV cannot write {frame.pixels.shape} as {suffix}")
    data = encoded.tobytes()
    return _with_texts(data, frame) if suffix == ".png" else data


def _with_texts(data: bytes, frame: Frame) -> bytes:
    """Return a PNG with the frame's metadata in text chunks after the header."""
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
