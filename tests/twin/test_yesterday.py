"""Yesterday's calibrations: honest errors, records as a plant keeps them, and a plant on them."""

import asyncio
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from heliotrope import sun
from heliotrope.calibration.evaluation import beam_errors
from heliotrope.errors import InputError
from heliotrope.field.layouts import malan_plant
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.visits.settings import SIMPLE
from heliotrope.store.keeper import Keeper
from heliotrope.twin.field import Field
from heliotrope.twin.live import CYCLE, WorldOptions, true_mechanisms
from heliotrope.twin.yesterday import (
    AGAIN,
    CAMPAIGN,
    NOTE,
    Yesterday,
    begin_second_day,
    measure_yesterday,
    with_records,
)
from support.live import LiveOptions, LivePlant
from support.six_kinds import mixed

MRAD = 1e-3
START = datetime(2026, 11, 28, 8, tzinfo=UTC)
DAY = 86_400.0


@cache
def field(count: int) -> Plant:
    return malan_plant(count)


def as_the_priors_say(nominal: Mechanism) -> Mechanism:
    """Return mechanisms whose errors are draws from the priors of the model."""
    rng = np.random.default_rng(5)
    names = parameter_table.model(SIMPLE, nominal.parameters)
    sizes = {name: nominal.parameter(name).prior for name in names}
    return nominal.with_parameters(
        {name: rng.normal(0.0, size, nominal.shape) for name, size in sizes.items()}
    )


def deviations(truth: Mechanism, names: tuple[str, ...]) -> FloatArray:
    """Return the true parameters, (N, P)."""
    columns = [np.broadcast_to(truth.deviations.get(name, 0.0), truth.shape) for name in names]
    return np.stack(columns, axis=1)


@cache
def measured() -> tuple[Plant, Mechanism, Yesterday]:
    design = field(2000)
    truth = true_mechanisms(design, WorldOptions(installed=as_the_priors_say))
    return design, truth, measure_yesterday(design, truth, START, count=1500)


def test_errors_are_those_that_the_covariances_predict() -> None:
    design, truth, day = measured()
    row = {name: i for i, name in enumerate(design.names)}
    true = deviations(truth, day.calibrations[0].names)
    # After one visit, angles unknown by 10 mrad curve what a photograph tells by 0.05 mrad, half of
    # its noise: a tenth of the square, which a linear covariance does not see.
    for version, curvature in ((1, 0.1), (2, 0.0)):
        made = [record for record in day.calibrations if record.version == version]
        off = np.stack([record.values - true[row[record.heliostat]] for record in made])
        whole = np.stack([record.covariance for record in made])
        square = np.einsum("np,npq,nq->n", off, np.linalg.inv(whole), off)
        # The mean of a χ² of P degrees of freedom is P, and its variance 2 P.
        freedom = off.shape[1]
        spread = np.sqrt(2.0 * freedom / len(made))
        assert square.mean() == pytest.approx(freedom, abs=4.0 * spread + curvature * freedom)
        # The photographs have taught much: the priors alone allow far more.
        tilt = made[0].names.index("tilt_north")
        assert np.median(whole[:, tilt, tilt]) < 0.3 * made[0].prior[tilt] ** 2


def test_visits_are_made_by_day_nearest_first_and_the_first_of_them_twice() -> None:
    design, truth, day = measured()
    count = len({record.heliostat for record in day.calibrations})
    assert count == 1500
    assert len(day.visits) == len(day.calibrations) == count + round(AGAIN * count)
    begun = np.array([visit.begun for visit in day.visits])
    assert (np.diff(begun) >= 0.0).all()
    light = sun.position(begun, design.site)
    assert light.elevation.min() >= np.radians(14.9)
    assert light.azimuth.max() - light.azimuth.min() > 2.0
    last = datetime.fromtimestamp(begun[-1], UTC)
    assert last < START
    assert START.timestamp() - begun[0] < 1.5 * DAY
    # Nearest to a target first.
    row = {name: i for i, name in enumerate(design.names)}
    centers = np.stack([target.center for target in design.targets])
    away = np.linalg.norm(design.position[:, None] - centers, axis=-1).min(axis=1)
    first = away[[row[visit.heliostat] for visit in day.visits if visit.version == 1]]
    assert (np.diff(first) >= 0.0).all()
    twice = {visit.heliostat for visit in day.visits if visit.version == 2}
    assert max(away[row[name]] for name in twice) <= np.median(first) + 1e-9
    assert {visit.target for visit in day.visits} == {target.name for target in design.targets}
    # What the visits state is what their sightings show.
    by_name = {(r.heliostat, r.version): r for r in day.calibrations}
    for visit in day.visits[:: len(day.visits) // 20]:
        record = by_name[visit.heliostat, visit.version]
        seen = day.sightings.take(record.sightings)
        assert visit.begun < seen.time[-CYCLE.shots] <= seen.time[-1] < visit.finished == record.at
        assert set(day.targets[record.sightings[-CYCLE.shots :]]) == {visit.target}
        place = np.array([row[visit.heliostat]])
        assert (seen.heliostat == place).all()
        one = seen.renumbered(np.zeros(len(seen)))
        nominal = design.groups[next(iter(design.groups))].mechanism[place]
        after = beam_errors(record.mechanism(nominal), one)
        assert np.sqrt(np.mean(after.beam**2)) == pytest.approx(record.after)
        assert np.allclose(after.offset, record.residual_after)
        # The beam of the true mirror met the target there, but for the noise.
        assert beam_errors(truth[place], one).beam.max() < 6.0 * CYCLE.sigma
        assert design.target(visit.target).holds(seen.destination).all()
    second = [visit for visit in day.visits if visit.version == 2]
    assert all(visit.sigma_after < visit.sigma_before for visit in second)


def test_the_seed_decides() -> None:
    design = field(40)
    truth = true_mechanisms(design, WorldOptions())
    one, same, other = (
        measure_yesterday(design, truth, START, count=10, seed=seed) for seed in (1, 1, 2)
    )
    assert (one.sightings.destination == same.sightings.destination).all()
    assert (one.calibrations[3].values == same.calibrations[3].values).all()
    assert not (one.calibrations[3].values == other.calibrations[3].values).any()


def test_several_groups_and_kinds_are_measured() -> None:
    design = mixed(["azimuth_elevation", "two_jacks"], 3)
    truth = true_mechanisms(design, WorldOptions())
    day = measure_yesterday(design, truth, START)
    assert {record.heliostat for record in day.calibrations} == set(design.names)
    assert max(record.after for record in day.calibrations) < 4.0 * CYCLE.sigma


def test_a_day_without_light_and_a_count_of_none_bring_nothing() -> None:
    design = field(40)
    truth = true_mechanisms(design, WorldOptions())
    assert not measure_yesterday(design, truth, START, count=0).visits
    polar = replace(design, site=replace(design.site, latitude_deg=89.0))
    assert not measure_yesterday(polar, truth, START).visits
    with pytest.raises(InputError, match="-1 heliostats on 2 targets; specify 0 or more"):
        measure_yesterday(design, truth, START, count=-1)
    with pytest.raises(InputError, match="and a plant with a target"):
        measure_yesterday(replace(design, targets=(), cameras=()), truth, START)


def test_a_store_keeps_the_day_once(tmp_path: Path) -> None:
    design = field(40)
    truth = true_mechanisms(design, WorldOptions())
    keeper = Keeper(tmp_path, inline=True)
    begun = begin_second_day(keeper, design, truth, START, count=10)
    stored = asyncio.run(begun)
    day = measure_yesterday(design, truth, START, count=10)
    kept, latest = keeper.sightings(), keeper.latest_calibrations()
    assert len(kept) == len(day.sightings)
    assert len(latest) == 10
    assert [visit.text for visit in keeper.visits()] == [v.text for v in day.visits[::-1]]
    assert "(simulated)" in keeper.visits(1)[0].text
    (campaign,) = keeper.campaigns()
    assert (campaign.name, campaign.note) == (CAMPAIGN, NOTE)
    assert "simulated" in NOTE
    for record in day.calibrations:
        found = keeper.calibration_history(record.heliostat)[record.version - 1]
        assert (found.values == record.values).all()
        assert (found.covariance == record.covariance).all()
        assert found.note == NOTE
        # Its sightings are those that it was fitted to, whatever their numbers.
        rows = np.flatnonzero(np.isin(kept.identities, found.sightings))
        here = kept.sightings.take(rows)
        assert {kept.names[row] for row in here.heliostat} == {record.heliostat}
        assert sorted(here.time) == sorted(day.sightings.time[record.sightings])
    # The plant that is returned holds the latest; the other heliostats are as the plant file says.
    (group,) = stored.groups.values()
    for name, record in latest.items():
        row = group.names.index(name)
        values = [group.parameters[parameter][row] for parameter in record.names]
        assert (values == record.values).all()
    new = [i for i, name in enumerate(group.names) if name not in latest]
    assert not any(group.parameters[parameter][new].any() for parameter in group.parameters)
    again = asyncio.run(begin_second_day(keeper, design, truth, START, count=30, seed=9))
    assert len(keeper.latest_calibrations()) == 10
    assert (
        again.groups[next(iter(again.groups))].calibrated.angles == group.calibrated.angles
    ).all()
    keeper.close()


def test_a_plant_takes_yesterday_over_and_goes_on_with_other_heliostats(tmp_path: Path) -> None:
    design = malan_plant(24)
    work = AutomaticSettings(wanted=True)
    options = LiveOptions(rendered=False, threads=0, together=True, work=work)

    async def main(clock: VirtualClock) -> None:
        truth = true_mechanisms(design, options.world())
        stored = await begin_second_day(keeper, design, truth, clock.utc(), count=12)
        made = LivePlant(design, clock, options, records=keeper, stored=stored)
        assert isinstance(made.field, Field)
        for row, name in enumerate(made.world.names):
            believed = made.plant.beliefs.present(name).armature.table[0]
            assert (made.field.journals.armatures[row] == believed).all()
        async with made.running() as live:
            beliefs, book = live.plant.beliefs, live.operations.automatic.book
            known = {record.heliostat for record in beliefs}
            mine = np.isin(live.names, list(known))
            assert len(beliefs) == len(known) == 12
            assert (np.isfinite(book.error) == mine).all()
            assert set(book.sightings[mine]) == {4, 8}
            assert np.isfinite(book.calibrated_at[mine]).all()
            _shows_the_day_before(live)
            await asyncio.sleep(45.0)
            assert not live.plant.wanted.missing
            errors = live.errors()
            tracks = mine & np.isfinite(errors)
            assert tracks.sum() >= 8
            ratio = np.sqrt(np.mean((errors[tracks] / book.error[tracks]) ** 2))
            assert 0.3 < ratio < 1.6
            others = errors[~mine & np.isfinite(errors)]
            assert np.median(errors[tracks]) < 0.3 * np.median(others)
            assert book.quality[-1].calibrated == 12
            schedule = live.assembly.schedule
            assert schedule is not None
            expected = schedule.scheduler.expected(clock.utc())
            assert expected[mine].max() < 0.7 * expected[~mine].min()
            while len(beliefs) == 12:
                await asyncio.sleep(2.0)
            assert not {record.heliostat for record in beliefs} <= known
            await live.end()

    keeper = Keeper(tmp_path, inline=True)
    run_virtual(main, start=START)
    keeper.close()


def _shows_the_day_before(live: LivePlant) -> None:
    """The results of yesterday are in the page's table, in its trend and with each heliostat."""
    view = live.operations.automatic.view()
    kept = keeper_visits(live)
    assert [(r.at, r.heliostat, r.text) for r in view.results] == kept
    assert view.failed == 0
    assert all(result.good and "(simulated)" in result.text for result in view.results)
    trend = [point for point in view.quality if np.isnan(point.truth_median)]
    counts = [point.calibrated for point in trend]
    assert counts == sorted(counts)
    assert counts[-1] == 12
    assert all(0.0 < point.median <= point.percentile_90 for point in trend)
    again = [r.heliostat for r in view.results if r.sightings == 8]
    assert again, "some were visited twice"
    history = live.operations.viewer.heliostat(again[0]).results
    assert [(r.new, r.sightings) for r in history] == [(4, 4), (4, 8)]


def keeper_visits(live: LivePlant) -> list[tuple[float, str, str]]:
    """Return when visits ended, whose they were, and what came of them, the latest first."""
    records = live.assembly.ports.records
    assert records is not None
    return [(visit.finished, visit.heliostat, visit.text) for visit in records.visits()]


def test_records_of_several_models_make_one_plant() -> None:
    design = field(40)
    truth = true_mechanisms(design, WorldOptions())
    day = measure_yesterday(design, truth, START, count=4)
    first = [record for record in day.calibrations if record.version == 1]
    short = replace(
        first[0],
        names=first[0].names[:2],
        values=first[0].values[:2],
        covariance=first[0].covariance[:2, :2],
        prior=first[0].prior[:2],
    )
    (group,) = with_records(design, [short, first[1]]).groups.values()
    nominal = next(iter(design.groups.values())).mechanism
    for record in (short, first[1]):
        row = np.array([group.names.index(record.heliostat)])
        believed = record.mechanism(nominal[row])
        assert (group.calibrated[row].armature.table == believed.armature.table).all()
