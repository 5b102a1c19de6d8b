"""The links file: how a plant reaches its clusters, and the resulting links.

A cluster is reached in one of three ways: it connects to this plant over TCP, it meets the plant at
an MQTT broker, or its bus is attached to this computer and its cluster file is specified. In the
last case the program that builds the plant also runs the cluster program in this process
(`cluster.program`) and adds its link. Keys are in a separate file that nobody else may read.
"""

import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

from pydantic import Field

from heliotrope.errors import FormatError
from heliotrope.files.documents import read_document
from heliotrope.imaging.receiver_file import read_reference
from heliotrope.imaging.receiver_light import ReceiverReference
from heliotrope.links.addresses import Table, check_encryption, url_parts
from heliotrope.links.clock import Clock
from heliotrope.links.common_settings import CommonSettings
from heliotrope.links.connection import CarriedLink
from heliotrope.links.gpsd import Gpsd, gpsd_at
from heliotrope.links.keys import CLUSTERS, BrokerPassword, KeyRing, Keys
from heliotrope.links.link import Link
from heliotrope.links.mqtt import Broker, mqtt_link
from heliotrope.links.papers import Papers, authority_of
from heliotrope.links.tcp import TcpServer
from heliotrope.links.tls import RenewedTls, TlsSource, server_tls
from heliotrope.plant.field.witnesses import PHOTOGRAPHS, SatelliteWitness, SunSensorFile, Witness
from heliotrope.plant.io.sensors import FED, SensorFiles
from heliotrope.safety import FLUX_READING


class TcpTable(Table):
    """``[tcp]``: where clusters connect to this plant."""

    listen: str = Field(
        min_length=3, description="`address:port` on this computer at which clusters connect."
    )
    certificate: str | None = Field(
        None, description="PEM file of the certificate; together with `key`, switches TLS on."
    )
    key: str | None = Field(None, description="PEM file of the certificate's key.")
    authority: str | None = Field(
        None,
        description="PEM file of the authority that signs clusters' certificates; "
        "default: clusters need no certificate.",
    )
    unencrypted: bool = Field(
        False, description="Accept connections from other computers without TLS."
    )


class MqttTable(Table):
    """``[mqtt]``: the broker through which clusters are reached."""

    url: str = Field(min_length=1, description="`mqtt://host:port/prefix`, or `mqtts://…` (TLS).")
    username: str | None = Field(
        None, description="User name at the broker; the password is in the key file."
    )
    authority: str | None = Field(
        None,
        description="PEM file of the authority that signs the broker's certificate; "
        "default: the system's.",
    )
    unencrypted: bool = Field(False, description="Accept a broker on another computer without TLS.")


class WitnessTable(Table):
    """``[witness]``: sources of the sun's direction independent of the plant's clocks and site."""

    gpsd: str = Field(
        "",
        description="`host` or `host:port` of the gpsd whose satellite receiver is at the plant.",
    )
    sun_sensor: str = Field(
        "",
        description="File beside this one that contains azimuth and elevation of the sun in "
        "degrees; the sensor's program replaces it for each reading.",
    )
    photographs: bool = Field(
        False, description="Whether photographs of beams on targets count as a witness."
    )
    none: bool = Field(
        False,
        description="Accept that there is no witness; otherwise the plant reports this once a day.",
    )


class ExpectedPolling(Table):
    """``[polling]``: the values that every cluster file of this plant has in ``[polling]``."""

    steps_every_s: int = Field(
        CommonSettings.steps_every,
        ge=1,
        le=60,
        description="Interval between polls for step counts, s.",
    )
    silence_s: float = Field(
        CommonSettings.silence,
        ge=2.0,
        le=3600.0,
        description="A heliostat that is silent for longer (s) is reported.",
    )


class LinksDocument(Table):
    """The whole file."""

    format: Literal["heliotrope-links"]
    version: Literal[1]
    keys: str = Field("", description="Key file, beside this one.")
    tcp: TcpTable | None = None
    mqtt: MqttTable | None = None
    polling: ExpectedPolling = Field(
        default_factory=ExpectedPolling,  # type: ignore[arg-type]
        description="Values that every cluster file of this plant should have in its table "
        "of that name.",
    )
    firmware: int | None = Field(
        None,
        ge=0,
        le=0xFFFF,
        description="Firmware version that every board should have; default: not compared.",
    )
    witness: WitnessTable = Field(
        default_factory=WitnessTable,  # type: ignore[arg-type]
        description="Witnesses that see the sun independently of the plant's clocks and site.",
    )
    sensors: dict[str, str] = Field(
        default_factory=dict,
        description="Source of each reading of the safety table, and of `dni` (W/m²): a file with "
        'one number, or `"api"`; for `receiver_flux_nominal` also `"camera"`.',
    )
    receiver_light: str = Field(
        "", description='Reference file of the receiver camera, beside this file; for `"camera"`.'
    )
    twin: str = Field(
        "",
        description="Address of a simulated field, whose clock the plant follows. Every cluster "
        "must then be `tcp`, and no witness is allowed.",
    )
    clusters: dict[str, str] = Field(
        min_length=1,
        description='For each cluster: `"tcp"`, `"mqtt"`, or the cluster file of a local bus.',
    )


#: Value that says, in place of a file name, that programs supply a reading.
GIVEN = "api"
#: Value that says that the receiver's camera measures its flux.
CAMERA = "camera"
#: The tables, for the reference and for hints.
TABLES: tuple[type[Table], ...] = (
    LinksDocument,
    TcpTable,
    MqttTable,
    WitnessTable,
    ExpectedPolling,
)


@dataclass(frozen=True)
class LinksFile:
    """A links file after reading.

    Attributes
    ----------
    path
        Links file; other files are in the same folder.
    document
        Its tables.
    keys
        Keys, by cluster; they are replaced while the links run if the key file changes.
    password
        Password for the broker; it is replaced like the keys.
    """

    path: Path
    document: LinksDocument
    keys: Mapping[str, KeyRing] = field(repr=False)
    password: BrokerPassword

    def check(self, homes: Mapping[str, tuple[str, ...]]) -> None:
        """Check that the file names every cluster of a plant, and no others.

        Parameters
        ----------
        homes
            Heliostats of each cluster, from `plant.settings.clusters_of`.

        Raises
        ------
        FormatError
            If a cluster has no link, a link has no cluster, or a key is missing.
        """
        for name in homes:
            if name not in self.document.clusters:
                raise FormatError(
                    self.path,
                    f"the plant has a cluster {name} of {len(homes[name])} heliostats, but no line "
                    "says how to connect to it; add one",
                    "clusters",
                )
        for name in self.document.clusters:
            if name not in homes:
                raise FormatError(
                    self.path,
                    f"the plant has no cluster {name}; it has {', '.join(homes)}",
                    "clusters",
                )
        for name, how in self.document.clusters.items():
            if how == "mqtt" and name not in self.keys:
                raise _keyless(self.path, name)

    def build(self, homes: Mapping[str, tuple[str, ...]], clock: Clock) -> "PlantLinks":
        """Return the plant's ends of the links, and the tasks that must run beside them.

        Raises
        ------
        FormatError
            See `check`.
        InputError
            If certificates cannot be used.
        """
        self.check(homes)
        made = PlantLinks(Papers(clock))
        folder = self.path.parent
        if self.document.keys:
            made.papers.renew("key file", [folder / self.document.keys], self._take_keys)
        sensors = self.document.sensors
        files = {n: folder / f for n, f in sensors.items() if f not in (GIVEN, CAMERA)}
        made.sensors = SensorFiles(files)
        if self.document.receiver_light:
            made.light = read_reference(folder / self.document.receiver_light)
        made.given = frozenset(n for n, f in sensors.items() if f == GIVEN)
        self._call(made, clock)
        made.firmware = self.document.firmware
        made.twin = self.document.twin
        polling = self.document.polling
        made.common = CommonSettings(polling.steps_every_s, polling.silence_s)
        served = {n: self.keys[n] for n, how in self.document.clusters.items() if how == "tcp"}
        if served:
            self._serve(made, served, clock)
        for name, how in self.document.clusters.items():
            if how == "mqtt":
                made.links[name] = self._meet(name, clock, made.papers)
                made.parts.append(made.links[name])
            elif how != "tcp":
                made.local[name] = folder / how
        return made

    def _call(self, made: "PlantLinks", clock: Clock) -> None:
        """Create the connections to the sun witnesses."""
        table, names = self.document.witness, set()
        if table.gpsd:
            gpsd = Gpsd(clock, *gpsd_at(self.path, table.gpsd, "witness.gpsd"))
            made.parts.append(gpsd)
            made.witnesses.append(SatelliteWitness(gpsd, clock))
        if table.sun_sensor:
            made.witnesses.append(SunSensorFile(self.path.parent / table.sun_sensor))
        if table.photographs:
            names.add(PHOTOGRAPHS)
        names.update(witness.name for witness in made.witnesses)
        made.witnessed = None if table.none else frozenset(names)

    def _take_keys(self) -> None:
        """Read the key file again, and update the keys of the links."""
        path = self.path.parent / self.document.keys
        result = _keys_of(path, self.document)
        for name in self.keys:
            if name not in result.members:
                raise FormatError(
                    path, "its key is missing, but the links need it", f"clusters.{name}"
                )
        for name, ring in self.keys.items():
            ring.keys = result.members[name]
        self.password.word = result.password

    def _serve(self, made: "PlantLinks", keys: Mapping[str, KeyRing], clock: Clock) -> None:
        table = self.document.tcp
        assert table is not None
        tls = None
        if table.certificate and table.key:
            folder = self.path.parent
            own = folder / table.certificate, folder / table.key
            authority = folder / table.authority if table.authority else None
            tls = RenewedTls(lambda: server_tls(*own, authority))
            files = [*own] if authority is None else [*own, authority]
            made.papers.renew("certificate of the cluster port", files, tls.renew)
            made.papers.watch_end(own[0])
            if authority is not None:
                made.papers.watch_end(authority)
        host, port = _listen(self.path, table.listen)
        made.server = TcpServer(host, port, keys, clock, tls=tls)
        made.links.update(made.server.links)
        made.parts.append(made.server)

    def _meet(self, name: str, clock: Clock, papers: Papers) -> CarriedLink:
        table = self.document.mqtt
        assert table is not None
        scheme, host, port, prefix = url_parts(self.path, table.url, "mqtt.url")
        tls: TlsSource = None
        if scheme == "mqtts":
            tls = ssl.create_default_context()
            if table.authority is not None:
                tls = authority_of(papers, self.path.parent / table.authority)
        broker = Broker(host, port, table.username, self.password, tls)
        return mqtt_link(broker, prefix, name, self.keys[name], clock, plant=True)


@dataclass
class PlantLinks:
    """The plant's ends of its links.

    Attributes
    ----------
    papers
        Keys and certificates of the links, to be monitored while the plant runs.
    links
        Links over TCP and MQTT, by cluster.
    parts
        Tasks to run beside the plant.
    local
        Cluster files of clusters whose bus is attached to this computer, by cluster; these clusters
        have no link yet.
    server
        Server that clusters connect to; None if no cluster connects in this way.
    sensors
        Readings of the safety table from files.
    given
        Readings of the safety table that programs supply through the HTTP API.
    common
        Settings that every cluster should have, as far as this file contains them.
    witnesses, witnessed
        Independent witnesses of the sun, and the names of all that count, as in
        `PlantSettings.witnesses`.
    firmware
        Version that every board should have; None: versions are not compared.
    light
        Reference for measuring the flux on the receiver with its camera; None: the flux is not
        measured.
    twin
        Address of the simulated field; "" for a real field.
    """

    papers: Papers
    links: dict[str, Link] = field(default_factory=dict)
    parts: list[Any] = field(default_factory=list)
    local: dict[str, Path] = field(default_factory=dict)
    server: TcpServer | None = None
    sensors: SensorFiles = field(default_factory=lambda: SensorFiles({}))
    given: frozenset[str] = frozenset()
    common: CommonSettings = field(default_factory=CommonSettings)
    light: ReceiverReference | None = None
    witnesses: list[Witness] = field(default_factory=list)
    witnessed: frozenset[str] | None = frozenset()
    firmware: int | None = None
    twin: str = ""

    def facts(self) -> dict[str, str]:
        """Return the last refused connection, and the new keys that are not in use, by name."""
        result = {}
        if self.server is not None and self.server.refused:
            message = f"{self.server.last_refusal} ({self.server.refused} so far)"
            result["refused link"] = message
        behind = [
            name
            for name, link in self.links.items()
            if isinstance(link, CarriedLink) and link.behind
        ]
        if behind:
            result["old key still used"] = ", ".join(behind)
        return result


def read_links(path: str | Path) -> LinksFile:
    """Return a links file with its keys.

    Raises
    ------
    FormatError
        If the file cannot be used; the text names file, place, value and limit.
    """
    path = Path(path)
    document = read_document(path, "links", LinksDocument, TABLES)
    keys = _keys_of(path.parent / document.keys if document.keys else None, document)
    rings = {name: KeyRing(*item) for name, item in keys.members.items()}
    result = LinksFile(path, document, rings, BrokerPassword(keys.password))
    _check(result)
    return result


def _keys_of(path: Path | None, document: LinksDocument) -> Keys:
    keys = Keys(path, CLUSTERS)
    keys.check(list(document.clusters))
    return keys


def _check(found: LinksFile) -> None:
    path, document = found.path, found.document
    for name in document.sensors:
        if name not in FED:
            raise FormatError(
                path,
                f"there is no such reading; use one of {', '.join(sorted(FED))}",
                f"sensors.{name}",
            )
    by_camera = [name for name, how in document.sensors.items() if how == CAMERA]
    for name in by_camera:
        if name != FLUX_READING:
            raise FormatError(
                path,
                f"a camera supplies {FLUX_READING} only; name a file instead",
                f"sensors.{name}",
            )
    if bool(by_camera) != bool(document.receiver_light):
        raise FormatError(
            path,
            f'{FLUX_READING} = "camera" and receiver_light, the reference of that camera, must be '
            "set together; record a reference with heliotrope camera receiver",
            "receiver_light",
        )
    seen_by = document.witness
    if seen_by.none and (seen_by.gpsd or seen_by.sun_sensor or seen_by.photographs):
        raise FormatError(
            path,
            "it names a witness, but none = true says that there is no witness; "
            "remove one of the two",
            "witness",
        )
    if document.twin:
        _check_simulated(path, document)
    ways = set(document.clusters.values())
    for way, table in (("tcp", document.tcp), ("mqtt", document.mqtt)):
        if way in ways and table is None:
            raise FormatError(
                path, f"some clusters are connected by {way}; add a table [{way}]", way
            )
    for name, how in document.clusters.items():
        if not name.strip() or not how.strip():
            raise FormatError(
                path, "a cluster has no name or no connection; specify both", "clusters"
            )
        if how == "tcp" and name not in found.keys:
            raise _keyless(path, name)
        if how not in ("tcp", "mqtt") and not (path.parent / how).is_file():
            raise FormatError(
                path,
                f'{how!r}: not a connection, and no such file; specify "tcp", "mqtt", or the '
                "cluster file of a bus on this computer",
                f"clusters.{name}",
            )
    _check_encrypted(path, document)


def _check_encrypted(path: Path, document: LinksDocument) -> None:
    """Refuse links to other computers without TLS, unless the file accepts them."""
    if document.tcp is not None:
        host, _ = _listen(path, document.tcp.listen)
        encrypted = document.tcp.certificate is not None
        check_encryption(path, host, "tcp.listen", encrypted or document.tcp.unencrypted)
        if (document.tcp.certificate is None) != (document.tcp.key is None):
            raise FormatError(path, "TLS needs both certificate and key; specify both", "tcp")
    if document.mqtt is not None:
        scheme, host, _, _ = url_parts(path, document.mqtt.url, "mqtt.url")
        if scheme == "tcp":
            raise FormatError(path, "specify mqtt://host/prefix or mqtts://host/prefix", "mqtt.url")
        encrypted = scheme == "mqtts"
        check_encryption(path, host, "mqtt.url", encrypted or document.mqtt.unencrypted)


def _check_simulated(path: Path, document: LinksDocument) -> None:
    """Refuse links to real equipment in a plant that follows a simulated field's clock."""
    for name, how in document.clusters.items():
        if how != "tcp":
            raise FormatError(
                path,
                f"{how!r} together with twin: a plant that follows the clock of a simulated field "
                'must not command real heliostats; remove twin, or specify "tcp"',
                f"clusters.{name}",
            )
    if not document.witness.none:
        raise FormatError(
            path, "a witness cannot see the sun of a simulated field; set none = true", "witness"
        )


def _keyless(path: Path, name: str) -> FormatError:
    return FormatError(
        path,
        "a cluster and its plant authenticate each other with a key; create one with "
        "heliotrope keys new",
        f"clusters.{name}",
    )


def _listen(path: Path, text: str) -> tuple[str, int]:
    """Return the address and the port in ``[tcp].listen``."""
    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not host or port is None:
        raise FormatError(
            path, f"{text!r}: specify address:port, such as 0.0.0.0:4840", "tcp.listen"
        )
    return host, port
