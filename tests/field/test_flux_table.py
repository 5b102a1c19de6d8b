"""A limit over temperature and velocity of the fluid, on the panels of a receiver."""

from pathlib import Path

import numpy as np
import pytest

from heliotrope.errors import FormatError, HeliotropeError, InputError
from heliotrope.field.flux_table import FluxTable, Panel, limit_of, read_table_limit

HEAT, SPEED = np.array([290.0, 430.0, 570.0]), np.array([1.0, 2.0, 4.0])
TABLE = FluxTable(HEAT, SPEED, 1e6 - 1e3 * (HEAT[:, None] - 290.0) + 1e5 * SPEED)
LINES = "temperature_c,velocity_m_s,flux_w_m2\n290,1,8e5\n570,1,4e5\n290,3,1.2e6\n570,3,6e5\n"
PANELS = (
    "path,begin,end,flow,inlet_c,outlet_c,velocity_m_s\n"
    "a,0,0.25,up,290,430,2\na,0.25,0.5,down,430,570,2\nb,0.5,1,up,290,570,3\n"
)


def test_between_its_lines_a_table_is_linear() -> None:
    heat, speed = np.array([290.0, 360.0, 501.0, 570.0]), np.array([1.0, 1.7, 3.1, 4.0])
    np.testing.assert_allclose(TABLE.at(heat, speed), 1e6 - 1e3 * (heat - 290.0) + 1e5 * speed)
    one = FluxTable(np.array([300.0]), np.array([2.0]), np.array([[5e5]]))
    assert one.at(np.array([300.0]), np.array([2.0])) == 5e5
    for heat_c, speed_m_s, text in (
        (289.0, 2.0, "temperature of 289 °C"),
        (300.0, 5.0, "velocity"),
    ):
        with pytest.raises(InputError, match=text):
            TABLE.at(np.array([heat_c]), np.array([speed_m_s]))


def test_the_limit_falls_along_the_flow_and_no_cell_allows_more_than_its_hot_end() -> None:
    panels = (
        Panel("a", 0.0, 0.25, True, 290.0, 430.0, 2.0),
        Panel("a", 0.25, 0.5, False, 430.0, 570.0, 2.0),
        Panel("b", 0.5, 1.0, True, 290.0, 570.0, 4.0),
    )
    got = limit_of(TABLE, panels, 0.1).on(7, 8)
    heat = 290.0 + 140.0 * np.arange(1, 8) / 7
    # A cell of the map may reach beyond the receiver's by one of its 60 rows: 2.4 K.
    exact = 0.9 * (1.2e6 - 1e3 * (heat - 290.0))
    assert (got[:, 0] <= exact + 1e-6).all()
    np.testing.assert_allclose(got[:, 0], exact, atol=0.9 * 2.4e3)
    assert (np.diff(got[:, :2], axis=0) < 0.0).all()
    assert (np.diff(got[:, 2:4], axis=0) > 0.0).all(), "downwards"
    assert got[-1, 2] < got[-1, 1]
    assert got[0, 7] > got[0, 0], "faster"


def test_files_are_read_and_what_does_not_fit_is_one_line(tmp_path: Path) -> None:
    def read(lines: str = LINES, panels: str = PANELS) -> None:
        (tmp_path / "afd.csv").write_text(lines)
        (tmp_path / "panels.csv").write_text(panels)
        read_table_limit(tmp_path / "afd.csv", tmp_path / "panels.csv")

    read()
    for wrong, text in (
        ({"lines": LINES.replace("570,3,6e5\n", "")}, "no flux for 570 °C at 3 m/s"),
        ({"lines": LINES + "570,3,7e5\n"}, "line 6.*twice"),
        ({"lines": LINES.replace("8e5", "much")}, "line 2, column flux_w_m2"),
        ({"lines": LINES.replace("8e5", "-1")}, "is outside 1 to"),
        ({"lines": LINES.replace("flux_w_m2", "flux")}, "no column flux_w_m2"),
        ({"lines": LINES.splitlines()[0] + "\n"}, "no rows"),
        ({"panels": PANELS.replace("0.25,0.5", "0.3,0.5")}, "0.25 to 0.3 is without a limit"),
        ({"panels": PANELS.replace("b,0.5,1", "b,0.4,1")}, "0.4 to 0.5 is on two panels"),
        ({"panels": PANELS.replace("b,0.5,1", "b,0.5,0.9")}, "0.9 to 1 is without a limit"),
        ({"panels": PANELS.replace("b,0.5,1", "b,1,0.5")}, "line 4.*edges must increase"),
        ({"panels": PANELS.replace("down", "left")}, "flow must be up or down, not 'left'"),
        ({"panels": PANELS.replace("430,570", "400,570")}, "path a enters a panel at 400 °C"),
        ({"panels": PANELS.replace("290,570", "290,600")}, "°C is outside the table's 290 to 570"),
    ):
        with pytest.raises(HeliotropeError, match=text) as refusal:
            read(**wrong)
        assert "\n" not in str(refusal.value)
    with pytest.raises(FormatError, match=r"none\.csv"):
        read_table_limit(tmp_path / "none.csv", tmp_path / "panels.csv")
