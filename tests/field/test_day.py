"""A plant, a heliostat or mechanisms through a day."""

from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest

import heliotrope as ht
from heliotrope.errors import InputError, UnknownNameError

PLANT = ht.example_plant()


def test_a_day_of_one_and_of_all_agree() -> None:
    hour = timedelta(minutes=30)
    one = ht.track_day(PLANT["P6A"], "2026-09-02", "target", every=hour)
    whole = ht.track_day(PLANT, "2026-09-02", every=hour)
    assert one.names == ("P6A",)
    assert whole.names == PLANT.names
    assert whole.path.counts.shape == (len(whole), 18, 2)
    row = PLANT.names.index("P6A")
    np.testing.assert_array_equal(one.path.counts, whole.path.counts[:, row])
    assert not one.path.slews
    alone = ht.track_day(
        PLANT["P6A"].calibrated, "2026-09-02", one.aim, site=PLANT.site, every=hour
    )
    np.testing.assert_array_equal(alone.path.counts, one.path.counts)
    assert str(one.time.tz) == "UTC"


def test_own_aims_come_first() -> None:
    group = PLANT.groups["azel"]
    aim = np.full((18, 3), np.nan)
    aim[4] = (1.0, 2.0, 15.0)
    plant = PLANT.with_groups({"azel": replace(group, aim=aim)})
    day = ht.track_day(plant, "2026-09-02", every=timedelta(hours=2))
    np.testing.assert_array_equal(day.aim[4], aim[4])
    np.testing.assert_array_equal(day.aim[3], PLANT.targets[0].center)


def test_what_is_missing_is_asked_for() -> None:
    with pytest.raises(InputError, match="site=Site"):
        ht.track_day(PLANT["P6A"].nominal, "2026-09-02", (0.0, 0.0, 13.0))
    with pytest.raises(InputError, match="no target"):
        ht.track_day(PLANT["P6A"].nominal, "2026-09-02", site=PLANT.site)
    with pytest.raises(UnknownNameError, match="did you mean target"):
        ht.track_day(PLANT["P6A"], "2026-09-02", "targt")
    night = ht.Site(85.0, 0.0, 0.0)
    with pytest.raises(InputError, match="does not rise"):
        ht.track_day(PLANT["P6A"], "2026-12-21", site=night)
