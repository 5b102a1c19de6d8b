"""What is recorded is found again, on SQLite and on PostgreSQL."""

import asyncio
import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit.estimator import FitOutcome, fit
from heliotrope.calibration.record import (
    CalibrationOutcome,
    HeliostatCalibration,
    Provenance,
)
from heliotrope.calibration.sightings import Sightings, camera_target
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.example import example_plant
from heliotrope.geometry import normalize, reflect
from heliotrope.links.messages import decode, encode
from heliotrope.mechanism.chain import Mechanism
from heliotrope.safety import Alarm, Severity
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import (
    CampaignEntry,
    Event,
    FieldPoint,
    Kind,
    Lockout,
    Outlook,
    PlantFigures,
    StoreError,
    VisitEntry,
)

NAMES = ("A1", "Größe/2", "c'; DROP TABLE sighting")


def confirm(keeper: Keeper) -> None:
    asyncio.run(keeper.confirm())
    assert not keeper.refused


def assert_same(found: Sightings, wanted: Sightings) -> None:
    for field in fields(Sightings):
        a, b = np.asarray(getattr(found, field.name)), np.asarray(getattr(wanted, field.name))
        assert a.dtype == b.dtype, field.name
        np.testing.assert_array_equal(a, b, err_msg=field.name)


def version(
    heliostat: str, numbers: np.ndarray, seed: int = 0, **given: object
) -> HeliostatCalibration:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(2, 2))
    count = len(numbers)
    whole = HeliostatCalibration(
        heliostat,
        1.8e9 + seed,
        ("tilt_north", "tilt_east"),
        rng.normal(size=2),
        root @ root.T,
        np.array([0.01, 0.02]),
        0.015,
        0.0003,
        1.1,
        FitOutcome.CONVERGED,
        numbers,
        np.zeros(0, np.int64),
        rng.normal(size=(count, 2)),
        rng.normal(size=(count, 2)),
        "two",
        Provenance.DRONE,
        "anna",
        "first",
        "note",
        ("POSITION", "AXES"),
        version=1,
    )
    return replace(whole, **given)


class TestSightings:
    def test_come_back_to_the_last_bit(self, keeper: Keeper, seen: Sightings) -> None:
        numbers = keeper.record_sightings(NAMES, seen, target="west", campaign="first")
        confirm(keeper)
        found = keeper.sightings()
        np.testing.assert_array_equal(found.identities, numbers)
        assert found.names == NAMES  # the first sightings are theirs, in this order
        assert_same(found.sightings, seen)
        assert set(found.kinds) == {"camera_target"}
        assert set(found.targets) == {"west"}
        assert set(found.campaigns) == {"first"}

    def test_can_be_chosen(self, keeper: Keeper, seen: Sightings) -> None:
        keeper.record_sightings(NAMES, seen, kind="drone")
        keeper.record_sightings(NAMES, seen.of(0), campaign="second")
        confirm(keeper)
        assert_same(keeper.sightings([NAMES[1]]).of(NAMES[1]), seen.of(1))
        assert len(keeper.sightings([NAMES[1]]).of("nobody")) == 0
        assert len(keeper.sightings(campaign="second")) == len(seen.of(0))
        middle = float(seen.time[4])
        early, late = keeper.sightings(until=middle), keeper.sightings(since=middle)
        assert early.sightings.time.max() == late.sightings.time.min() == middle
        many = [f"x{i}" for i in range(1000)] + [NAMES[2]]
        assert keeper.sightings(many).names == (NAMES[2],)
        assert len(keeper.sightings([])) == 0

    def test_without_a_time(self, keeper: Keeper, seen: Sightings) -> None:
        never = replace(seen, time=np.full(len(seen), np.nan))
        keeper.record_sightings(NAMES, never)
        confirm(keeper)
        assert np.isnan(keeper.sightings().sightings.time).all()

    def test_of_nobody_are_refused(self, keeper: Keeper, seen: Sightings) -> None:
        with pytest.raises(
            InputError,
            match=("heliostat row 2, but there are only 2 names; pass the names of all heliostats"),
        ):
            keeper.record_sightings(NAMES[:2], seen)

    def test_are_numbered_on_over_a_restart(
        self, place: str | Path, opened: Callable[..., Keeper], seen: Sightings
    ) -> None:
        first = opened(place)
        numbers = first.record_sightings(NAMES, seen)
        first.close()
        more = opened(place).record_sightings(NAMES, seen)
        assert more.min() == numbers.max() + 1


class TestParameters:
    def test_come_back_with_where_they_are_from(self, keeper: Keeper, seen: Sightings) -> None:
        numbers = keeper.record_sightings(NAMES, seen)
        kept = version("A1", numbers[seen.heliostat == 0], left_out=numbers[seen.heliostat == 1])
        keeper.record_calibration(kept)
        keeper.record_calibration(version("A1", numbers[:0], 1, after=math.nan, version=2))
        keeper.record_calibration(version("B", numbers[:2], 2))
        confirm(keeper)
        first, second = keeper.calibration_history("A1")
        for field in fields(HeliostatCalibration):
            wanted = getattr(kept, field.name)
            np.testing.assert_array_equal(getattr(first, field.name), wanted, err_msg=field.name)
        assert (first.outcome, first.provenance) == (FitOutcome.CONVERGED, Provenance.DRONE)
        assert (second.version, len(second.sightings)) == (2, 0)
        assert math.isnan(second.after)
        assert keeper.calibration_history("nobody") == []

    def test_many_at_once_are_those_one_by_one(self, keeper: Keeper, seen: Sightings) -> None:
        """Of the second versions, some rest on sightings of the first, and some no longer do."""
        numbers = keeper.record_sightings(NAMES, seen)
        groups = [("A1", numbers[:3], 1), ("B", numbers[2:5], 1), ("A1", numbers[1:4], 2)]
        one = [version(name, some, version=number) for name, some, number in groups]
        keeper.record_calibration(*one[:2])
        keeper.record_calibration(one[2], version("C", numbers[:1]))
        with pytest.raises(InputError, match="calibration of B: two versions at once"):
            keeper.record_calibration(*(version("B", numbers[:1], version=n) for n in (2, 3)))
        confirm(keeper)
        history = [*keeper.calibration_history("A1"), *keeper.calibration_history("B")]
        for found, wanted in zip(history, (one[0], one[2], one[1]), strict=True):
            np.testing.assert_array_equal(found.sightings, wanted.sightings)
            np.testing.assert_array_equal(found.residual_after[-1], wanted.residual_after[-1])

    def test_the_latest_of_each(self, keeper: Keeper) -> None:
        none = np.zeros(0, np.int64)
        for seed, name in enumerate(("A", "B", "A", "A", "C")):
            count = sum(n == name for n in ("A", "B", "A", "A", "C")[: seed + 1])
            keeper.record_calibration(version(name, none, seed, version=count))
        confirm(keeper)
        assert {n: v.version for n, v in keeper.latest_calibrations().items()} == {
            "A": 3,
            "B": 1,
            "C": 1,
        }
        (latest,) = keeper.latest_calibrations(["A"]).values()
        np.testing.assert_array_equal(latest.values, version("A", none, 3).values)
        many = [f"x{i}" for i in range(1000)] + ["B"]
        assert list(keeper.latest_calibrations(many)) == ["B"]

    def test_versions_rise_over_a_restart(
        self, place: str | Path, opened: Callable[..., Keeper]
    ) -> None:
        none = np.zeros(0, np.int64)
        first = opened(place)
        first.record_calibration(version("A", none))
        first.close()
        again = opened(place)
        with pytest.raises(InputError, match="calibration of A: version 1 is not above 1"):
            again.record_calibration(version("A", none))
        again.record_calibration(version("A", none, version=3))
        confirm(again)
        assert again.latest_calibrations()["A"].version == 3

    def test_must_fit_together(self) -> None:
        good = version("A", np.arange(3))
        with pytest.raises(InputError, match=r"covariance of shape \(3, 3\).*need \(2, 2\)"):
            replace(good, covariance=np.eye(3))
        with pytest.raises(InputError, match=r"residual_after of shape \(3, 2\).*2 sightings"):
            replace(good, sightings=np.arange(2), residual_before=np.zeros((2, 2)))
        with pytest.raises(InputError, match="values is not finite"):
            replace(good, values=np.array([np.nan, 0.0]))

    def test_sightings_that_are_not_kept_are_told(self, keeper: Keeper) -> None:
        keeper.record_calibration(version("A", np.array([77])))
        keeper.record_event(Event(1.0, "test", "goes on"))
        asyncio.run(keeper.confirm())
        assert "a record was refused" in keeper.refused
        assert keeper.calibration_history("A") == []
        assert [e.text for e in keeper.events()] == ["goes on"]

    def test_of_a_fit(self) -> None:
        nominal, seen = _small_case()
        fitted = fit(nominal, seen, ("tilt_north", "tilt_east"))
        numbers = np.arange(len(seen)) + 5
        made = HeliostatCalibration.from_fit(
            "A", 9.0, fitted, nominal, seen, numbers, model="two", person="anna"
        )
        assert made.after < 1e-6 < made.before
        assert made.before == pytest.approx(2.0 * 0.004, rel=0.5)
        assert made.outcome is FitOutcome.CONVERGED
        np.testing.assert_allclose(
            np.hypot(*made.residual_before.T), beam_errors(nominal, seen).beam, rtol=1e-6
        )
        assert made.parameters["tilt_north"] == pytest.approx(0.004, abs=1e-6)
        np.testing.assert_allclose(made.sigma**2, np.diagonal(made.covariance))
        with pytest.raises(InputError, match=r"2 numbers for \d+ sightings"):
            HeliostatCalibration.from_fit("A", 9.0, fitted, nominal, seen, numbers[:2], model="two")


def _small_case() -> tuple[Mechanism, Sightings]:
    """A mechanism whose pedestal leans to north by 4 mrad, and what it does."""
    nominal = example_plant().groups["azel"].mechanism[np.array([0])]
    leaning = nominal.with_parameters({"tilt_north": np.array([0.004])})
    rng = np.random.default_rng(3)
    counts = rng.uniform(2000.0, 20000.0, (12, 2))
    pose = leaning[np.zeros(12, np.intp)].pose(counts)
    sun = normalize(pose.normal + 0.3 * rng.normal(size=(12, 3)))
    far = pose.vertex + 60.0 * reflect(sun, pose.normal)
    return nominal, camera_target(0, counts, sun, far, time=1.8e9 + 600.0 * np.arange(12))


class TestSchedule:
    def test_visits(self, keeper: Keeper) -> None:
        first = VisitEntry(
            "A",
            "west",
            10.0,
            20.0,
            CalibrationOutcome.CALIBRATED,
            text="calibrated",
            gain=0.3,
            sigma_before=0.01,
            sightings=3,
            version=1,
            campaign="c",
        )
        second = VisitEntry("B", "east", 11.0, 21.0, CalibrationOutcome.NO_BEAM, text="no spot")
        for visit in (first, second):
            keeper.record(visit)
        confirm(keeper)
        last, other = keeper.visits()
        assert (last.heliostat, last.number, last.good) == ("B", 2, False)
        assert last.outcome is CalibrationOutcome.NO_BEAM
        assert math.isnan(last.gain)
        assert (other.gain, other.sigma_before, other.text) == (0.3, 0.01, "calibrated")
        assert [v.heliostat for v in keeper.visits(heliostat="A")] == ["A"]
        assert len(keeper.visits(limit=1)) == 1

    def test_an_outlook_replaces_the_one_made_at_its_time(self, keeper: Keeper) -> None:
        points = (FieldPoint(5.0, 2e-3, 1 / 300), FieldPoint(9.0, 1e-3, 2e-3))
        first = Outlook(5.0, 7, 3.5e-4, None, points, "not today")
        better = replace(first, reached=9.0, text="reached")
        for made in (first, replace(first, made=6.0), better):
            keeper.record(made)
        confirm(keeper)
        assert keeper.outlooks(5.0) == [better, replace(first, made=6.0)]
        assert keeper.outlooks(5.5) == [replace(first, made=6.0)]

    def test_figures_of_a_time_oldest_first(self, keeper: Keeper) -> None:
        rows = [PlantFigures(at, {"power.R": at, "reading.dni": math.nan}) for at in (9.0, 5.0)]
        for row in rows:
            keeper.record(row)
        confirm(keeper)
        first, last = keeper.figures(5.0, 10.0)
        assert (first.at, last.at, last.values["power.R"]) == (5.0, 9.0, 9.0)
        assert math.isnan(first.values["reading.dni"])
        assert [row.at for row in keeper.figures(5.0, 9.0)] == [5.0]
        keeper.forget_events(6.0)
        confirm(keeper)
        assert [row.at for row in keeper.figures(0.0, 99.0)] == [9.0]

    def test_visits_and_alarms_of_a_time(self, keeper: Keeper) -> None:
        for at in (10.0, 20.0):
            keeper.record(VisitEntry("A", "west", at - 5, at, CalibrationOutcome.NO_BEAM))
        keeper.record_alarm(Alarm("wind", "", Severity.ALARM, "gust"), 10.0)
        keeper.record_alarm(Alarm("wind", "", Severity.ALARM, "", active=False), 15.0)
        keeper.record_alarm(Alarm("flux", "", Severity.ALARM, "high"), 30.0)
        confirm(keeper)
        assert [v.finished for v in keeper.visits(since=15.0, until=25.0)] == [20.0]
        assert [a.condition for a in keeper.alarms(since=14.0, until=20.0)] == ["wind"]
        assert [a.condition for a in keeper.alarms(since=16.0, until=31.0)] == ["flux"]

    def test_campaigns(self, keeper: Keeper) -> None:
        begun = CampaignEntry("spring", 5.0, model="malan8", expected={"rms": 0.3, "odd": math.nan})
        keeper.record(begun)
        keeper.record(replace(begun, finished=9.0, found={"rms": 0.31}))
        keeper.record(CampaignEntry("summer", 10.0))
        confirm(keeper)
        summer, spring = keeper.campaigns()
        assert (summer.name, summer.finished) == ("summer", None)
        assert (spring.finished, spring.found, spring.expected["rms"]) == (9.0, {"rms": 0.31}, 0.3)
        assert math.isnan(spring.expected["odd"])

    def test_holds_hold_at_once_and_over_a_restart(
        self, place: str | Path, opened: Callable[..., Keeper]
    ) -> None:
        keeper = opened(place)
        annas = [
            Lockout(Kind.HELIOSTAT, name, "anna", "drive replaced", 10.0, 50.0)
            for name in ("A", "B")
        ]
        bens = Lockout(Kind.HELIOSTAT, "B", "ben", "mirror broken", 20.0)
        later = Lockout(Kind.HELIOSTAT, "A", "anna", "a new gear", 25.0)
        tower = Lockout(Kind.TOWER, "tower", "ben", "for a moment", 20.0)
        keeper.hold([*annas, bens, tower])
        keeper.hold([later])
        keeper.unhold([tower, Lockout(Kind.HELIOSTAT, "never held", "ben", "", 0.0)], "anna", 30.0)
        wanted = {later, annas[1], bens}
        assert set(keeper.holds()) == wanted
        keeper.close()
        again = opened(place)
        assert set(again.holds()) == wanted
        again.unhold([annas[1]], "eva", 60.0)
        assert set(again.holds()) == {later, bens}


class TestEventsAndAlarms:
    @pytest.mark.parametrize("upper", [False, True], ids=["now", "of an older cluster"])
    def test_every_alarm_of_a_cluster_is_kept(self, keeper: Keeper, upper: bool) -> None:
        raised = Alarm("node_silent", "A1", Severity.WARNING, "no reply for 10 s")
        line = encode(raised)
        heard = decode(line.replace(b'"warning"', b'"WARNING"') if upper else line)
        assert isinstance(heard, Alarm)
        keeper.record_alarm(heard, 5.0)
        confirm(keeper)
        (kept,) = keeper.alarms()
        assert (kept.condition, kept.subject, kept.severity) == ("node_silent", "A1", "warning")

    def test_events(self, keeper: Keeper) -> None:
        for i, severity in enumerate(("info", "warning", "alarm", "info")):
            keeper.record_event(
                Event(float(i), "test", f"text {i}", severity, "A" if i else "", {"x": i / 3})
            )
        confirm(keeper)
        assert [e.text[-1] for e in keeper.events()] == ["3", "2", "1", "0"]
        assert [e.text[-1] for e in keeper.events(severity="warning")] == ["2", "1"]
        assert [e.text[-1] for e in keeper.events(1, before=3)] == ["1"]
        assert [e.text[-1] for e in keeper.events(heliostat="A", severity="alarm")] == ["2"]
        assert keeper.events(1)[0].values == {"x": 1.0}
        with pytest.raises(UnknownNameError, match="severity 'bad'"):
            keeper.record_event(Event(0.0, "test", "", "bad"))

    def test_an_alarm_from_its_beginning_to_its_end(self, keeper: Keeper) -> None:
        def alarm(at: float, text: str = "12 m/s", *, active: bool = True) -> None:
            keeper.record_alarm(Alarm("wind", "mast", Severity.WARNING, text, active), at)

        alarm(1.0)
        alarm(2.0, "14 m/s")
        confirm(keeper)
        (stands,) = keeper.alarms(standing=True)
        assert (stands.text, stands.raised, stands.cleared) == ("14 m/s", 1.0, None)
        alarm(3.0, active=False)
        confirm(keeper)
        (over,) = keeper.alarms(standing=True)
        assert (over.raised, over.cleared, over.acknowledged) == (1.0, 3.0, None)
        keeper.record_acknowledgement("wind", "mast", "anna", 4.0)
        alarm(5.0)
        confirm(keeper)
        new, old = keeper.alarms()
        assert (old.acknowledged, old.acknowledged_by) == (4.0, "anna")
        assert (new.raised, new.acknowledged, new.cleared) == (5.0, None, None)
        assert keeper.alarms(standing=True) == [new]

    def test_what_is_old_and_settled_is_forgotten(self, keeper: Keeper) -> None:
        for at in (1.0, 2.0, 9.0):
            keeper.record_event(Event(at, "test", str(at)))
            keeper.record_alarm(Alarm(f"c{at}", "", Severity.ALARM, ""), at)
        keeper.record_alarm(Alarm("c1.0", "", Severity.ALARM, "", active=False), 3.0)
        keeper.record_acknowledgement("c1.0", "", "anna", 4.0)
        keeper.forget_events(5.0)
        confirm(keeper)
        assert [e.at for e in keeper.events()] == [9.0]
        assert [a.raised for a in keeper.alarms()] == [9.0, 2.0]


class TestOpening:
    def test_one_process_at_a_time(self, place: str | Path, opened: Callable[..., Keeper]) -> None:
        first = opened(place)
        with pytest.raises(StoreError, match="another process writes to it"):
            opened(place)
        first.close()
        opened(place)

    def test_a_url_of_something_else(self) -> None:
        with pytest.raises(StoreError, match="a URL of mysql cannot be used; specify a folder"):
            Keeper("mysql://plant@/x")
        with pytest.raises(StoreError, match="the URL cannot be read"):
            Keeper("post gres://:::/")

    def test_a_place_where_no_folder_can_be(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(StoreError, match=r"file/data.*choose a writable folder"):
            Keeper(tmp_path / "file" / "data")

    def test_a_file_that_is_no_database(self, tmp_path: Path) -> None:
        (tmp_path / "store.sqlite").write_text("no database at all, but long enough\n" * 100)
        with pytest.raises(StoreError, match="not a database"):
            Keeper(tmp_path)

    def test_no_server(self, tmp_path: Path) -> None:
        with pytest.raises(StoreError, match=r"connection to server .* failed"):
            Keeper(f"postgresql://plant:secret@/x?host={tmp_path}")

    def test_a_password_is_not_shown(self, tmp_path: Path) -> None:
        with pytest.raises(StoreError) as caught:
            Keeper(f"postgresql://plant:secret@/x?host={tmp_path}")
        assert "secret" not in str(caught.value)


def test_beams_that_people_have_aimed_are_kept(tmp_path: Path) -> None:
    with closing(Keeper(tmp_path, inline=True)) as keeper:
        assert keeper.aimed_by_people() == ()
        keeper.keep_aimed_by_people(("P1A", "P2B"))
    with closing(Keeper(tmp_path, inline=True)) as keeper:
        assert keeper.aimed_by_people() == ("P1A", "P2B")
        keeper.keep_aimed_by_people(())
        assert keeper.aimed_by_people() == ()


def test_a_locked_table_holds_up_a_thread_for_a_while_and_no_record_is_lost(
    schema: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import psycopg

    monkeypatch.setattr("heliotrope.store.database._WAIT_MS", 200)
    event = Event(1.0, "plant", "written after all")
    with closing(Keeper(schema)) as keeper, psycopg.connect(schema) as other:
        other.execute("LOCK TABLE event IN ACCESS EXCLUSIVE MODE")
        with pytest.raises(StoreError, match="lock timeout"):
            asyncio.run(keeper.read(lambda records: records.events()))
        keeper.record_event(event)
        with pytest.raises(StoreError, match="lock timeout"):
            asyncio.run(keeper.confirm())
        assert "lock timeout" in keeper.problem
        other.rollback()
        asyncio.run(keeper.confirm())
        assert not keeper.problem
        assert [one.text for one in keeper.events()] == [event.text]
