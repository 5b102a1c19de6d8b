"""Flights of a drone taken into a plant whose truth is known."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from heliotrope.calibration.fit.common import fit_common
from heliotrope.calibration.flights import Flight, FlightDocument, FlightRow
from heliotrope.calibration.learn import group
from heliotrope.calibration.learn.own_model import OwnModel
from heliotrope.calibration.record import CalibrationOutcome, Provenance
from heliotrope.calibration.sightings import camera_target
from heliotrope.errors import HeliotropeError
from heliotrope.field.example import example_plant
from heliotrope.geometry import MRAD, FloatArray, angle_between, direction, normalize, reflect
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.mechanism.board_items import items_of
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant import refusals
from heliotrope.plant.operations.flights import FlightIntake
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.visits.fitting import Believed, fit_flights, fit_heliostat, follow_flights
from heliotrope.plant.visits.settings import CycleSettings
from heliotrope.store.keeper import Keeper
from support.plant_bench import ENGINEER, OPERATOR, Bench

DESIGN = example_plant()
FIELD = DESIGN.groups["azel"]
NAMES = FIELD.names
SETTINGS = CycleSettings(model=("azimuth_bias", "elevation_bias", "tilt_east", "tilt_north"))
FOUR = OwnModel("four", tuple(SETTINGS.model))
SIZES = {"azimuth_bias": 1e-3, "elevation_bias": 1e-3, "tilt_east": 0.5e-3, "tilt_north": 0.5e-3}
STILL = replace(
    group.defaults(FIELD.mechanism, FOUR.parameters), amplitude=np.full(4, 1e-9), noise=1.0, rate=0
)
#: Known offset of the base, of each orientation, and of a centroid's beam.
RTK, OWN, BEAM = 0.05, 0.05 * MRAD, 0.3 * MRAD
POSES = 3


class Site:
    """A plant with its intake of flights, and the mirrors as they really are."""

    def __init__(self, clock: VirtualClock, folder: Path, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.keeper = Keeper(folder / "store.sqlite", inline=True)
        self.bench = Bench(clock, folder)
        self.plant = self.bench.plant
        # These mirrors stand still, and the plant has learnt it.
        self.plant.beliefs.adopt("azel", STILL, "learnt")
        self.log = Logbook(clock, self.keeper)
        self.keeping = Keeping(NAMES, self.plant.beliefs, self.keeper)
        self.intake = FlightIntake(self.plant, self.log, self.keeping, SETTINGS)
        self.keeping.recall()
        self.intake.recall()
        draws = np.random.default_rng(seed + 50)
        self.true: Mechanism = FIELD.mechanism.with_parameters(
            {k: v * draws.standard_normal(len(NAMES)) for k, v in SIZES.items()}
        )

    def close(self) -> None:
        self.keeper.close()
        self.bench.audit.close()

    def stand(self, state: int, *names: str) -> None:
        """Let heliostats be heard in a state."""
        field = self.plant.field
        for name in names or NAMES:
            field.rows["state"][field.place(name)] = state
            field.heard[field.place(name)] = self.plant.now()

    def photographs(self, name: str, count: int = 6) -> None:
        """Calibrate a heliostat by photographs of its beam on the target."""
        row = np.full(count, NAMES.index(name))
        light = direction(self.rng.uniform(-1.0, 1.0, count), self.rng.uniform(0.5, 1.0, count))
        target = DESIGN.targets[0].center
        vertex = FIELD.mechanism[row].pose(np.zeros((count, 2))).vertex
        wanted = normalize(light + normalize(target - vertex))
        counts = counts_at(FIELD.mechanism[row], wanted)
        pose = self.true[row].pose(counts)
        ray = reflect(light, pose.normal) + BEAM * self.rng.standard_normal((count, 3))
        slant = np.linalg.norm(target - pose.vertex, axis=-1, keepdims=True)
        at = self.plant.clock.utc().timestamp() - 3600.0
        made = camera_target(
            0, counts, light, pose.vertex + slant * ray, time=at + np.arange(count), sigma=BEAM
        )
        beliefs = self.plant.beliefs
        beliefs.note(name, "target", made)
        seen = beliefs.known(name)
        assert seen is not None
        fit = fit_heliostat(Believed.of(beliefs, name), SETTINGS, FOUR, seen.sightings)
        beliefs.take(fit.record(beliefs, at + 100.0, person="Egon"))

    def flight(
        self, offset: FloatArray, name: str = "one", whom: tuple[str, ...] = NAMES
    ) -> FlightDocument:
        """The orientations of mirrors, by a drone that records its positions ``offset`` too far."""
        rows = []
        at = self.plant.clock.utc().timestamp() - 600.0
        for each in whom:
            h = NAMES.index(each)
            wanted = direction(
                self.rng.uniform(-1.0, 1.0, POSES), self.rng.uniform(0.4, 1.1, POSES)
            )
            counts = counts_at(FIELD.mechanism[np.full(POSES, h)], wanted)
            pose = self.true[np.full(POSES, h)].pose(counts)
            lean = OWN * self.rng.standard_normal((POSES, 3))
            place = pose.vertex + 100.0 * normalize(pose.normal + lean) + offset
            rows += [
                FlightRow(
                    heliostat=each, time=at, counts=c.tolist(), place_m=p.tolist(), sigma_rad=OWN,
                    turn_rad=OWN, covariance_m2=np.zeros((3, 3)).tolist(), shift=np.eye(3).tolist(),
                )
                for c, p in zip(counts, place, strict=True)
            ]  # fmt: skip
        return FlightDocument(
            format="heliotrope-flight",
            version=1,
            name=name,
            shared=["position east, m", "position north, m", "position up, m"],
            covariance=(RTK**2 * np.eye(3)).tolist(),
            rows=rows,
        )

    def take(self, document: FlightDocument):
        return self.intake.take_now(ENGINEER, document, document.model_dump_json())

    def missed(self, mechanisms: dict[str, Mechanism]) -> FloatArray:
        """True errors of the normals of some heliostats in one pose, rad."""
        found = []
        for name, mechanism in mechanisms.items():
            row = np.array([NAMES.index(name)])
            counts = counts_at(FIELD.mechanism[row], direction([0.3], [0.8]))
            normals = (m.pose(counts).normal for m in (mechanism, self.true[row]))
            found.append(float(angle_between(*normals)[0]))
        return np.array(found)


def counts_at(mechanism: Mechanism, normals: FloatArray) -> FloatArray:
    """Drive counts at which nominal mirrors look along normals."""
    from heliotrope.mechanism.tracking import track

    vertex = mechanism.pose(np.zeros((len(mechanism), 2))).vertex
    solved = track(mechanism, normals, vertex + 1e6 * normals)
    return solved.best_counts


@pytest.fixture
def play(tmp_path: Path) -> Callable[[Callable[[Site], None]], None]:
    """Play scenes one after the other, each with a plant that has just started on one store."""

    def played(scene: Callable[[Site], None]) -> None:
        async def main(clock: VirtualClock) -> None:
            site = Site(clock, tmp_path)
            try:
                scene(site)
            finally:
                site.close()

        run_virtual(main)

    return played


Play = Callable[[Callable[[Site], None]], None]
OFFSET = np.array([0.07, -0.06, 0.05])
KNOWN = NAMES[::2]


def test_a_flight_improves_the_field_and_its_offset_is_not_the_mirrors(play: Play) -> None:
    def scene(site: Site) -> None:
        beliefs = site.plant.beliefs
        for name in KNOWN:
            site.photographs(name)
        site.stand(states.STOWED)
        before = site.missed({name: beliefs.present(name) for name in NAMES})
        view = site.take(site.flight(OFFSET))
        # Those with a calibration get the small change at once, since all stand at stow; the others
        # have never been verified by a photograph.
        assert (view.orientations, view.heliostats) == (POSES * len(NAMES), len(NAMES))
        assert (view.in_use, view.at_stow) == (len(KNOWN), 0)
        assert view.at_target == len(NAMES) - len(KNOWN)
        assert site.intake.first() == set(NAMES) - set(KNOWN)
        fits = {name: site.intake._waiting[name].fit.mechanism for name in NAMES}
        after = site.missed(fits)
        assert np.sqrt(np.mean(after**2)) < 0.15 * MRAD < 0.5 * np.sqrt(np.mean(before**2))
        for (_, value, sigma), planted in zip(view.shared, OFFSET, strict=True):
            assert abs(value - planted) < 3.5 * sigma < 0.7 * RTK
        records = [beliefs.record(name) for name in KNOWN]
        assert all(r is not None and r.provenance is Provenance.DRONE for r in records)
        assert all(r is not None and r.campaign == "one" and r.version == 2 for r in records)
        assert all(r is not None and (r.sightings > 0).all() for r in records)
        assert [beliefs.record(name) for name in site.intake.first()] == [None] * view.at_target
        # Independent rows: the mean over all mirrors is off by what the drone was.
        flight = Flight.of(site.flight(OFFSET))
        blind = replace(flight, covariance=1e-12 * np.eye(3))
        assert honest(site, fits) < 4.0
        assert np.linalg.norm(mean_turn(site, fits)) < 0.1 * MRAD
        beliefs.flights = type(beliefs.flights)().adding(
            replace(next(iter(beliefs.flights)), flight=blind)
        )
        trusted = {
            n: fit_heliostat(Believed.of(beliefs, n), SETTINGS, FOUR, photos(site, n)).mechanism
            for n in KNOWN
        }
        assert np.linalg.norm(mean_turn(site, trusted)) > 0.15 * MRAD

    play(scene)


def photos(site: Site, name: str):
    seen = site.plant.beliefs.known(name)
    assert seen is not None
    return seen.sightings


def mean_turn(site: Site, mechanisms: dict[str, Mechanism]) -> FloatArray:
    """Mean error of the normals of all mirrors in one pose, rad."""
    off = []
    for name, mechanism in mechanisms.items():
        row = np.array([NAMES.index(name)])
        counts = counts_at(FIELD.mechanism[row], direction([0.3], [0.8]))
        off.append((mechanism.pose(counts).normal - site.true[row].pose(counts).normal)[0])
    return np.mean(off, axis=0)


def honest(site: Site, mechanisms: dict[str, Mechanism]) -> float:
    """Mean square of the parameters' errors in their standard deviations."""
    ratio = []
    for name in mechanisms:
        fit = site.intake._waiting[name].fit
        draws = np.random.default_rng(50)
        truth = {k: v * draws.standard_normal(len(NAMES)) for k, v in SIZES.items()}
        gap = fit.fitted.values[0] - [truth[n][NAMES.index(name)] for n in fit.fitted.names]
        ratio.append(gap @ np.linalg.solve(fit.fitted.covariance[0], gap) / len(gap))
    return float(np.mean(ratio))


def test_a_mirror_with_a_flight_is_followed_through_its_drift(play: Play) -> None:
    """The precise rows of a flight of 100 days ago do not hold a mirror that has drifted since."""
    name, drifted = NAMES[1], {"azimuth_bias": 2 * MRAD, "elevation_bias": -1.5 * MRAD}

    def scene(site: Site) -> None:
        beliefs = site.plant.beliefs
        beliefs.adopt("azel", group.defaults(FIELD.mechanism, FOUR.parameters), "default")
        for known in KNOWN[:4]:
            site.photographs(known)
        old = site.flight(OFFSET, whom=(*KNOWN[:4], name))
        rows = [row.model_copy(update={"time": row.time - 100 * 86400.0}) for row in old.rows]
        site.take(old.model_copy(update={"rows": rows}))
        joint = fit_flights(beliefs, beliefs.flights, SETTINGS, (name,))
        flown = follow_flights(beliefs, beliefs.flights, SETTINGS, joint)[name]
        assert site.missed({name: flown.mechanism}).max() < 0.5 * MRAD
        draws = np.random.default_rng(50)
        moved = {k: v * draws.standard_normal(len(NAMES)) for k, v in SIZES.items()}
        for zero, by in drifted.items():
            moved[zero] = moved[zero] + by * (np.array(NAMES) == name)
        site.true = FIELD.mechanism.with_parameters(moved)
        assert site.missed({name: flown.mechanism}).max() > 1.5 * MRAD
        site.photographs(name)
        now = beliefs.present(name)
        assert site.missed({name: now}).max() < 0.5 * MRAD
        seen, common = beliefs.flights.common((name,), (photos(site, name),))
        joint = fit_common(beliefs.nominal(name), seen, FOUR.parameters, common).fitted
        still = beliefs.nominal(name).with_parameters(joint.parameters)
        assert site.missed({name: still}).max() > 1.0 * MRAD
        # Its error is within what it says of it, and the flight's shared error is not its own.
        record = beliefs.record(name)
        assert record is not None
        gap = record.values - [moved[each][1] for each in record.names]
        assert gap @ np.linalg.solve(record.covariance, gap) < 20.0
        assert (record.sightings > 0).sum() == 6 + POSES

    play(scene)


def test_a_small_change_waits_until_the_heliostat_stands_at_stow(play: Play) -> None:
    name = KNOWN[0]

    def scene(site: Site) -> None:
        beliefs = site.plant.beliefs
        for each in KNOWN:
            site.photographs(each)
        site.stand(states.TRACKING)
        view = site.take(site.flight(OFFSET, whom=KNOWN))
        assert (view.in_use, view.at_stow, view.at_target) == (0, len(KNOWN), 0)
        assert [beliefs.record(each).version for each in KNOWN] == [1] * len(KNOWN)  # type: ignore[union-attr]
        site.stand(states.STOWED, name)
        site.intake.look()
        assert [beliefs.record(each).version for each in KNOWN[:2]] == [2, 1]  # type: ignore[union-attr]
        assert site.intake.views()[0].in_use == 1
        wanted = site.plant.wanted.items[name]
        assert wanted == items_of(beliefs.present(name)[0])

    play(scene)


def test_a_large_change_waits_for_a_photograph_off_the_receiver(play: Play) -> None:
    def scene(site: Site) -> None:
        beliefs, receiver = site.plant.beliefs, DESIGN.receivers[0].center[None]
        for each in KNOWN:
            site.photographs(each)
        site.stand(states.STOWED)
        # What is small elsewhere is large here.
        site.intake._settings = replace(SETTINGS, large=1e-6)
        records = {name: beliefs.record(name) for name in KNOWN}
        view = site.take(site.flight(OFFSET))
        assert (view.in_use, view.at_stow, view.at_target) == (0, 0, len(NAMES))
        assert {name: beliefs.record(name) for name in KNOWN} == records
        # A flight sees these beside their beams' places; the others were never on the receiver.
        reasons = site.plant.doubtful.reasons(NAMES, np.repeat(receiver, len(NAMES), axis=0))
        astray = refusals.SEEN_ASTRAY.text
        assert reasons == [astray if name in KNOWN else None for name in NAMES]
        target = DESIGN.targets[0].center[None]
        assert site.plant.doubtful.reasons(KNOWN[:1], target) == [None]
        # A visit that has fitted the flight's rows with its photographs ends it.
        record = records[KNOWN[0]]
        assert record is not None
        beliefs.take(replace(record, version=2))
        site.intake.look()
        assert site.plant.doubtful.reasons(KNOWN[:1], receiver) == [None]
        assert site.intake.views()[0].in_use == 1

    play(scene)


def test_flights_outlast_a_restart(play: Play) -> None:
    found: list[object] = []

    def before(site: Site) -> None:
        for name in KNOWN:
            site.photographs(name)
        site.stand(states.STOWED, *KNOWN[2:])
        site.take(site.flight(OFFSET))
        found.append(site.intake.views())
        found.append([len(site.keeper.sightings((name,))) for name in NAMES[:2]])

    def after(site: Site) -> None:
        site.stand(states.TRACKING)
        (view,), (old,) = site.intake.views(), found[0]  # type: ignore[misc]
        assert view.in_use == len(KNOWN) - 2 == old.in_use  # type: ignore[has-type]
        assert (view.name, view.person) == ("one", ENGINEER.name)
        assert (view.at_stow, view.at_target) == (2, len(NAMES) - len(KNOWN))
        for (_, value, sigma), planted in zip(view.shared, OFFSET, strict=True):
            assert abs(value - planted) < 3.5 * sigma
        assert found[1] == [6 + POSES, POSES]
        # The rows from the air are not photographs.
        assert len(photos(site, NAMES[0])) == 6
        assert site.plant.beliefs.known(NAMES[1]) is None
        assert site.plant.beliefs.count(NAMES[1]) == POSES
        assert (site.plant.beliefs.flights.identities(NAMES[1]) > 0).all()

    play(before)
    play(after)


def test_a_second_flight_is_fitted_with_the_first(play: Play) -> None:
    def scene(site: Site) -> None:
        for name in KNOWN:
            site.photographs(name)
        site.stand(states.STOWED)
        site.take(site.flight(OFFSET))
        view = site.take(site.flight(-OFFSET, "two"))
        assert [v.name for v in site.intake.views()] == ["two", "one"]
        for view, sign in zip(site.intake.views(), (-1.0, 1.0), strict=True):
            for (_, value, sigma), planted in zip(view.shared, sign * OFFSET, strict=True):
                assert abs(value - planted) < 3.5 * sigma < 0.7 * RTK
        for k, one in enumerate(site.plant.beliefs.flights):
            assert one.flight.name == ("one", "two")[k]

    play(scene)


def test_what_is_refused(play: Play) -> None:
    def scene(site: Site) -> None:
        good = site.flight(np.zeros(3))

        def refused(document: FlightDocument, said: str, person=ENGINEER) -> None:
            with pytest.raises(HeliotropeError, match=re.escape(said)):
                site.intake.take_now(person, document, document.model_dump_json())

        refused(good, "flight: Olga is operator, but the command needs engineer", OPERATOR)
        stranger = good.rows[0].model_copy(update={"heliostat": "Z9"})
        refused(good.model_copy(update={"rows": [stranger]}), "heliostat 'Z9'")
        late = good.rows[0].model_copy(update={"time": 4e9})
        refused(good.model_copy(update={"rows": [late]}), "set the drone's clock")
        single = good.rows[0].model_copy(update={"counts": [1.0]})
        refused(good.model_copy(update={"rows": [single]}), "1 step counts, but P1A has 2 drives")
        # Poses of other heliostats: nothing is believed.
        wrong = [
            row.model_copy(update={"place_m": good.rows[-k - 1].place_m})
            for k, row in enumerate(good.rows)
        ]
        refused(
            good.model_copy(update={"rows": wrong}),
            "mirrors cannot have the reported orientation, f",
        )
        assert len(site.plant.beliefs.flights) == 0
        assert site.keeper.flights() == []
        site.take(good)
        refused(good, "flight one: Egon imported it on ")

    play(scene)


def test_one_wrong_mirror_does_not_spoil_the_others(play: Play) -> None:
    def scene(site: Site) -> None:
        for name in KNOWN:
            site.photographs(name)
        site.stand(states.STOWED)
        good = site.flight(OFFSET)
        bad = [
            row.model_copy(update={"place_m": [row.place_m[0] + 8.0 * (k % 2), *row.place_m[1:]]})
            if row.heliostat == KNOWN[0]
            else row
            for k, row in enumerate(good.rows)
        ]
        view = site.take(good.model_copy(update={"rows": bad}))
        waiting = site.intake._waiting[KNOWN[0]]
        assert waiting.fit.outcome in (
            CalibrationOutcome.POOR_FIT,
            CalibrationOutcome.IMPLAUSIBLE,
        )
        assert view.unchanged == 1
        # A later visit to a target is not spoilt either.
        assert site.plant.beliefs.count(KNOWN[0]) == 6
        assert view.problems[0].startswith(f"{KNOWN[0]}: ")
        for (_, value, sigma), planted in zip(view.shared, OFFSET, strict=True):
            assert abs(value - planted) < 3.5 * sigma

    play(scene)
