"""A commissioning plan beside what comes true, with visits made by simulated mirrors.

Every half an hour the visits are chosen from what is believed then. The mirror aims by what is
believed, its true mechanism sends the beam, which is on the target or beside it, the photograph has
the noise of the plan, and the real fit takes all its sightings. "true" are percentiles over the
mirrors of their true beam errors over the suns of the year.
"""

import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from benchmarks._run import Result, Row
from heliotrope import sun as solar
from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit.estimator import fit
from heliotrope.calibration.plan.commission import (
    CommissionPlan,
    CommissionTerms,
    Visit,
    mirrors_of,
    plan_commission,
)
from heliotrope.calibration.plan.fleets import Fleet, fleets_of
from heliotrope.calibration.plan.joint_terms import JointTerms
from heliotrope.calibration.plan.on_target import reach_of, search_places
from heliotrope.calibration.plan.percentiles import error_percentiles
from heliotrope.calibration.plan.planning import aim_at
from heliotrope.calibration.sightings import Sightings, camera_target, drone, join, sightings
from heliotrope.calibration.uncertainty import suns_of_year
from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.example import roughly_installed
from heliotrope.field.layouts import malan_plant
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, as_float, reflect, tangent_axes
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track
from heliotrope.plant.schedule import settings_for
from heliotrope.plant.schedule.prospect import terms_of
from heliotrope.twin.live import CYCLE

Rows = npt.NDArray[np.intp]

START = datetime(2026, 9, 1, 22, 0, tzinfo=UTC).timestamp()
INSTALLED, GOAL, DAYS = 15e-3, 6e-4, 3
#: Accuracy of a pose that a drone measured, rad of beam, and the spread of its directions.
_FLOWN, _POSES = 8e-4, 9
#: Larger side of the mirrors, m.
_SIZE = 2.5


@dataclass
class Commissioned:
    """Mirrors that follow a plan.

    Attributes
    ----------
    plant, fleet
        The plant, and what was known of its heliostats before.
    truth, believed
        Mechanisms, (N,).
    covariance
        Of the fitted parameters, (N, P, P).
    """

    plant: Plant
    fleet: Fleet
    terms: CommissionTerms
    truth: Mechanism
    chance: np.random.Generator

    def __post_init__(self) -> None:
        self.nominal = self.believed = self.fleet.mechanism
        self.covariance = np.linalg.inv(self.fleet.information)
        spread = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)).mean(axis=0)
        self.priors = dict(zip(self.fleet.names, spread.tolist(), strict=True))
        self.values = np.zeros((len(self.truth), len(self.fleet.names)))
        self.made: Sightings | None = None
        self.visits: list[Visit] = []
        self.measured = np.zeros(len(self.truth), dtype=np.bool_)
        self.missed = np.zeros(len(self.truth), dtype=np.intp)
        self.suns = suns_of_year(self.plant.site, 2026, days=4, hours=2.0)

    @classmethod
    def begin(
        cls, plant: Plant, fleet: Fleet, terms: CommissionTerms, seed: int = 0
    ) -> "Commissioned":
        """Return mirrors whose true parameters are drawn from what is known of them."""
        chance = np.random.default_rng(seed)
        spread = np.sqrt(np.diagonal(np.linalg.inv(fleet.information), axis1=1, axis2=2))
        drawn = spread * chance.standard_normal(spread.shape)
        truth = fleet.mechanism.with_parameters(dict(zip(fleet.names, drawn.T, strict=True)))
        return cls(plant, fleet, terms, truth, chance)

    def fly(self) -> None:
        """Measure every mirror as a drone does: poses over the sky, before there is any sun."""
        count = len(self.truth)
        points = self.chance.uniform((-1.0, -1.0, 0.4), (1.0, 1.0, 1.2), (count * _POSES, 3))
        towards = points / np.linalg.norm(points, axis=1)[:, None]
        rows = np.repeat(np.arange(count), _POSES)
        place = self.nominal.position[rows] + 150.0 * towards
        solved = track(self.nominal[rows], towards, place)
        good = np.flatnonzero(solved.reachable)
        rows, place, counts = rows[good], place[good], solved.best_counts[good]
        pose = self.truth[rows].pose(counts)
        self.measured[:] = True
        # A drone sees the normal: it hovers on it, up to the noise.
        away = np.linalg.norm(place - pose.vertex, axis=1)[:, None]
        noise = self.chance.standard_normal((len(rows), 2)) * 0.5 * _FLOWN
        normal = pose.normal + np.einsum("nk,nkx->nx", noise, tangent_axes(pose.normal))
        seen = pose.vertex + away * normal / np.linalg.norm(normal, axis=1)[:, None]
        self._learn(drone(rows, counts, seen, seen, sigma=_FLOWN))

    def visit(self, visits: list[Visit]) -> None:
        """Make visits, and fit their mirrors."""
        parts = []
        for visit in visits:
            rows, own = np.sort(visit.heliostats), visit.own
            # A visit with codes of their own is verified by a second stack.
            for at in (0.5, 0.95) if own else (0.5,):
                seen = self._seen(visit, rows, visit.begin + at * (visit.end - visit.begin))
                if own and at == 0.5:
                    on = self._on_target(visit, rows, seen)
                    self.missed[rows[~on]] += 1
                    rows = rows[on]
                    seen = seen.take(np.flatnonzero(np.isin(seen.heliostat, rows)))
                parts.append(seen)
            self.measured[rows] = True
        if parts:
            self._learn(join(parts))

    def _on_target(
        self, visit: Visit, rows: npt.NDArray[np.intp], seen: Sightings
    ) -> npt.NDArray[np.bool_]:
        """Return which beams a first look finds: those with their centres on the target, (n,).

        A beam is moved with its aim, which is beside the middle if earlier looks have missed it.
        """
        target, on = self.plant.targets[visit.target], np.zeros(len(rows), dtype=np.bool_)
        place = np.searchsorted(rows, seen.heliostat)
        tries = 1 if self.terms.joint is None else self.terms.joint.tries
        moved = search_places(target, tries)[np.minimum(self.missed[seen.heliostat], tries - 1)]
        found = np.abs(target.plane_coordinates(seen.destination) + moved) <= reach_of(target)
        on[place] = found.all(axis=1) | self.measured[seen.heliostat]
        return on

    def _seen(self, visit: Visit, rows: Rows, when: float) -> Sightings:
        """Return where the beams of mirrors are that aim at the middle of a target."""
        suns = np.broadcast_to(solar.vector(when, self.plant.site), (len(rows), 3))
        target = self.plant.targets[visit.target]
        aimed = aim_at(self.believed[rows], suns, target, self.terms.limits)
        pose = self.truth[rows].pose(aimed.counts)
        ray = reflect(suns, pose.normal)
        sigma = self.terms.accuracy(visit.joint)
        noise = sigma * self.chance.standard_normal((len(rows), 2))
        ray = ray + np.einsum("nk,nkx->nx", noise, tangent_axes(ray))
        seen = target.intersect(pose.vertex, ray / np.linalg.norm(ray, axis=1)[:, None])
        good = np.isfinite(seen).all(axis=1) & aimed.able
        return camera_target(
            rows[good],
            aimed.counts[good],
            suns[good],
            seen[good],
            time=np.full(int(good.sum()), when),
            sigma=sigma,
        )

    def _learn(self, new: Sightings) -> None:
        self.made = new if self.made is None else join([self.made, new])
        rows = np.unique(new.heliostat)
        number = np.full(len(self.truth), -1, dtype=np.intp)
        number[rows] = np.arange(len(rows))
        mine = self.made.take(np.flatnonzero(number[self.made.heliostat] >= 0))
        found = fit(
            self.nominal[rows],
            mine.renumbered(number[mine.heliostat]),
            self.fleet.names,
            priors=self.priors,
            loss="square",
            adapt_scale=False,
        )
        self.covariance[rows] = found.covariance
        self.values[rows] = found.values
        self.believed = self.nominal.with_parameters(
            dict(zip(self.fleet.names, self.values.T, strict=True))
        )

    def live(self, begin: float, end: float) -> None:
        """Choose visits from what is believed at the beginning of an interval, and make them."""
        known = replace(self.fleet, information=np.linalg.inv(self.covariance))
        chosen = plan_commission(
            [replace(known, mechanism=self.believed)],
            self.plant.site,
            self.plant.targets,
            begin,
            end,
            size=_SIZE,
            measured=self.measured,
            missed=self.missed,
            terms=replace(self.terms, goal=0.0, every=end - begin),
        )
        self.visits += chosen.visits
        self.visit(list(chosen.visits))

    def true(self) -> FloatArray:
        """Return the true RMS beam error of the mirrors over the suns of the year, rad, (N,)."""
        total, count = np.zeros((2, len(self.truth)))
        aim = self.fleet.aim
        for sun in self.suns:
            solved = track(self.believed, sun, aim)
            good = np.flatnonzero(solved.reachable)
            seen = sightings(
                np.arange(len(good)),
                solved.best_counts[good],
                np.broadcast_to(sun, (len(good), 3)),
                aim[good],
            )
            off = beam_errors(self.truth[good], seen).offset
            total[good] += np.sum(off**2, axis=-1)
            count[good] += 1.0
        mean = total[count > 0] / count[count > 0]
        return np.asarray(np.sqrt(mean + self.terms.floor**2))

    def percentiles(self) -> tuple[FloatArray, FloatArray]:
        """Return the believed and the true 50th and 90th percentile, rad, (2,) each."""
        believed = error_percentiles(
            self.fleet.form, as_float(self.covariance), (0.5, 0.9), self.terms.floor**2
        )
        return believed, np.quantile(self.true(), (0.5, 0.9))


def come_true(
    plan: CommissionPlan, mirrors: Commissioned, looks: int = 6
) -> list[tuple[float, FloatArray, FloatArray, FloatArray]]:
    """Make the visits that a plant makes; return time, predicted, believed and true percentiles.

    The visits of each interval are chosen at its beginning from what is believed then: a beam that
    was missed is looked for again, whatever the plan had expected.

    Parameters
    ----------
    plan, mirrors
        The plan, and the mirrors.
    looks
        Comparisons, spread evenly over the intervals.
    """
    found = []
    when = np.unique(np.linspace(0, len(plan.time) - 1, looks + 1).round().astype(int))[1:]
    for k in range(1, len(plan.time)):
        begin, end = (float(t) for t in plan.time[k - 1 : k + 1])
        day = next(day for day in plan.days if day[0] < end <= day[1] + 1.0)
        mirrors.live(max(begin, day[0]), end)
        if k in when:
            found.append((end, plan.percentiles[k], *mirrors.percentiles()))
    return found


@dataclass(frozen=True)
class _Case:
    """A way to commission a field.

    ``flown``: a drone flies before the first day. ``other``: the true errors are not drawn from the
    priors, but those of `roughly_installed` of the same size, with a canting that no parameter of
    the model describes.
    """

    name: str
    terms: CommissionTerms
    flown: bool = False
    other: bool = False


def _cases(quick: bool) -> list[_Case]:
    alone = CommissionTerms(goal=GOAL)
    # The visits of the simulated plant, single and joint ones.
    settings = settings_for(CYCLE)
    plant = replace(terms_of(settings, JointSettings()), goal=GOAL)
    joint = plant.joint or JointTerms()
    lost = replace(plant, joint=replace(joint, tries=1))
    plant = replace(plant, joint=replace(joint, tries=9))
    cases = [
        _Case("one at a time", alone),
        _Case("one at a time, one photograph", replace(alone, shots=1)),
        _Case("joint visits, first visits alone", replace(plant, joint=replace(joint, first=0))),
        _Case("joint visits, missed beams alone", lost),
        _Case("joint visits", plant),
        _Case("the same, other errors than the priors", plant, other=True),
        _Case("joint visits after a drone", plant, flown=True),
        _Case("the same, and 0.5 mrad not repeated", replace(plant, repeat=5e-4), flown=True),
    ]
    return cases[4:5] if quick else cases


def _row(case: _Case, plant: Plant, fleet: Fleet, quick: bool) -> Row:
    mirrors = Commissioned.begin(plant, fleet, case.terms)
    if case.other:
        mirrors.truth = _other(mirrors)
    if case.flown:
        mirrors.fly()
        fleet = replace(fleet, information=np.linalg.inv(mirrors.covariance))
    begin = time.perf_counter()
    plan = plan_commission(
        [fleet],
        plant.site,
        plant.targets,
        START,
        START + DAYS * 86400.0,
        size=_SIZE,
        measured=case.flown,
        # The plant goes on measuring when its goal is reached.
        terms=replace(case.terms, goal=0.0),
    )
    planned = time.perf_counter() - begin
    looks = come_true(plan, mirrors, 1 if quick else 3)
    _, predicted, believed, true = looks[-1]
    later = [v for v in mirrors.visits if v.joint and not v.own]
    busy = sum(v.end - v.begin for v in later)
    return {
        "case": case.name,
        "visits": len(mirrors.visits),
        "sightings": 0 if mirrors.made is None else len(mirrors.made),
        "never_measured": int((~mirrors.measured).sum()),
        "later_mirrors_an_hour_and_target": round(3600.0 * mirrors_of(later) / max(busy, 1.0)),
        "goal_after_h_of_sun": _sun_hours(plan),
        "predicted_50_90_mrad": _pair(predicted),
        "believed_50_90_mrad": _pair(believed),
        "true_50_90_mrad": _pair(true),
        "true_over_predicted_90": round(float(true[1] / predicted[1]), 3),
        "plan_s": round(planned, 1),
    }


def _other(mirrors: Commissioned) -> Mechanism:
    """Return true mechanisms with the errors of a quick installation, of the size of the priors."""
    wanted = float(np.sqrt(np.mean(mirrors.true() ** 2)))
    mirrors.truth = roughly_installed(mirrors.nominal, 1)
    found = float(np.sqrt(np.mean(mirrors.true() ** 2)))
    return roughly_installed(mirrors.nominal, 1, wanted / found)


def _pair(values: FloatArray) -> str:
    return f"{1e3 * values[0]:.2f} {1e3 * values[1]:.2f}"


def _sun_hours(plan: CommissionPlan) -> float | None:
    """Hours of sun until the predicted 90th percentile is that of the goal."""
    good = np.flatnonzero(plan.percentiles[:, 1] <= GOAL)
    if not len(good):
        return None
    reached = float(plan.time[good[0]])
    used = sum(max(0.0, min(end, reached) - begin) for begin, end in plan.days)
    return round(used / 3600.0, 1)


def run(quick: bool) -> Result:
    """Compare the predictions of several plans with what comes true."""
    plant = malan_plant(120 if quick else 10_000)
    (fleet,) = fleets_of(plant, year=2026, model="malan8", installed=INSTALLED)
    rows = [_row(case, plant, fleet, quick) for case in _cases(quick)]
    ratios = [float(row["true_over_predicted_90"] or 0.0) for row in rows]
    worst = max(ratios, key=lambda r: abs(np.log(max(r, 1e-9))))
    return Result(
        rows,
        f"{len(plant):,} mirrors at {1e3 * INSTALLED:.0f} mrad: the true 90th percentile is "
        f"{worst:.2f} of the predicted one at worst",
        {"heliostats": len(plant), "days": DAYS, "goal_mrad": 1e3 * GOAL},
        within_budget=abs(worst - 1.0) <= 0.2,
    )
