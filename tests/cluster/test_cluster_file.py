"""The cluster's file and its keys, and the parts of a cluster that stand alone."""

import ctypes
import json
import math
import re
import shutil
import stat
import tomllib
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from heliotrope import safety
from heliotrope.cli.cluster import _link
from heliotrope.cluster import timekeeping
from heliotrope.cluster._nodes import NODE, STATUS, STEPS, Nodes
from heliotrope.cluster.config import ClusterConfig, Member, spread_phase
from heliotrope.cluster.config_file import TABLES, SafetyTable, read_cluster
from heliotrope.cluster.memory import Kept
from heliotrope.cluster.program import line_of, time_of
from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.lcu import messages, wire
from heliotrope.links.bus_key_file import BusKeyFile
from heliotrope.links.clock import SystemClock, VirtualClock
from heliotrope.links.papers import Papers
from support.clusters import SITE, config_of

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "cluster"
URAD = 1e-6


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("C1.toml", "C1.keys.toml"):
        shutil.copy(EXAMPLE / name, tmp_path / name)
    (tmp_path / "C1.keys.toml").chmod(0o600)
    return tmp_path


def changed(folder: Path, old: str, new: str, name: str = "C1.toml") -> Path:
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new))
    return folder / "C1.toml"


def test_the_example_is_read(folder: Path) -> None:
    found = read_cluster(folder / "C1.toml")
    config = found.config
    assert [member.name for member in config.heliostats] == ["AA1", "AA2", "AA3"]
    assert config.heliostats[1].key == bytes(range(0x20, 0x40))
    assert (found.scheme, found.host, found.port) == ("tcp", "10.0.0.2", 4840)
    assert (found.error, found.gpsd) == (None, ("localhost", 2947))
    assert found.bus.baud_rate == 115200
    assert found.state == folder / "C1.state.json"
    assert config.longest_autonomy == 0.0
    assert config.site.latitude_deg == -33.9281
    assert config.member("AA3").address == 3
    with pytest.raises(UnknownNameError, match="there is no heliostat 'AA4'"):
        config.member("AA4")


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("heliotrope-cluster", "heliotrope-plant", "format is 'heliotrope-plant'"),
        ("version = 1", "version = 2", "version: 2: input should be 1"),
        ("baud_rate = 115200", "baud = 115200", "bus.baud: 'baud' is not known; did you mean"),
        ("baud_rate = 115200", "baud_rate = 1", "bus.baud_rate: 1: input should be greater"),
        ('name = "AA2"', 'name = ""', "heliostats.1.name: '': string should have at least 1"),
        ("address = 2", "address = 1", "two heliostats have the address 1"),
        ("serial = 1002", "serial = 1001", "two heliostats have the serial 1001"),
        ("address = 2\n", "", "heliostats.1.address: 'address' is missing"),
        ("tcp://10.0.0.2:4840", "tcp://10.0.0.2", "has no port"),
        ("tcp://10.0.0.2:4840", "mqtt://10.0.0.2", "has no prefix"),
        ("unencrypted = true", "", "plant.url: 10.0.0.2 is not this machine, and the link is not"),
        ("tcp://10.0.0.2:4840", "http://10.0.0.2:80", "use tcp://host:port, mqtt://"),
        ("tcp://10.0.0.2:4840", "tcp://host:99999", "is not a URL"),
        ("[time]", "[time]\nerror_s = 0.6", "time.error_s: 0.6: input should be less than"),
        ("[time]", "[time]\nerror_s = 0", "time.error_s: 0: input should be greater than 0"),
        ('"localhost"', '"localhost:0x"', "time.gpsd: 'localhost:0x': specify host or host:port"),
        ('"localhost"', '"tcp://localhost"', "time.gpsd: 'tcp://localhost': specify host or"),
        (
            "[time]",
            '[time]\nsource = "gps"',
            "time.source: chronyd now keeps the computer's clock",
        ),
        ("[time]", '[time]\nurl = "/dev/ttyACM0"', 'write gpsd = "localhost"'),
        (
            "[time]",
            "[time]\nbaud_rate = 9600",
            "time.baud_rate: chronyd now keeps the computer's clock: configure the baud",
        ),
        ("[time]", "[time]\nlatency_s = 0.5", "offset of chronyd's refclock"),
        (
            "[time]",
            "[time]\nsystem_tolerance_s = 0",
            "fixed at 2 s; remove the key",
        ),
        ("[time]", "[time]\nntp = true", "time.ntp: the kernel is queried unless error_s is set"),
        ("[time]", "[time]\ndrift_ppm = 50", "time.drift_ppm: the kernel's bound grows by 500 ppm"),
        ("latitude_deg = -33.9281", "latitude_deg = 133", "site.latitude_deg: 133"),
        ("[site] ", "[site", "not valid TOML"),
        ('"C1.keys.toml" ', '"none.toml" ', "none.toml: no such file"),
        ("version = 1\n", "version = 1\nkeys2 = 3\n", "'keys2' is not known; did you mean 'keys'"),
    ],
)
def test_what_is_wrong_in_the_file_is_named(folder: Path, old: str, new: str, text: str) -> None:
    with pytest.raises(FormatError) as caught:
        read_cluster(changed(folder, old, new))
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('AA1 = "1011', 'AA9 = "1011', "heliostats.AA9: the cluster has no such heliostat; did"),
        ('AA1 = "1011', 'AA1 = "1', "AA1: a key of 61 characters"),
        ('AA1 = "1011', 'AA1 = "xy', "AA1: a key of 62 characters"),
        ('plant = "00', 'plant = 5 # "00', "plant: a key of 0 characters"),
        ('plant = "00', 'plaint = "00', "'plaint' is not known"),
        ("[heliostats]\n", "", "'AA1' is not known"),
        ("[heliostats]\n", "password = 3\n[heliostats]\n", "password must be text, and"),
        ("[heliostats]\n", "heliostats = 3\n[password]\n", "password must be text, and"),
    ],
)
def test_what_is_wrong_in_the_keys_is_named_without_the_key(
    folder: Path, old: str, new: str, text: str
) -> None:
    changed(folder, old, new, "C1.keys.toml")
    with pytest.raises(FormatError) as caught:
        read_cluster(folder / "C1.toml")
    assert text in str(caught.value)
    assert "1213141516" not in str(caught.value)


def test_keys_that_others_may_read_are_refused(folder: Path) -> None:
    (folder / "C1.keys.toml").chmod(0o644)
    with pytest.raises(FormatError, match=r"others may read it \(mode 644\); run chmod 600"):
        read_cluster(folder / "C1.toml")


def test_the_key_of_the_bus_is_read_and_read_again(folder: Path) -> None:
    path = folder / "C1.toml"
    assert read_cluster(path).bus_keys is None
    path.write_text(path.read_text().replace("[site]", 'bus_key = "C1.bus.toml"\n\n[site]', 1))
    with pytest.raises(FormatError, match=r"C1\.bus\.toml"):
        read_cluster(path)
    file = BusKeyFile(folder / "C1.bus.toml")
    file.new()
    found = read_cluster(path)
    assert found.bus_keys is not None
    assert found.bus_keys.keys == file.keys
    assert file.keys[0].hex() not in repr(found)
    file.rotate()
    found.take_bus_keys()
    assert found.bus_keys.keys == file.keys
    assert len(file.keys) == 2


def test_limits_of_the_site_are_those_of_the_rows_that_a_cluster_watches(folder: Path) -> None:
    path = folder / "C1.toml"
    document = tomllib.loads(path.read_text())
    usual = read_cluster(path).config
    assert usual.limits == {}
    given = {"bus_errors": {"trips_percent": 30.0}, "clock_jump": {"trips_s": 0.3}}
    path.write_text(tomli_w.dumps({**document, "safety": {**given, "longest_autonomy_s": 5.0}}))
    assert read_cluster(path).config.limits == given
    watched = safety.watched_by(safety.CONDITIONS, safety.Watcher.CLUSTER)
    fixed = {"emergency_line", "longest_autonomy_s"}
    settable = {row.name for row in watched if safety.settings_of(row)}
    assert set(SafetyTable.model_fields) == settable | fixed
    for name, key, text in (
        ("bus_errors", "trips_percent", "bus_errors.trips_percent must be between 2 and"),
        ("bus_errors", "trips", "bus_errors.trips is not known; it takes trips_percent, rel"),
        ("wind_gust_stow", "trips_m_s", "safety.wind_gust_stow: 'wind_gust_stow' is not known"),
    ):
        path.write_text(tomli_w.dumps({**document, "safety": {name: {key: 90.0}}}))
        with pytest.raises(FormatError) as caught:
            read_cluster(path)
        assert text in str(caught.value)


def test_the_reference_names_every_setting() -> None:
    text = (ROOT / "docs" / "reference" / "cluster-format.md").read_text()
    for table in TABLES:
        for name, field in table.model_fields.items():
            row = next((line for line in text.splitlines() if line.startswith(f"| `{name}` ")), "")
            assert row, f"{name} is not in the reference"
            if field.description:
                assert field.description in text, f"{name}: {field.description}"


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"heliostats": ()}, "0 heliostats; one bus supports 1 to 32"),
        ({"name": ""}, "the name is empty"),
        ({"heliostats": (Member("X", 1), Member("X", 2))}, "two heliostats have the name X"),
        ({"answer": 5.0}, "answer 5.0 s is not within 0.001 to 1 s"),
        ({"steps_every": 0}, "steps_every 0 s"),
        ({"phase": 1.0}, "phase 1.0 s"),
        ({"longest_autonomy": -1.0}, "longest_autonomy -1.0 s"),
    ],
)
def test_a_cluster_that_cannot_be_is_refused(changes: dict[str, object], text: str) -> None:
    with pytest.raises(InputError, match=text):
        config_of(2, **changes)


def test_a_heliostat_that_cannot_be_is_refused() -> None:
    with pytest.raises(InputError, match="heliostat X: address 65535 is not within 1 to 65534"):
        Member("X", 0xFFFF)
    with pytest.raises(InputError, match="heliostat at address 3: the name is empty"):
        Member("", 3)
    with pytest.raises(InputError, match="33 heliostats"):
        ClusterConfig("C", SITE, tuple(Member(f"H{n}", n) for n in range(1, 34)))


@pytest.mark.parametrize(
    ("rate", "text"),
    [
        (1199, "input should be greater than or equal to 1200"),
        (1200, ""),
        (4_000_000, ""),
        (4_000_001, "input should be less than or equal to 4000000"),
    ],
)
def test_the_bus_has_a_rate_that_its_port_can_have(folder: Path, rate: int, text: str) -> None:
    path = changed(folder, "baud_rate = 115200", f"baud_rate = {rate}")
    if text:
        with pytest.raises(FormatError, match=f"bus.baud_rate: {rate}: {text}"):
            read_cluster(path)
    else:
        assert read_cluster(path).bus.baud_rate == rate


def ranges() -> list[tuple[str, str, str, str]]:
    """Tables, keys, kinds and ranges of the numbers in the reference."""
    text, found, table = (ROOT / "docs/reference/cluster-format.md").read_text(), [], ""
    for line in text.splitlines():
        if line.startswith("## "):
            table = line.strip("#` []")
        cells = [cell.strip(" `") for cell in line.split("|")]
        if len(cells) > 4 and cells[2] in ("number", "whole number") and cells[3]:
            found.append((table, cells[1], cells[2], cells[3]))
    assert len(found) > 10
    return found


@pytest.mark.parametrize(("table", "key", "kind", "span"), ranges())
def test_a_number_is_taken_to_the_ends_of_its_range_and_not_beyond(
    folder: Path, table: str, key: str, kind: str, span: str
) -> None:
    path = folder / "C1.toml"
    document = tomllib.loads(path.read_text())
    document["bus"] |= {"answer_s": 0.001, "stored_answer_s": 2.0}  # the second is the longer one
    place = document["heliostats"][0] if table == "heliostats" else document.setdefault(table, {})

    def read(value: float) -> None:
        place[key] = value
        path.write_text(tomli_w.dumps(document))
        read_cluster(path)

    found = re.fullmatch(r"(above )?(\S+) to (below )?(\S+)", span)
    assert found is not None
    for text, is_open, way in ((found[2], found[1], -1), (found[4], found[3], 1)):
        end = float(text.replace(",", ""))
        if kind == "whole number":
            good, bad = int(end), int(end) + way
        elif is_open:
            good, bad = math.nextafter(end, -way * math.inf), end
        else:
            good, bad = end, math.nextafter(end, way * math.inf)
        read(good)
        with pytest.raises(FormatError, match=rf"{key}: .*input should be"):
            read(bad)


def test_the_bus_has_its_usual_rate_if_none_is_given(folder: Path) -> None:
    assert read_cluster(changed(folder, "baud_rate = 115200\n", "")).bus.baud_rate == 115200


# -- epoch and editions ----------------------------------------------------------------


def test_epoch_and_editions_only_rise(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    first = Kept(path)
    assert first.start(1000) == 1000
    assert [first.next_edition() for _ in range(3)] == [1, 2, 3]
    second = Kept(path)
    assert second.start(0) == 1001
    edition = second.next_edition()
    assert edition > 3
    assert second.next_edition(above=5000) == 5001
    third = Kept(path)
    assert third.next_edition() > 5001
    assert json.loads(path.read_text())["epoch"] == 1001
    assert list(tmp_path.iterdir()) == [path]
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.parametrize("text", ["", "{}", '{"epoch": -1, "edition": 0}', '{"epoch": 1}', "[1]"])
def test_a_state_file_that_is_none_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "state.json"
    path.write_text(text)
    with pytest.raises(FormatError, match="contains no epoch and edition"):
        Kept(path)


def test_an_edition_that_cannot_be_kept_is_not_used(tmp_path: Path) -> None:
    kept = Kept(tmp_path / "gone" / "state.json")
    for _ in range(2):
        with pytest.raises(FileNotFoundError):
            kept.next_edition()
        with pytest.raises(FileNotFoundError):
            kept.start(5)
    assert kept.epoch == 0


# -- reading answers -------------------------------------------------------------------

STATUS_VALUES = (5, 0x101F, 0, 12345, 600, 24000, -5, 0xDEADBEEF, 3)
STEPS_VALUES = (-123456, 0, 2**31 - 1, -(2**31))


def answer(name: str, values: tuple[int, ...], sender: int = 9, sequence: int = 2) -> bytes:
    payload = wire.pack(name, *values)
    return wire.encode(wire.Frame(0, sender, sequence, messages.NUMBER_OF[name], payload))


def test_the_quick_reading_reads_what_the_slow_one_does() -> None:
    chance = np.random.default_rng(3)
    for _ in range(300):
        raw = [int(x) for x in chance.integers(0, 2, 9) * chance.integers(0, 2**31, 9)]
        values = (
            raw[0] % 256,
            raw[1],
            raw[2] % 256,
            raw[3],
            raw[4],
            raw[5] % 65536,
            raw[6] % 256 - 128,
            raw[7],
            raw[8] % 65536,
        )
        sender, sequence = int(chance.integers(1, 65535)), int(chance.integers(0, 5))
        data = answer("STATUS", values, sender, sequence)
        assert STATUS.read(data, sender, sequence) == values
    assert STEPS.read(answer("STEPS", STEPS_VALUES), 9, 2) == STEPS_VALUES


def test_the_quick_reading_takes_nothing_else() -> None:
    good = answer("STATUS", STATUS_VALUES)
    assert STATUS.read(good, 9, 2) == STATUS_VALUES
    assert STATUS.read(good, 8, 2) is None
    assert STATUS.read(good, 9, 3) is None
    assert STEPS.read(good, 9, 2) is None
    assert STATUS.read(b"", 9, 2) is None
    assert STATUS.read(b"\0" + good, 9, 2) is None
    assert STATUS.read(good[:-1], 9, 2) is None
    to_other = wire.Frame(
        5, 9, 2, messages.NUMBER_OF["STATUS"], wire.pack("STATUS", *STATUS_VALUES)
    )
    assert STATUS.read(wire.encode(to_other), 9, 2) is None
    # Every change of one bit, and every byte replaced.
    for place in range(len(good)):
        for bit in range(8):
            bad = bytearray(good)
            bad[place] ^= 1 << bit
            assert STATUS.read(bytes(bad), 9, 2) is None
        for value in range(0, 256, 5):
            bad = bytearray(good)
            bad[place] = value
            assert STATUS.read(bytes(bad), 9, 2) in (None, STATUS_VALUES if bad == good else None)


def test_rows_tell_what_was_heard_and_how_old_it_is() -> None:
    members = (Member("A", 9), Member("B", 10))
    nodes = Nodes(ClusterConfig("K", SITE, members))
    nodes[0].status, nodes[0].steps = STATUS_VALUES, (1, -2, 3, -4)
    nodes[0].counts.asked = 7
    nodes[0].status_at = 99.0
    nodes[0].answered(100.2, 0.01)  # an ACK, which says nothing of its state
    table = np.frombuffer(nodes.rows(100.5), dtype=NODE)
    assert table["heard_ms"][0] == 1500
    assert table["heard_ms"][1] == 2**32 - 1
    nodes[0].steps_at = 98.0
    assert np.frombuffer(nodes.rows(100.5), dtype=NODE)["steps_ms"].tolist() == [2500, 2**32 - 1]
    first = table[0]
    named = (
        "state",
        "flags",
        "fault",
        "sun_age_ms",
        "supply_mv",
        "temperature_degc",
        "armature_crc",
        "boots",
    )
    assert tuple(first[list(named)].item()) == STATUS_VALUES[:3] + STATUS_VALUES[4:]
    steps = ("primary", "secondary", "primary_goal", "secondary_goal")
    assert tuple(first[list(steps)].item()) == (1, -2, 3, -4)
    assert (first["asked"], first["answered"]) == (7, 1)


# -- where it leads --------------------------------------------------------------------


def test_links_and_times_are_made_as_the_file_says(folder: Path) -> None:
    clock = SystemClock()
    installation = read_cluster(folder / "C1.toml")
    assert _link(installation, clock, Papers(clock)).name == "plant at 10.0.0.2:4840"
    changed(folder, "tcp://10.0.0.2:4840", "mqtt://broker/heliotrope/example")
    changed(folder, 'gpsd = "localhost"', "error_s = 0.25")
    installation = read_cluster(folder / "C1.toml")
    assert (installation.port, installation.prefix) == (1883, "heliotrope/example")
    assert "broker" in _link(installation, clock, Papers(clock)).name
    keeper = time_of(installation, clock)
    assert (keeper.time().quality, keeper.time().error) == ("system", 0.25)
    changed(folder, 'example"', 'example"\nauthority = "no.pem"')
    changed(folder, "mqtt://", "mqtts://")
    with pytest.raises(InputError, match=re.escape(str(folder / "no.pem"))):
        _link(read_cluster(folder / "C1.toml"), clock, Papers(clock))


def test_unless_an_error_is_stated_the_kernel_is_asked(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = [0.02]
    monkeypatch.setattr(timekeeping, "kernel_bound", lambda: told[0])
    clock = VirtualClock(start=datetime(2026, 6, 21, 10, tzinfo=UTC))
    changed(folder, '"localhost"', '"10.0.0.9:2948"')
    installation = read_cluster(folder / "C1.toml")
    assert installation.gpsd == ("10.0.0.9", 2948)
    keeper = time_of(installation, clock)
    assert (keeper.time().quality, keeper.time().error) == ("system", 0.02)
    told[0] = math.inf
    clock.advance(100.0)
    assert (keeper.time().quality, keeper.time().error) == ("holdover", pytest.approx(0.07))


def test_where_the_kernel_cannot_be_asked_that_is_said_at_the_start(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: object())
    with pytest.raises(InputError, match="does not report whether its clock is synchronised"):
        time_of(read_cluster(folder / "C1.toml"), SystemClock())


def test_many_clusters_begin_their_seconds_apart() -> None:
    phases = [spread_phase(index, 313) for index in range(313)]
    assert phases[0] == 0.0
    assert np.diff(phases) == pytest.approx(1 / 313)
    assert config_of(2, phase=phases[-1]).phase < 1.0
    assert spread_phase(0, 1) == 0.0
    for index, count in ((313, 313), (-1, 2), (0, 0)):
        with pytest.raises(InputError, match=f"cluster {index} of {count}"):
            spread_phase(index, count)


def test_an_emergency_line_that_cannot_be_read_is_open(tmp_path: Path) -> None:
    file = tmp_path / "value"
    flows = line_of(file)
    assert flows is not None
    assert not flows()
    file.write_text("1\n")
    assert flows()
    file.write_text("0\n")
    assert not flows()
