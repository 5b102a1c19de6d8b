"""The cluster file (TOML) with which a cluster controller starts; another file has its keys."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pydantic import Field

from heliotrope.cluster.config import MOST_MEMBERS, ClusterConfig, Member
from heliotrope.cluster.serial_bus import BusSettings
from heliotrope.errors import FormatError, InputError
from heliotrope.files.documents import read_document, read_toml
from heliotrope.links.addresses import Table, check_encryption, url_parts
from heliotrope.links.bus_key_file import read_bus_keys
from heliotrope.links.common_settings import CommonSettings
from heliotrope.links.gpsd import gpsd_at
from heliotrope.links.keys import HELIOSTATS, BrokerPassword, KeyRing, Keys
from heliotrope.safety import Limits
from heliotrope.sun import Site

_CHRONY = "chronyd now keeps the computer's clock"
#: Keys of ``[time]`` in the first edition, and what to do instead.
_OLD_TIME = {
    "source": f"{_CHRONY}, also with a receiver: remove the key, or state error_s for a clock that "
    f"you guarantee",
    "url": f'{_CHRONY}: configure the receiver\'s port in gpsd, and write gpsd = "localhost"',
    "baud_rate": f"{_CHRONY}: configure the baud rate in gpsd, and remove the key",
    "latency_s": f"{_CHRONY}: state the receiver's latency as the offset of chronyd's refclock, "
    "and remove the key",
    "system_tolerance_s": "the permitted difference between clock and receiver is fixed at 2 s; "
    "remove the key",
    "ntp": "the kernel is queried unless error_s is set; remove the key",
    "drift_ppm": "the kernel's bound grows by 500 ppm; remove the key",
}


class ClusterSiteTable(Table):
    """``[site]``: the ENU origin, and the atmosphere there."""

    latitude_deg: float = Field(ge=-90.0, le=90.0, description="North positive.")
    longitude_deg: float = Field(ge=-180.0, le=180.0, description="East positive.")
    height_m: float = Field(0.0, ge=-500.0, le=9000.0, description="Height above the ellipsoid.")
    pressure_pa: float | None = Field(
        None,
        ge=30e3,
        le=120e3,
        description="Air pressure at the site; default: computed from the height.",
    )
    temperature_c: float = Field(12.0, ge=-80.0, le=60.0, description="Air temperature.")
    delta_t_s: float | None = Field(None, description="TT − UT1; default: computed from the date.")


class BusTable(Table):
    """``[bus]``: the serial port to the heliostats."""

    url: str = Field(min_length=1, description="`/dev/ttyUSB0` or `socket://host:port`.")
    baud_rate: int = Field(115200, ge=1200, le=4_000_000, description="Bits per second.")
    echo: bool = Field(False, description="Whether the adapter also receives what it sends.")
    answer_s: float = Field(
        0.05,
        ge=0.001,
        le=1.0,
        description="Time limit from the end of a query to the complete reply.",
    )
    stored_answer_s: float = Field(
        0.6,
        ge=0.001,
        le=2.0,
        description="The same limit for queries whose reply follows a write to flash memory.",
    )


class PlantLinkTable(Table):
    """``[plant]``: the link to the central controller."""

    url: str = Field(
        min_length=1,
        description="`tcp://host:port`, `mqtt://host:port/prefix`, or `mqtts://…` with TLS.",
    )
    authority: str | None = Field(
        None,
        description="PEM file of the authority that signed the certificate of the plant or "
        "broker; with it, `tcp://` uses TLS.",
    )
    username: str | None = Field(
        None, description="User name at the MQTT broker; the password is in the key file."
    )
    unencrypted: bool = Field(
        False, description="Accept a connection without TLS to a plant on another machine."
    )


class TimeTable(Table):
    """``[time]``: the computer's clock, and how far it can be trusted."""

    error_s: float | None = Field(
        None,
        gt=0.0,
        le=0.5,
        description="Upper bound of the clock error, guaranteed by you; default: the bound that "
        "the kernel reports.",
    )
    gpsd: str = Field(
        "",
        description="`host` or `host:port` of gpsd, to display the state of the receiver and to "
        "check the clock.",
    )


class PollingTable(Table):
    """``[polling]``: times for polling the heliostats."""

    steps_every_s: int = Field(
        CommonSettings.steps_every,
        ge=1,
        le=60,
        description="Interval between requests for step counts.",
    )
    silence_s: float = Field(
        CommonSettings.silence,
        ge=2.0,
        le=3600.0,
        description="Time without a reply after which a heliostat is reported as silent.",
    )
    phase_s: float = Field(
        0.0,
        ge=0.0,
        lt=1.0,
        description="Delay between the GPS second and the cluster's broadcasts and queries.",
    )


class SafetyTable(Table):
    """``[safety]``: limits of the safety table."""

    longest_autonomy_s: float = Field(
        0.0,
        ge=0.0,
        le=86400.0,
        description="Longest autonomy that the plant may grant; above 0 only with a hard-wired "
        "emergency line.",
    )
    emergency_line: str = Field(
        "", description="GPIO file whose first byte is 1 while current flows in the emergency line."
    )
    bus_errors: dict[str, float] = Field(
        default_factory=dict, description="Settings of this safety condition, as in the plant file."
    )
    bus_failed: dict[str, float] = Field(default_factory=dict, description="The same.")
    clock_jump: dict[str, float] = Field(default_factory=dict, description="The same.")
    time_source_lost: dict[str, float] = Field(default_factory=dict, description="The same.")
    holdover_exhausted: dict[str, float] = Field(default_factory=dict, description="The same.")

    @property
    def limits(self) -> Limits:
        """The limits, by condition."""
        apart = ("emergency_line", "longest_autonomy_s")
        return self.model_dump(exclude_defaults=True, exclude=set(apart))


class MemberTable(Table):
    """``[[heliostats]]``: one table per heliostat, up to 32."""

    name: str = Field(min_length=1, description="Name by which the plant refers to the heliostat.")
    address: int = Field(ge=1, le=65534, description="Address on the bus.")
    serial: int | None = Field(
        None, ge=0, le=0xFFFFFFFF, description="Serial number of its local controller."
    )


class ClusterDocument(Table):
    """The whole cluster file."""

    format: Literal["heliotrope-cluster"]
    version: Literal[1]
    name: str = Field(min_length=1, description="Name by which the plant refers to the cluster.")
    keys: str = Field("", description="Path of the key file.")
    bus_key: str = Field(
        "",
        description="Path of the file with the bus key; default: frames are not signed.",
    )
    state: str = Field(
        "",
        description="Path of the file for the epoch and the editions; default: NAME.state.json.",
    )
    site: ClusterSiteTable
    bus: BusTable
    plant: PlantLinkTable
    time: TimeTable = Field(default_factory=TimeTable)  # type: ignore[arg-type]
    polling: PollingTable = Field(default_factory=PollingTable)  # type: ignore[arg-type]
    safety: SafetyTable = Field(default_factory=SafetyTable)  # type: ignore[arg-type]
    heliostats: list[MemberTable] = Field(min_length=1, max_length=MOST_MEMBERS)


#: The tables, for the reference and for hints.
TABLES: tuple[type[Table], ...] = (
    ClusterDocument, ClusterSiteTable, BusTable, PlantLinkTable, TimeTable, PollingTable,
    SafetyTable, MemberTable,
)  # fmt: skip


@dataclass(frozen=True)
class Installation:
    """An installed cluster: its configuration, and the addresses of its ports.

    Attributes
    ----------
    config
        See `ClusterConfig`.
    bus_url, bus
        URL and settings of the serial port.
    plant
        The table ``[plant]``.
    scheme, host, port, prefix
        Parts of the plant's URL; ``prefix`` is the prefix of MQTT topics.
    key_file
        Key file; None if there is none.
    bus_key_file, bus_keys
        File of the bus keys, and the keys, which `take_bus_keys` replaces; None if no frame is
        signed.
    plant_keys, password
        Keys of the link and password for the MQTT broker, which `take_keys` replaces.
    error
        Bound on the clock error that the operator guarantees, s; None if the kernel's bound is
        used.
    gpsd
        Host and port of gpsd; None if there is none.
    state
        File that stores epoch and editions.
    emergency_line
        GPIO file of the emergency line; None if there is no line.
    """

    config: ClusterConfig
    bus_url: str
    bus: BusSettings
    plant: PlantLinkTable
    scheme: str
    host: str
    port: int
    prefix: str
    key_file: Path | None
    bus_key_file: Path | None
    bus_keys: KeyRing | None = field(repr=False)
    plant_keys: KeyRing = field(repr=False)
    password: BrokerPassword
    error: float | None
    gpsd: tuple[str, int] | None
    state: Path
    emergency_line: Path | None

    def take_keys(self) -> None:
        """Read the key file again and update the link's keys; heliostat keys stay unchanged.

        Raises
        ------
        FormatError
            If the file cannot be used, or no longer contains the plant key.
        """
        keys = Keys(self.key_file, HELIOSTATS)
        if not keys.plant:
            raise FormatError(self.key_file, "its key is missing, but the link needs it", "plant")
        self.plant_keys.keys, self.password.word = keys.plant, keys.password

    def take_bus_keys(self) -> None:
        """Read the bus key file again.

        Raises
        ------
        FormatError
            If the file cannot be used.
        """
        if self.bus_key_file is not None and self.bus_keys is not None:
            self.bus_keys.keys = read_bus_keys(self.bus_key_file)


def read_cluster(path: str | Path) -> Installation:
    """Return the cluster described by a TOML file and its key file.

    Raises
    ------
    FormatError
        If an entry cannot be used; the text names the file, the entry, its value and the limit.
    """
    path = Path(path)
    _refuse_old(path)
    document = read_document(path, "cluster", ClusterDocument, TABLES)
    key_file = path.parent / document.keys if document.keys else None
    secrets = Keys(key_file, HELIOSTATS)
    try:
        return _install(path, document, key_file, secrets)
    except FormatError:
        raise
    except InputError as error:
        raise FormatError(path, str(error)) from None


def _refuse_old(path: Path) -> None:
    """Refuse keys of an earlier file format, and say what to write instead."""
    time = read_toml(path, "a cluster file").get("time")
    for key in time if isinstance(time, dict) else ():
        if key in _OLD_TIME:
            raise FormatError(path, _OLD_TIME[key], f"time.{key}")


def _install(
    path: Path, document: ClusterDocument, key_file: Path | None, secrets: Keys
) -> Installation:
    site, bus, polling = document.site, document.bus, document.polling
    names = [member.name for member in document.heliostats]
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
            Member(m.name, m.address, m.serial, *secrets.members.get(m.name, ()))
            for m in document.heliostats
        ),
        answer=bus.answer_s,
        stored_answer=bus.stored_answer_s,
        steps_every=polling.steps_every_s,
        silence=polling.silence_s,
        phase=polling.phase_s,
        longest_autonomy=document.safety.longest_autonomy_s,
        limits=document.safety.limits,
    )
    bus_key_file = path.parent / document.bus_key if document.bus_key else None
    line = document.safety.emergency_line
    scheme, host, port, prefix = url_parts(path, document.plant.url, "plant.url")
    encrypted = scheme == "mqtts" or (scheme == "tcp" and document.plant.authority is not None)
    check_encryption(path, host, "plant.url", encrypted or document.plant.unencrypted)
    return Installation(
        config=config,
        bus_url=bus.url,
        bus=BusSettings(baud_rate=bus.baud_rate, echo=bus.echo),
        plant=_placed(path, document.plant),
        scheme=scheme,
        host=host,
        port=port,
        prefix=prefix,
        key_file=key_file,
        bus_key_file=bus_key_file,
        bus_keys=None if bus_key_file is None else KeyRing(*read_bus_keys(bus_key_file)),
        plant_keys=KeyRing(*secrets.plant),
        password=BrokerPassword(secrets.password),
        error=document.time.error_s,
        gpsd=gpsd_at(path, document.time.gpsd, "time.gpsd") if document.time.gpsd else None,
        state=path.parent / (document.state or f"{document.name}.state.json"),
        emergency_line=path.parent / line if line else None,
    )


def _placed(path: Path, table: PlantLinkTable) -> PlantLinkTable:
    """Return a table whose file paths are relative to the folder of the cluster file."""
    if table.authority is None:
        return table
    return table.model_copy(update={"authority": str(path.parent / table.authority)})
