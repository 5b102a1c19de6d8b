"""PAINT's splits: the rules of its splitter, on sightings drawn for the purpose."""

from datetime import UTC, datetime

import numpy as np
import pytest

from heliotrope.calibration.evaluation import partition, split
from heliotrope.calibration.paint_splits import KINDS, paint_split
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.geometry import direction


def _drawn(counts: tuple[int, ...]) -> Sightings:
    rng = np.random.default_rng(1)
    rows = np.repeat(np.arange(len(counts)), counts)
    sun = direction(
        rng.uniform(0.5 * np.pi, 1.5 * np.pi, len(rows)), rng.uniform(0.1, 1.0, len(rows))
    )
    time = datetime(2022, 3, 1, tzinfo=UTC).timestamp() + rng.uniform(0, 700 * 86400, len(rows))
    return sightings(rows, np.zeros((len(rows), 2)), sun, np.zeros(3), time=time)


@pytest.mark.parametrize("kind", KINDS)
def test_the_parts_have_the_sizes_that_paint_asks_for(kind: str) -> None:
    """100 to train, 30 to validate, at least 30 to test; in proportion for 80 sightings."""
    seen = _drawn((200, 80, 1))
    training, tested = paint_split(seen, kind)
    assert not (training & tested).any()
    for heliostat, (trained, rest) in enumerate([(100, 30), (50, 15)]):
        mine = seen.heliostat == heliostat
        assert (training & mine).sum() == trained
        spread = kind in ("azimuth", "solstice")
        assert (tested & mine).sum() == (mine.sum() - trained - rest if spread else rest)
    # One sighting cannot be divided.
    assert training[-1]
    assert not tested[-1]
    assert (partition(seen, kind)[1] == tested).all()  # type: ignore[arg-type]
    assert (split(seen, kind) == training).all()  # type: ignore[arg-type]


def test_azimuth_is_trained_in_the_west() -> None:
    seen = _drawn((200,))
    training, tested = paint_split(seen, "azimuth")
    east = np.arctan2(seen.source[:, 0], -seen.source[:, 1])
    assert east[training].max() < east[tested].min()
    assert east[tested].max() < east[~training & ~tested].min()


def test_solstice_is_trained_in_winter() -> None:
    seen = _drawn((200,))
    training, tested = paint_split(seen, "solstice")
    validated = ~training & ~tested
    month = np.array([datetime.fromtimestamp(t, UTC).month for t in seen.time])
    assert set(month[validated]) <= {5, 6, 7}
    assert not set(month[training]) & {6, 7}
    assert {12, 1} <= set(month[training])


def test_high_variance_is_tested_where_the_sun_was_rarely_seen() -> None:
    seen = _drawn((200,))
    training, tested = paint_split(seen, "high-variance")
    sky = np.c_[np.arctan2(seen.source[:, 0], -seen.source[:, 1]), np.arcsin(seen.source[:, 2])]
    apart = np.sort(np.linalg.norm(sky[:, None] - sky, axis=-1), axis=1)[:, 1:4].mean(axis=1)
    assert apart[training].max() < apart[tested].min()


def test_balanced_tests_everywhere_in_the_sky() -> None:
    seen = _drawn((200,))
    _, tested = paint_split(seen, "balanced")
    east = np.arctan2(seen.source[:, 0], -seen.source[:, 1])
    parts = np.histogram(east[tested], bins=np.quantile(east, [0, 0.25, 0.5, 0.75, 1.0]))[0]
    assert parts.min() >= 4
    assert (paint_split(seen, "balanced", 1)[1] != tested).any()
