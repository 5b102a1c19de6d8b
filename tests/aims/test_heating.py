"""How far a receiver may be heated now."""

import numpy as np

from heliotrope.aims.heating import WARM, Heating

RATE, WINDOW, CELL = 2.0, 10.0, (1, 1)


def test_the_allowed_flux_rises_along_the_ramp_although_heliostats_are_late() -> None:
    heating, line = Heating(RATE, WINDOW), [0.0, 0.0]
    for at in range(0, 60, 3):
        # What was allowed 6 s ago has come by now.
        heating.note(at, np.full(CELL, line[-2]))
        line.append(float(heating.allowed(at, CELL)[0, 0]))
    assert line[2] == RATE * WINDOW
    np.testing.assert_allclose(np.diff(line[3:]), RATE * 3)


def test_a_cloud_leaves_one_window_and_the_sun_begins_there() -> None:
    heating = Heating(RATE, WINDOW)
    heating.note(0.0, np.full(CELL, 100.0))
    assert heating.allowed(0.0, CELL) == 120.0
    heating.note(30.0, np.full(CELL, 1.0))
    assert heating.allowed(30.0, CELL) == 120.0, "it was warm within the last minute"
    heating.note(WARM + 1.0, np.full(CELL, 1.0))
    assert heating.allowed(WARM + 1.0, CELL) == 21.0
    # The sun is back: the 20 W/m² that were allowed come at once, and more along the ramp.
    heating.note(WARM + 2.0, np.full(CELL, 20.0))
    assert heating.allowed(WARM + 2.0, CELL) == 23.0
    assert heating.allowed(WARM + 5.0, CELL) == 29.0


def test_no_backlog_builds_up_while_no_heliostat_can_come() -> None:
    heating = Heating(RATE, WINDOW)
    assert heating.allowed(0.0, CELL) == 20.0
    assert heating.allowed(600.0, CELL) == 20.0


def test_before_the_night_the_flux_falls_along_the_ramp() -> None:
    heating = Heating(RATE, WINDOW)
    heating.note(0.0, np.full(CELL, 100.0))
    assert heating.allowed(0.0, CELL, 80.0) == 120.0, "not yet"
    assert heating.allowed(40.0, CELL, 40.0) == 80.0
    assert heating.allowed(80.0, CELL, 0.0) == 0.0
