"""Read and write EXIF and XMP metadata as DJI drones write them into photographs."""

import math
import struct
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from heliotrope.errors import FormatError
from heliotrope.files.limits import PHOTOGRAPH_PIXELS, check_count
from heliotrope.geometry import FloatArray

DJI = "http://www.dji.com/drone-dji/1.0/"
_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
_XAP = "http://ns.adobe.com/xap/1.0/"
#: RtkFlag of a fixed solution; lower values mean an accuracy of decimetres or metres.
RTK_FIXED = 50
_EXIF_IFD, _TAKEN, _OFFSET, _SUBSECOND = 0x8769, 0x9003, 0x9011, 0x9291


@dataclass(frozen=True)
class Metadata:
    """The contents of a photograph's header; NaN where a value is missing.

    Attributes
    ----------
    size
        Width and height, pixels.
    time
        Time of exposure, in UTC if the file states the time zone.
    latitude_deg, longitude_deg, altitude
        Position of the projection centre, with the altitude in m.
    yaw_deg, pitch_deg, roll_deg
        Angles of the gimbal.
    sigma
        Standard deviations to the east, to the north and up, as stated by the RTK receiver, m,
        (3,).
    rtk_flag
        `RTK_FIXED` for a fixed solution; None if the file has no flag.
    """

    size: tuple[int, int]
    time: datetime | None = None
    latitude_deg: float = math.nan
    longitude_deg: float = math.nan
    altitude: float = math.nan
    yaw_deg: float = math.nan
    pitch_deg: float = math.nan
    roll_deg: float = math.nan
    sigma: FloatArray = field(default_factory=lambda: np.full(3, math.nan))
    rtk_flag: int | None = None

    @property
    def angles_deg(self) -> tuple[float, float, float]:
        """Yaw, pitch and roll in degrees."""
        return self.yaw_deg, self.pitch_deg, self.roll_deg


def read_metadata(path: str | Path) -> Metadata:
    """Return the metadata in the header of a JPEG file, without decoding the pixels.

    Raises
    ------
    FormatError
        If the file is not an image, or its XMP is damaged.
    """
    from PIL.JpegImagePlugin import jpeg_factory

    file = Path(path)
    try:
        # Image.open is avoided, because its pixel limit applies to the whole process.
        with file.open("rb") as stream, jpeg_factory(stream) as image:
            size, packet, exif = image.size, image.info.get("xmp", b""), image.getexif()
            tags = dict(exif.get_ifd(_EXIF_IFD))
    except FileNotFoundError:
        raise FormatError(file, "no such file; specify a photograph") from None
    except (OSError, SyntaxError, ValueError, LookupError, TypeError, struct.error) as error:
        text = str(error).split(":")[-1].strip() or "damaged"
        raise FormatError(file, f"not a readable image ({text}); copy it again") from None
    pixels = size[0] * size[1]
    check_count(file, pixels, PHOTOGRAPH_PIXELS, "pixels", "use a smaller photograph")
    values = _xmp(file, packet) if packet else {}

    def number(*names: str) -> float:
        for name in names:
            try:
                return float(values[name])
            except (KeyError, ValueError):
                continue
        return math.nan

    flag = number("RtkFlag")
    return Metadata(
        size=(int(size[0]), int(size[1])),
        time=_time(values, tags),
        latitude_deg=number("GpsLatitude"),
        # The firmware of some drones misspells this name.
        longitude_deg=number("GpsLongitude", "GpsLongtitude"),
        altitude=number("AbsoluteAltitude"),
        yaw_deg=number("GimbalYawDegree"),
        pitch_deg=number("GimbalPitchDegree"),
        roll_deg=number("GimbalRollDegree"),
        sigma=np.array([number("RtkStdLon"), number("RtkStdLat"), number("RtkStdHgt")]),
        rtk_flag=None if math.isnan(flag) else int(flag),
    )


def _xmp(file: Path, packet: bytes | str) -> dict[str, str]:
    """Return DJI's values and the creation date by name, from XML attributes or elements."""
    from lxml import etree

    data = packet.encode() if isinstance(packet, str) else packet
    parser = etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=False)
    try:
        root = etree.fromstring(data.strip(b"\0 \n\r\t"), parser)
    except etree.XMLSyntaxError as error:
        raise FormatError(file, f"its XMP is damaged ({error.msg}); copy it again") from None
    values: dict[str, str] = {}
    for description in root.iter(f"{{{_RDF}}}Description"):
        items = [(str(k), str(v)) for k, v in description.attrib.items()]
        items += [(str(child.tag), child.text or "") for child in description]
        for key, value in items:
            space, _, name = key.removeprefix("{").partition("}")
            if space == DJI or (space == _XAP and name == "CreateDate"):
                values[name] = value.strip()
    return values


def _time(values: dict[str, str], tags: dict[int, object]) -> datetime | None:
    """Return the time of exposure in UTC, from the most precise entry."""
    taken = str(tags.get(_TAKEN, "")).replace(":", "-", 2)
    part = str(tags.get(_SUBSECOND, "")).strip()
    taken += f".{part}" if taken and part.isdigit() else ""
    for text, zone in (
        (values.get("UTCAtExposure", ""), "+00:00"),
        (taken, str(tags.get(_OFFSET, ""))),
        (values.get("CreateDate", ""), ""),
    ):
        try:
            time = datetime.fromisoformat(text.strip() + zone.strip())
        except ValueError:
            continue
        if time.tzinfo is not None:
            return time.astimezone(UTC)
    return None


def exif_and_xmp(metadata: Metadata) -> tuple[bytes, bytes]:
    """Return an EXIF block and an XMP packet that contain ``metadata``."""
    from PIL import Image

    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Heliotrope", "rendered"
    stamp = ""
    if metadata.time is not None:
        utc = metadata.time.astimezone(UTC)
        stamp = utc.replace(tzinfo=None).isoformat(timespec="microseconds")
        exif.get_ifd(_EXIF_IFD)[_TAKEN] = utc.strftime("%Y:%m:%d %H:%M:%S")
        exif.get_ifd(_EXIF_IFD)[_OFFSET] = "+00:00"
        exif.get_ifd(_EXIF_IFD)[_SUBSECOND] = f"{utc.microsecond:06d}"
    values = {
        "GpsLatitude": f"{metadata.latitude_deg:+.10f}",
        "GpsLongitude": f"{metadata.longitude_deg:+.10f}",
        "AbsoluteAltitude": f"{metadata.altitude:+.4f}",
        "GimbalYawDegree": f"{metadata.yaw_deg:+.3f}",
        "GimbalPitchDegree": f"{metadata.pitch_deg:+.3f}",
        "GimbalRollDegree": f"{metadata.roll_deg:+.3f}",
        **({} if metadata.rtk_flag is None else {"RtkFlag": str(metadata.rtk_flag)}),
        "RtkStdLon": f"{metadata.sigma[0]:.5f}",
        "RtkStdLat": f"{metadata.sigma[1]:.5f}",
        "RtkStdHgt": f"{metadata.sigma[2]:.5f}",
        **({"UTCAtExposure": stamp} if stamp else {}),
    }
    inside = "".join(f' drone-dji:{name}="{value}"' for name, value in values.items())
    packet = (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        f'<rdf:RDF xmlns:rdf="{_RDF}"><rdf:Description rdf:about="" xmlns:drone-dji="{DJI}"'
        f'{inside}/></rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    )
    return exif.tobytes(), packet.encode()
