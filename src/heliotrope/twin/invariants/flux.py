r"""The observer of a flux limit: the true flux on the receiver, and the origin of each aim.

It computes the flux from the true mirrors and the true sun, at the irradiance for which the limit
must hold. Where the limit has a ramp of rate r, with rounds every T, the beams on the receiver may
bring a cell, whenever the sky clears,

$$F_c(t) \le W_c(t - τ) + r (T + τ)$$

where W is the greatest flux that the cell had within a minute before, at the true irradiance, and
τ = `SUDDEN`. The observer reads the answers of the plant's optimiser where they leave the plant's
worker, and the aims of persons where they are given.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from math import inf
from typing import Protocol, TypeVar, TypeVarTuple

import numpy as np
import numpy.typing as npt

from heliotrope.aims.rounds import Answer, forget
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, as_float, normalize
from heliotrope.lcu import states
from heliotrope.optics import Mirrors, Scene, surface_of
from heliotrope.optics.plant_scene import shaped
from heliotrope.optics.receiver_flux import FieldFlux
from heliotrope.plant.controller import PlantController
from heliotrope.plant.workers import Worker, at_once
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import RECEIVER
from heliotrope.twin.invariants.invariants import FLUX, OFF, ORIGIN, Judge

T = TypeVar("T")
Given = TypeVarTuple("Given")
#: Aims closer together than this are the same, m.
SAME = 0.05
#: Time between two computations of the true flux, s.
EVERY = 2.0
#: Time for which the true flux may be above the limit, s: as long as the drives need for a move, or
#: some rounds if a person has aimed a beam, or a beam was astray, within that longer time.
AT_ONCE, BELOW_WITHIN = 5.0, 60.0
#: Distance from its aim, m, and time, s, from which a beam is astray: several times the play of the
#: gears, and longer than the way from standby.
ASTRAY, TOO_LONG = 0.3, 3.0
#: Time over which a rise of the flux is judged, s; time for which a cell stays warm, and for which
#: a heliostat may be under way to an aim that a flux of then allowed, s.
SUDDEN, WARM, UNDER_WAY = 6.0, 60.0, 30.0
#: Tolerance of the ramp for the model's own error, as a fraction of the limit.
RAMP_ERROR = 0.05
#: Commands by which a person brings light to the receiver.
LIGHTS = ("TRACK", "REFOCUS", "AIM")


class TrueSky(Protocol):
    """The true direct irradiance, W/m²: without clouds, and at present."""

    clear: float

    def dni(self) -> float:
        """Return the present irradiance, W/m²."""


class FluxObserver(Judge):
    """Checks that the true flux holds the limit (18), and that each aim has an origin (19).

    Parameters
    ----------
    start
        Origin of the times that it reports, s.
    boards
        All heliostats, in the order of the design.
    design
        The plant, with its flux limit and one receiver.
    sky
        The true irradiance.
    """

    def __init__(self, start: float, boards: Sequence[Board], design: Plant, sky: TrueSky) -> None:
        super().__init__(start)
        self._sky = sky
        #: Times, s, and the flux of the cells in the irradiance of these times, W/m².
        self._had: list[tuple[float, FloatArray]] = []
        self._heated_since = inf
        self._boards, self._design = tuple(boards), design
        (self._receiver,) = design.receivers
        self._surface = surface_of(self._receiver)
        self._sources: dict[str, list[FloatArray]] = defaultdict(list)
        self._due, self._above_since = start, inf
        self._lit_by_person, self._disturbed_at, self._astray_since = False, start, inf

    # -- where aims come from ------------------------------------------------------------------

    def worker(self, names: Sequence[str]) -> Worker:
        """Return a new worker for a plant program, which notes the aims in the answers.

        ``names``: the heliostats, in the order of the program's field.
        """
        forget()

        async def noting(work: Callable[[*Given], T], *arguments: *Given) -> T:
            answer = await at_once(work, *arguments)
            if isinstance(answer, Answer):
                for move in answer.moves:
                    self.aimed({names[k]: p for k, p in zip(move.rows, move.aims, strict=True)})
                self.aimed(dict(zip(names, answer.safe, strict=True)))
            return answer

        return noting

    def aimed(self, points: Mapping[str, npt.ArrayLike]) -> None:
        """Record aims that a person or the optimiser has given, ENU, m, (3,), by heliostat."""
        for name, place in points.items():
            point = as_float(place)
            if np.isfinite(point).all() and not self._known(name, point):
                self._sources[name].append(point)

    def _known(self, heliostat: str, point: FloatArray) -> bool:
        sources = self._sources[heliostat]
        return any(float(np.linalg.norm(point - other)) < SAME for other in sources)

    def commanded(self, what: str) -> None:
        """Record an operator command that the plant has accepted."""
        self._lit_by_person |= what in LIGHTS

    # -- judgement -----------------------------------------------------------------------------

    def look(
        self,
        plant: PlantController | None,
        sun: FloatArray,
        now: float,
        *,
        governs: bool,
    ) -> None:
        """Check the flux and the aims.

        Parameters
        ----------
        plant
            The plant; None if its program is not running, or is frozen.
        sun
            True direction to the sun, (3,).
        now
            s.
        governs
            Whether automatic control holds the command authority.
        """
        if plant is None or not governs or plant.sentinel.on:
            self._above_since, self._disturbed_at = inf, now
        if plant is None:
            return
        self._astray_since = min(self._astray_since, now) if self._strays(plant, sun) else inf
        if self._lit_by_person or now - self._astray_since > TOO_LONG:
            self._disturbed_at = now
        self._lit_by_person = False
        self._origins(plant, now)
        if now >= self._due:
            self._due = now + EVERY
            flux = self.flux(sun)
            self._hold(float((flux / self._allowed(flux) - 1.0).max()), now)
            self._heat(flux, now)

    def _strays(self, plant: PlantController, sun: FloatArray) -> bool:
        """Return whether a beam is on the receiver, and not at its aim."""
        for board in self._boards:
            x, y, z = plant.aims[plant.field.place(board.outfit.name)].tolist()
            if board.miss(sun, RECEIVER) <= OFF and not board.miss(sun, (x, y, z)) <= ASTRAY:
                return True
        return False

    def _origins(self, plant: PlantController, now: float) -> None:
        for board in self._boards:
            if board.state != states.TRACKING:
                continue
            name = board.outfit.name
            point = plant.aims[plant.field.place(name)]
            saw = f"it tracks a point at {point.round(2)} m that nobody has assigned"
            self.check(ORIGIN, self._known(name, point), now, name, saw)

    def _hold(self, excess: float, now: float) -> None:
        self._above_since = min(self._above_since, now) if excess > 0.0 else inf
        passed = now - self._above_since
        limit = AT_ONCE if now - self._disturbed_at > BELOW_WITHIN else BELOW_WITHIN
        saw = f"the true flux is {100.0 * excess:.1f} % above the limit, for {passed:.0f} s"
        self.check(FLUX, passed <= limit, now, self._receiver.name, saw)

    def _heat(self, flux: FloatArray, now: float) -> None:
        """Check that no cell would be heated faster than the ramp allows if the sky were clear."""
        aims, since = self._design.aims, now - WARM - UNDER_WAY
        self._had = [(at, had) for at, had in self._had if at >= since]
        before = [had for at, had in self._had if at <= now - SUDDEN]
        self._had.append((now, as_float(flux * self._sky.dni() / aims.dni)))
        if aims.ramp <= 0.0 or not before:
            return
        rise = as_float(flux * self._sky.clear / aims.dni - np.max(before, axis=0))
        more = rise - aims.ramp * (aims.every + SUDDEN) - RAMP_ERROR * self._allowed(flux)
        self._heated_since = min(self._heated_since, now) if more.max() > 0.0 else inf
        passed = now - self._heated_since
        calm = now - self._disturbed_at > BELOW_WITHIN + SUDDEN
        if not calm:
            return
        saw = (
            f"{1e-3 * rise.max():.3g} kW/m² more than {SUDDEN:g} s ago would heat a cell when the "
            f"sky clears, for {passed:.0f} s; the ramp is {0.06 * aims.ramp:.3g} kW/m² per minute"
        )
        self.check(FLUX, passed <= AT_ONCE, now, self._receiver.name, saw)

    def _allowed(self, flux: FloatArray) -> FloatArray:
        """Return the limit without its margin, W/m², (rows, columns)."""
        limit = self._design.aims.limit
        assert limit is not None
        return as_float(limit.on(*flux.shape) / (1.0 - limit.margin))

    def flux(self, sun: FloatArray) -> FloatArray:
        """Return the true flux at the irradiance of the limit, W/m², (rows, columns)."""
        aims = self._design.aims
        vertex, normal = (np.stack(vectors) for vectors in zip(*self._poses(), strict=True))
        mirrors = Mirrors.of(vertex, normalize(normal), self._sizes(), np.array(RECEIVER))
        mirrors = shaped(mirrors, self._design)
        dark = np.array([board.miss(sun, RECEIVER) > OFF for board in self._boards])
        return FieldFlux(Scene(sun, aims.dni, mirrors, (self._surface,), dark=dark)).maps[0]

    def _poses(self) -> Sequence[tuple[FloatArray, FloatArray]]:
        return [board.mirror() for board in self._boards]

    def _sizes(self) -> tuple[FloatArray, FloatArray]:
        groups = self._design.groups.values()
        width, height = ([getattr(g, side) for g in groups] for side in ("width", "height"))
        return np.concatenate(width), np.concatenate(height)
