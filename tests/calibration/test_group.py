"""Hyperparameters of a group: learnt from the photographs of a plant, and used for each mirror."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit import fit
from heliotrope.calibration.growth import Growth
from heliotrope.calibration.learn import group, present, worker
from heliotrope.calibration.learn.group import GroupHistory, LearntGroup
from heliotrope.errors import InputError
from heliotrope.field.layouts import malan_plant
from heliotrope.mechanism import parameters
from support.drifting import DAY, SIZE, TAU, history

PLANT = malan_plant(6)
NOMINAL = next(iter(PLANT.groups.values())).mechanism
MODEL = parameters.model("malan8", NOMINAL.parameters)
DEFAULTS = group.defaults(NOMINAL, MODEL)
SEEN = tuple(history(PLANT, name, 24, 1) for name in PLANT.names)
ALL = GroupHistory(NOMINAL, SEEN, MODEL, DEFAULTS)


@pytest.fixture(scope="module")
def found() -> LearntGroup:
    return group.learn_group(group.gathered(ALL))


def moved(growth: Growth, days: float) -> float:
    """How far a zero is believed to wander within days, rad."""
    return float(np.sqrt(growth.variances(DEFAULTS.names, days)).max())


def test_a_wandering_unlike_the_default_is_learnt(found: LearntGroup) -> None:
    """Over the days between visits, which is what a visit and a schedule need of it."""
    assert (found.heliostats, found.sightings) == (6, 6 * 72)
    assert found.gain > 0.3
    for days in (1.0, 5.0, 15.0):
        true = SIZE * np.sqrt(2.0 * -np.expm1(-days / TAU))
        assert moved(Growth.of(found.hyper, ""), days) == pytest.approx(true, rel=0.35)
        assert moved(Growth.of(DEFAULTS, ""), days) < 0.5 * true


def test_a_replay_by_what_was_learnt_misses_less_tomorrow(found: LearntGroup) -> None:
    """Judged on a mirror and days that were not learnt from, one visit ahead."""
    other = malan_plant(7)
    nominal = next(iter(other.groups.values())).mechanism[6:7]
    seen = history(other, other.names[6], 40, 2)
    missed: dict[bool, list[float]] = {False: [], True: []}
    for day in range(20, 40):
        known, next_one = seen.take(np.arange(3 * day)), seen.take(3 * day + np.arange(3))
        constants = fit(nominal, known, MODEL)
        for learnt in (False, True):
            hyper = found.hyper if learnt else None
            now = present.fitting_present(nominal, known, constants, hyper)
            moved_so = nominal.with_parameters(now.parameters)
            missed[learnt].append(float(np.mean(beam_errors(moved_so, next_one).beam ** 2)))
    assert np.mean(missed[True]) < 0.95 * np.mean(missed[False])


def test_what_a_model_does_not_know_keeps_its_default(found: LearntGroup) -> None:
    nominal, seen = NOMINAL[:1], SEEN[0]
    whole = fit(nominal, seen, parameters.model("full", NOMINAL.parameters))
    mixed = present.hyper_of(nominal, whole, found.hyper)
    assert mixed.noise == found.hyper.noise
    place, theirs = mixed.names.index("tilt_east"), found.hyper.names.index("tilt_east")
    assert mixed.spread[place] == found.hyper.spread[theirs]
    (extra, *_) = set(whole.names) - set(found.hyper.names)
    place = mixed.names.index(extra)
    assert mixed.spread[place] == whole.prior[0, whole.names.index(extra)]


def test_too_few_mirrors_teach_nothing() -> None:
    short = SEEN[0].take(np.arange(6))
    one_day = replace(SEEN[1], time=np.full(len(SEEN[1]), SEEN[1].time[0]))
    few = replace(ALL, sightings=(*SEEN[:3], short, one_day, None))
    with pytest.raises(InputError, match="3 heliostats with 8 photographs on different days; 4"):
        group.gathered(few)


def test_a_long_history_is_thinned_by_whole_visits() -> None:
    long = history(PLANT, PLANT.names[0], 100, 3)
    mixed = long.take(np.random.default_rng(1).permutation(len(long)))
    some = group.thinned(mixed, 60)
    assert 50 <= len(some) <= 60
    assert some.time[-1] == long.time[-1]
    assert some.time[0] < long.time[0] + 6 * DAY
    visits, counts = np.unique(some.time // DAY, return_counts=True)
    assert (counts == 3).all()
    assert len(visits) == len(some) // 3
    assert len(group.thinned(mixed, 1000)) == len(long)


def test_hyperparameters_survive_their_document(found: LearntGroup) -> None:
    document = json.loads(json.dumps(group.document_of(found.hyper)))
    same = group.read_hyperparameters(document)
    assert group.document_of(same) == document
    assert same.processes == found.hyper.processes
    wrong: list[dict[str, Any]] = [
        {},
        {**document, "mean": document["mean"][1:]},
        {**document, "noise": float("nan")},
        {**document, "amplitude": [*document["amplitude"], 1.0]},
        {**document, "processes": [["no_such", "slow"]]},
    ]
    for each in wrong:
        with pytest.raises(InputError, match=r"hyperparameters: .*; learn the group again"):
            group.read_hyperparameters(each)


def test_the_words_name_drift_steps_and_noise(found: LearntGroup) -> None:
    said = group.described(DEFAULTS)
    assert "zeros wander by 1 and 1 mrad over 300 days" in said
    assert "a step in 1000 days, noise 0.50 times a photograph's sigma" in said
    assert group.described(found.hyper) != said


def test_an_answer_that_is_none_is_named() -> None:
    for text in (b"", b"[]", b"{}", b'{"hyper": {}, "heliostats": 1, "sightings": 1, "gain": 0}'):
        with pytest.raises(InputError):
            worker.answered(text)
    with pytest.raises(InputError, match="LinAlgError: singular"):
        worker.answered(b'{"error": "LinAlgError: singular"}')
