"""The file that a cluster controller starts from (TOML), and its keys beside it.

Addresses, sites and limits may be shared and kept under version control; keys may not: they stand
in a file of their own that nobody else may read.
"""

import string
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field

from heliotrope.cluster.config import MOST_MEMBERS, ClusterConfig, Member
from heliotrope.cluster.gpsd import PORT
from heliotrope.cluster.serial_bus import BusSettings
from heliotrope.errors import FormatError, InputError
from heliotrope.files.documents import read_document, read_toml
from heliotrope.sun import Site

_SHORTEST_KEY, _LONGEST_KEY = 16, 64
_OTHERS = 0o077
_MISSING = {
    "heliostats": "the cluster has no such heliostat",
    "clusters": "the plant has no such cluster",
}
_CHRONY = "the computer's clock is kept by chronyd now"
#: Keys of ``[time]`` up to the first edition, and what to do instead.
_OLD_TIME = {
    "source": f"{_CHRONY}, from a receiver too: remove the key, or state error_s for a clock that "
    "you vouch for",
    "url": f'{_CHRONY}: give the receiver\'s port to gpsd, and write gpsd = "localhost"',
    "baud_rate": f"{_CHRONY}: give the baud rate to gpsd, and remove the key",
    "latency_s": f"{_CHRONY}: state the receiver's latency as offset of chronyd's refclock, and "
    "remove the key",
    "system_tolerance_s": "clock and receiver may always be 2 s apart; remove the key",
    "ntp": "the kernel is asked unless error_s is stated; remove the key",
    "drift_ppm": "the kernel's bound grows by 500 ppm; remove the key",
}
_PORTS = {"tcp": None, "mqtt": 1883, "mqtts": 8883}


class Table(BaseModel):
    """A table of the file: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class SiteTable(Table):
    """``[site]``: the origin of ENU, and its air."""

    latitude_deg: float = Field(ge=-90.0, le=90.0, description="North positive.")
    longitude_deg: float = Field(ge=-180.0, le=180.0, description="East positive.")
    height_m: float = Field(0.0, ge=-500.0, le=9000.0, description="Above the ellipsoid.")
    pressure_pa: float | None = Field(
        None, ge=30e3, le=120e3, description="At the site; default from the height."
    )
    temperature_c: float = Field(12.0, ge=-80.0, le=60.0, description="Of the air.")
    delta_t_s: float | None = Field(None, description="TT − UT1; default from the date.")


class BusTable(Table):
    """``[bus]``: the serial port to the heliostats."""

    url: str = Field(min_length=1, description="`/dev/ttyUSB0` or `socket://host:port`.")
    baud_rate: int = Field(115200, ge=1200, le=4_000_000, description="Bits in a second.")
    echo: bool = Field(False, description="The adapter hears its own frames.")
    answer_s: float = Field(
        0.05,
        ge=0.001,
        le=1.0,
        description="Longest time from the end of a question to the whole answer.",
    )
    stored_answer_s: float = Field(
        0.6, ge=0.001, le=2.0, description="The same where flash is written before the answer."
    )


class PlantTable(Table):
    """``[plant]``: the link to the central controller."""

    url: str = Field(
        min_length=1,
        description="`tcp://host:port`, `mqtt://host:port/prefix`, or `mqtts://…` with TLS.",
    )
    authority: str | None = Field(
        None, description="PEM file of who signs the other end's certificate: TLS for `tcp://`."
    )
    username: str | None = Field(None, description="At the MQTT broker; password: the keys' file.")


class TimeTable(Table):
    """``[time]``: the computer's clock, and how far it is believed."""

    error_s: float | None = Field(
        None,
        gt=0.0,
        le=0.5,
        description="Bound of the clock's error that you vouch for; default: ask the kernel.",
    )
    gpsd: str = Field(
        "",
        description="`host` or `host:port` of gpsd, to show the receiver and to check the clock.",
    )


class PollingTable(Table):
    """``[polling]``."""

    steps_every_s: int = Field(1, ge=1, le=60, description="Between questions for step counts.")
    silence_s: float = Field(
        10.0, ge=2.0, le=3600.0, description="A heliostat not heard for so long is reported."
    )
    phase_s: float = Field(0.0, ge=0.0, lt=1.0, description="Of the seconds, after those of GPS.")


class SafetyTable(Table):
    """``[safety]``."""

    longest_autonomy_s: float = Field(
        0.0,
        ge=0.0,
        le=86400.0,
        description="Most that the plant may grant; above 0 only with a hard-wired emergency line.",
    )
    emergency_line: str = Field(
        "", description="File whose first byte is 1 while current flows in the line (GPIO)."
    )


class HeliostatTable(Table):
    """``[[heliostats]]``: one for each, up to 32."""

    name: str = Field(min_length=1, description="As the plant knows it.")
    address: int = Field(ge=1, le=65534, description="On the bus.")
    serial: int | None = Field(
        None, ge=0, le=0xFFFFFFFF, description="Of its local controller, to be found by."
    )


class ClusterDocument(Table):
    """The whole file."""

    format: Literal["heliotrope-cluster"]
    version: Literal[1]
    name: str = Field(min_length=1, description="Of the cluster, as the plant knows it.")
    keys: str = Field("", description="File of the keys, beside this one.")
    state: str = Field(
        "", description="File for epoch and editions, beside this one; default NAME.state.json."
    )
    site: SiteTable
    bus: BusTable
    plant: PlantTable
    time: TimeTable = Field(default_factory=TimeTable)  # type: ignore[arg-type]
    polling: PollingTable = Field(default_factory=PollingTable)  # type: ignore[arg-type]
    safety: SafetyTable = Field(default_factory=SafetyTable)  # type: ignore[arg-type]
    heliostats: list[HeliostatTable] = Field(min_length=1, max_length=MOST_MEMBERS)


#: The tables, for the reference and for hints.
TABLES: tuple[type[Table], ...] = (
    ClusterDocument, SiteTable, BusTable, PlantTable, TimeTable, PollingTable, SafetyTable,
    HeliostatTable,
)  # fmt: skip


@dataclass(frozen=True)
class Installation:
    """A cluster as it is installed: what it is, and where its ports lead.

    Attributes
    ----------
    config
        See `ClusterConfig`.
    bus_url, bus
        Of the serial port.
    plant
        ``[plant]``.
    scheme, host, port, prefix
        Of the plant's URL; ``prefix`` of MQTT topics.
    plant_key, password
        Of the link; of the MQTT broker.
    error
        Bound of the clock's error that the operator vouches for, s; None: the kernel's is asked.
    gpsd
        Host and port of gpsd; None: there is none.
    state
        File for epoch and editions.
    emergency_line
        File of the line's GPIO; None: there is no line.
    """

    config: ClusterConfig
    bus_url: str
    bus: BusSettings
    plant: PlantTable
    scheme: str
    host: str
    port: int
    prefix: str
    plant_key: bytes
    password: str
    error: float | None
    gpsd: tuple[str, int] | None
    state: Path
    emergency_line: Path | None


def read_cluster(path: str | Path) -> Installation:
    """Return the cluster of a TOML file and its keys.

    Raises
    ------
    FormatError
        If something cannot be used; the text names file, place, value and limit.
    """
    path = Path(path)
    _refuse_old(path)
    document = read_document(path, "cluster", ClusterDocument, TABLES)
    secrets = Keys(path.parent / document.keys if document.keys else None, "heliostats")
    try:
        return _install(path, document, secrets)
    except FormatError:
        raise
    except InputError as error:
        raise FormatError(path, str(error)) from None


def _refuse_old(path: Path) -> None:
    """Refuse keys of a former format with what to write instead."""
    time = read_toml(path, "a cluster file").get("time")
    for key in time if isinstance(time, dict) else ():
        if key in _OLD_TIME:
            raise FormatError(path, _OLD_TIME[key], f"time.{key}")


def _install(path: Path, document: ClusterDocument, secrets: "Keys") -> Installation:
    site, bus, polling = document.site, document.bus, document.polling
    names = [each.name for each in document.heliostats]
    secrets.check(names)
    config = ClusterConfig(
        name=document.name,
        site=Site(
            site.latitude_deg,
            site.longitude_deg,
            site.height_m,
            site.pressure_pa,
            site.temperature_c,
            document.name,
            site.delta_t_s,
        ),
        heliostats=tuple(
            Member(each.name, each.address, each.serial, secrets.members.get(each.name, b""))
            for each in document.heliostats
        ),
        answer=bus.answer_s,
        stored_answer=bus.stored_answer_s,
        steps_every=polling.steps_every_s,
        silence=polling.silence_s,
        phase=polling.phase_s,
        longest_autonomy=document.safety.longest_autonomy_s,
    )
    line = document.safety.emergency_line
    scheme, host, port, prefix = url_parts(path, document.plant.url, "plant.url")
    return Installation(
        config=config,
        bus_url=bus.url,
        bus=BusSettings(baud_rate=bus.baud_rate, echo=bus.echo),
        plant=document.plant,
        scheme=scheme,
        host=host,
        port=port,
        prefix=prefix,
        plant_key=secrets.plant,
        password=secrets.password,
        error=document.time.error_s,
        gpsd=_gpsd_at(path, document.time.gpsd),
        state=path.parent / (document.state or f"{document.name}.state.json"),
        emergency_line=path.parent / line if line else None,
    )


def _gpsd_at(path: Path, text: str) -> tuple[str, int] | None:
    """Return host and port of gpsd, None if there is none."""
    if not text:
        return None
    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname, parts.port or PORT
    except ValueError:
        host = None
    if not host or parts.path:
        raise FormatError(path, f"{text!r}: give host or host:port of gpsd", "time.gpsd")
    return host, port


def url_parts(path: Path, url: str, where: str) -> tuple[str, str, int, str]:
    """Return scheme, host, port and prefix of a link's URL, which stands in a file at a place.

    Raises
    ------
    FormatError
        If it is none, or lacks a part.
    """
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise FormatError(path, f"{url!r} is no URL; give tcp://host:port", where) from None
    if parts.scheme not in _PORTS or not parts.hostname:
        raise FormatError(
            path,
            f"{url!r}: give tcp://host:port, mqtt://host/prefix or mqtts://host/prefix",
            where,
        )
    port = port or _PORTS[parts.scheme]
    prefix = parts.path.strip("/")
    if port is None or (parts.scheme != "tcp" and not prefix):
        missing = "port: tcp://host:port" if port is None else "prefix: mqtt://host/prefix"
        raise FormatError(path, f"{url!r} has no {missing}", where)
    return parts.scheme, parts.hostname, port, prefix


class Keys:
    """A keys' file: ``plant``, ``password`` and a table of keys, all in hexadecimal.

    Parameters
    ----------
    path
        None: there is none, and no key.
    table
        Name of the table: "heliostats" of a cluster, "clusters" of a plant.

    Attributes
    ----------
    plant, password
        b"" and "" if they are not given.
    members
        Keys of the table by name.

    Raises
    ------
    FormatError
        A file that others may read, or that holds what is no key.
    """

    def __init__(self, path: Path | None, table: str) -> None:
        self._path, self._table = path, table
        self.plant, self.password = b"", ""
        self.members: dict[str, bytes] = {}
        if path is None:
            return
        # An empty one has no keys; who lacks theirs is named later.
        empty = path.is_file() and path.stat().st_size == 0
        raw = {} if empty else read_toml(path, "a file of keys")
        if path.stat().st_mode & _OTHERS:
            mode = path.stat().st_mode & 0o777
            raise FormatError(path, f"others may read it (mode {mode:o}); say chmod 600")
        for key in raw:
            if key not in ("plant", "password", table):
                raise FormatError(path, f"{key!r} is not known; give plant, password, {table}")
        if "plant" in raw:
            self.plant = self._key("plant", raw["plant"])
        password, keys = raw.get("password", ""), raw.get(table, {})
        if not isinstance(password, str) or not isinstance(keys, dict):
            raise FormatError(path, f"password must be a text, and {table} a table of keys")
        self.password = password
        self.members = {name: self._key(name, value) for name, value in keys.items()}

    def _key(self, name: str, value: object) -> bytes:
        text = value if isinstance(value, str) else ""
        good = set(text) <= set(string.hexdigits) and len(text) % 2 == 0
        if not (good and _SHORTEST_KEY <= len(text) // 2 <= _LONGEST_KEY):
            # The value itself is not told: it would stand in a log.
            raise FormatError(
                self._path,
                f"a key of {len(text)} characters; give {_SHORTEST_KEY} to "
                f"{_LONGEST_KEY} bytes in hexadecimal, as of: openssl rand -hex 32",
                name,
            )
        return bytes.fromhex(text)

    def check(self, names: list[str]) -> None:
        """Refuse keys of those that are not there."""
        for name in self.members:
            if name not in names:
                close = get_close_matches(name, names, n=1)
                hint = f"; did you mean {close[0]!r}?" if close else "; remove it"
                raise FormatError(
                    self._path, f"{_MISSING[self._table]}{hint}", f"{self._table}.{name}"
                )
