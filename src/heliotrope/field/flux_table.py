"""The allowable flux as a table over temperature and velocity, and the path of the fluid.

Allowable flux densities of salt receivers are published as tables: the hotter and slower the fluid
in a tube, the less flux the tube wall withstands. The panels of the receiver, in flow order,
specify how hot and how fast the fluid is at each position.
"""

import operator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heliotrope.errors import FormatError, InputError
from heliotrope.field.flux_limit import MOST, FluxLimit
from heliotrope.files.cells import Rows, read_rows
from heliotrope.geometry import FloatArray, as_float

#: Columns of the two files.
TABLE_COLUMNS = ("temperature_c", "velocity_m_s", "flux_w_m2")
PANEL_COLUMNS = ("path", "begin", "end", "flow", "inlet_c", "outlet_c", "velocity_m_s")
#: Rows and columns of the map that stands for a table.
_ROWS, _COLUMNS = 60, 360


@dataclass(frozen=True, eq=False)
class FluxTable:
    """The allowable flux at temperatures and velocities of the fluid.

    Attributes
    ----------
    temperature
        °C, ascending, (T,).
    velocity
        m/s, ascending, (V,).
    flux
        W/m², (T, V).
    """

    temperature: FloatArray
    velocity: FloatArray
    flux: FloatArray

    def __post_init__(self) -> None:
        shape = (len(self.temperature), len(self.velocity))
        if self.flux.shape != shape or min(shape) < 1:
            raise InputError(
                f"flux table: {self.flux.shape} values for {shape[0]} temperatures and {shape[1]} "
                "velocities; specify one per pair"
            )
        for name, axis in (("temperature", self.temperature), ("velocity", self.velocity)):
            if not (np.isfinite(axis).all() and (np.diff(axis) > 0.0).all()):
                raise InputError(
                    f"flux table: each {name} must be finite and above the previous one"
                )
        FluxLimit(self.flux)

    def at(self, temperature: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return the allowable flux by bilinear interpolation, W/m², for arguments (...,).

        Raises
        ------
        InputError
            If a temperature or velocity is outside the table.
        """
        from scipy.interpolate import RegularGridInterpolator  # slow to import

        for axis, value, name, unit in (
            (self.temperature, temperature, "temperature", "°C"),
            (self.velocity, velocity, "velocity", "m/s"),
        ):
            outside = ~((value >= axis[0]) & (value <= axis[-1]))
            if outside.any():
                raise InputError(
                    f"flux table: a {name} of {np.asarray(value)[outside].flat[0]:g} {unit} is "
                    f"outside the table's {axis[0]:g} to {axis[-1]:g} {unit}; extend the table"
                )
        between = RegularGridInterpolator((self.temperature, self.velocity), self.flux)
        return as_float(between(np.stack([temperature, velocity], axis=-1)))


@dataclass(frozen=True)
class Panel:
    """A panel of a receiver, through which the fluid flows up or down.

    Attributes
    ----------
    path
        Name of the flow path.
    begin, end
        Edges of the panel as fractions of the receiver's width, 0 to 1, in the order of the
        columns.
    up
        Whether the fluid flows upwards.
    inlet, outlet
        Temperature of the fluid, °C; linear in between.
    velocity
        Velocity of the fluid, m/s.
    """

    path: str
    begin: float
    end: float
    up: bool
    inlet: float
    outlet: float
    velocity: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.begin < self.end <= 1.0:
            raise InputError(
                f"panel of path {self.path}: from {self.begin:g} to {self.end:g} of the width; "
                "the edges must increase and lie between 0 and 1"
            )


def limit_of(table: FluxTable, panels: tuple[Panel, ...], margin: float = 0.0) -> FluxLimit:
    """Return the limit that a table sets on a receiver with these panels, as a fine map.

    A cell of the map gets the smallest allowable flux found at its two ends along the flow, over
    all panels that it overlaps.

    Parameters
    ----------
    table, panels
        The allowable flux, and the state of the fluid.
    margin
        As for `FluxLimit`.

    Raises
    ------
    InputError
        If panels overlap or leave a part of the width without a limit, if two successive panels of
        a path do not match, or if a state of the fluid is outside the table.
    """
    _check(panels)
    flux = np.full((_ROWS, _COLUMNS), np.inf)
    height = np.linspace(0.0, 1.0, _ROWS + 1)
    for panel in panels:
        along = height if panel.up else 1.0 - height
        temperature = panel.inlet + (panel.outlet - panel.inlet) * along
        try:
            edges = table.at(as_float(temperature), np.full(_ROWS + 1, panel.velocity))
        except InputError as error:
            raise InputError(f"panel of path {panel.path}: {error}") from None
        least = np.minimum(edges[:-1], edges[1:])[:, None]
        first = int(np.floor(panel.begin * _COLUMNS + 1e-6))
        columns = slice(first, int(np.ceil(panel.end * _COLUMNS - 1e-6)))
        flux[:, columns] = np.minimum(flux[:, columns], least)
    return FluxLimit(flux, margin)


def _check(panels: tuple[Panel, ...]) -> None:
    """Refuse panels that do not cover the width exactly once, and paths with a temperature step."""
    at = 0.0
    for panel in sorted(panels, key=operator.attrgetter("begin")):
        if abs(panel.begin - at) > 1e-6:
            problem = "without a limit" if panel.begin > at else "on two panels"
            low, high = sorted((at, panel.begin))
            raise InputError(
                f"panels: the receiver's width from {low:g} to {high:g} is {problem}; let each "
                "panel begin where another ends"
            )
        at = panel.end
    if abs(at - 1.0) > 1e-6:
        raise InputError(
            f"panels: the receiver's width from {at:g} to 1 is without a limit; add a panel"
        )
    outlets: dict[str, float] = {}
    for panel in panels:
        before = outlets.get(panel.path, panel.inlet)
        if abs(panel.inlet - before) > 1.0:
            raise InputError(
                f"panels: path {panel.path} enters a panel at {panel.inlet:g} °C, but leaves the "
                f"previous one at {before:g} °C; list its panels in the order of the flow"
            )
        outlets[panel.path] = panel.outlet


def read_flux_table(path: str | Path) -> FluxTable:
    """Return the table in a CSV file with the columns `TABLE_COLUMNS`.

    Each line of the file belongs to one pair of temperature and velocity.

    Raises
    ------
    FormatError
        If a column or a pair is missing, or a value is impossible.
    """
    rows = _rows(path, "a table of allowable fluxes", TABLE_COLUMNS)
    temperature, velocity, flux = (
        rows.numbers(name, what)
        for name, what in zip(TABLE_COLUMNS, ("°C", "m/s", "W/m²"), strict=True)
    )
    rows.within(TABLE_COLUMNS[2], flux, 1.0, MOST, "W/m²")
    rows.refuse_bad()
    axes = [np.unique(temperature), np.unique(velocity)]
    table = np.full((len(axes[0]), len(axes[1])), np.nan)
    pairs = [
        np.searchsorted(axis, value)
        for axis, value in zip(axes, (temperature, velocity), strict=True)
    ]
    for i, pair in enumerate(zip(*pairs, strict=True)):
        if np.isfinite(table[pair]):
            rows.refuse(i, "", "this pair of temperature and velocity occurs twice; remove one")
        table[pair] = flux[i]
    rows.refuse_bad()
    if np.isnan(table).any():
        t, v = np.argwhere(np.isnan(table))[0]
        raise FormatError(
            rows.path,
            (f"no flux for {axes[0][t]:g} °C at {axes[1][v]:g} m/s; add a line for this pair"),
        )
    try:
        return FluxTable(as_float(axes[0]), as_float(axes[1]), table)
    except InputError as error:
        raise FormatError(rows.path, str(error)) from None


def read_panels(path: str | Path) -> tuple[Panel, ...]:
    """Return the panels in a CSV file with the columns `PANEL_COLUMNS`, one line per panel.

    The column ``flow`` contains "up" or "down"; the panels of a path are in flow order.

    Raises
    ------
    FormatError
        If a column is missing, or a value is impossible.
    """
    rows = _rows(path, "a table of panels", PANEL_COLUMNS)
    units = {"begin": "a share of the width", "end": "a share of the width", "inlet_c": "°C",
             "outlet_c": "°C", "velocity_m_s": "m/s"}  # fmt: skip
    values = [rows.numbers(name, what) for name, what in units.items()]
    flows = rows.texts("flow")
    for i, flow in enumerate(flows):
        if flow not in ("up", "down"):
            rows.refuse(i, "flow", f"flow must be up or down, not {flow!r}")
    rows.refuse_bad()
    panels = []
    for i, (name, flow) in enumerate(zip(rows.texts("path"), flows, strict=True)):
        begin, end, *state = (float(value[i]) for value in values)
        try:
            panels.append(Panel(name, begin, end, flow == "up", *state))
        except InputError as error:
            raise FormatError(rows.path, str(error), rows.places[i]) from None
    return tuple(panels)


def read_table_limit(table: str | Path, panels: str | Path, margin: float = 0.0) -> FluxLimit:
    """Return the limit that a flux table and a panel file set; see the functions that read them.

    Raises
    ------
    FormatError, InputError
        See `read_flux_table`, `read_panels` and `limit_of`.
    """
    return limit_of(read_flux_table(table), read_panels(panels), margin)


def _rows(path: str | Path, what: str, columns: tuple[str, ...]) -> Rows:
    rows = read_rows(Path(path), what, columns)
    rows.need(columns)
    if not len(rows):
        raise FormatError(rows.path, f"the table has no rows; expected {what}")
    return rows
