"""Aim points for heliostats, and the check that a beam may go to its point."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.field.volumes import Volume, around, around_target
from heliotrope.geometry import FloatArray, as_float, as_vectors
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.drives import SLOTS, Drive
from heliotrope.mechanism.machine import Machine
from heliotrope.mechanism.tracking import Tracking, TrackingStatus, track
from heliotrope.optics import MirrorOptics, beams, crossing, find_entries, sweep
from heliotrope.optics.beam import Beams
from heliotrope.optics.standing import entered_over_the_year, standing_beams

#: Length over which an unobstructed beam is followed, m.
FAR = 3000.0
#: Maximum light of all resting beams together at an eye, in suns. Looking there is then no worse
#: than looking at the sun, whatever the limits of the eye are, so no glare formula is needed.
MOST_SUNS = 1.0
_ON_ITS_WAY = "on its way there"
#: Clearance between the central ray of a beam and a receiver during an approach, m.
ROOM = 0.5
#: A mirror whose beam is only the image of the sun, that is, the core of every beam. A whole beam
#: may graze a receiver's edge. With the full width and errors of the beams, one heliostat in ten of
#: a small field, whose beams rest close beside the receiver, would never find a path to standby.
_MIDDLE = MirrorOptics.of(1e-3, 1e-3, error=0.0)


def spread(vertices: npt.ArrayLike, points: npt.ArrayLike) -> FloatArray:
    """Assign an aim point to each heliostat, (N, 3), with each point used equally often.

    Heliostats that are adjacent in azimuth about the points are assigned different points, so that
    a cloud or the loss of a cluster affects all points equally.

    Parameters
    ----------
    vertices
        Vertices of the mirrors, ENU, m, (N, 3).
    points
        Aim points, ENU, m, (P, 3) or (3,).

    Raises
    ------
    InputError
        If there are no points, or coordinates are not finite.
    """
    places = np.atleast_2d(as_vectors(vertices, "vertices"))
    targets = np.atleast_2d(as_vectors(points, "aim points"))
    if not len(targets) or not np.isfinite(targets).all():
        raise InputError(
            f"aim points: got {len(targets)}; specify at least one finite point in "
            f"ENU coordinates (m)"
        )
    away = places - targets.mean(axis=0)
    order = np.lexsort((np.linalg.norm(away, axis=-1), np.arctan2(away[:, 0], away[:, 1])))
    aims = np.empty((len(places), 3))
    aims[order] = targets[np.arange(len(places)) % len(targets)]
    return aims


def default_aims(
    design: Plant, names: Sequence[str], vertices: FloatArray, points: npt.ArrayLike | None
) -> dict[str, FloatArray]:
    """Return one aim per heliostat: the given points, spread over the field, or the design's aims.

    Parameters
    ----------
    design
        The plant; a heliostat without its own aim gets the centre of the first receiver.
    names, vertices
        Heliostats and their positions, ENU, m, (N, 3).
    points
        Aim points, (P, 3); None: the aims of the design.

    Raises
    ------
    InputError
        If there is nothing to aim at.
    """
    if points is not None:
        return dict(zip(names, spread(vertices, points), strict=True))
    centre = design.receivers[0].center if design.receivers else np.full(3, np.nan)
    aims = {}
    for name in names:
        group, row = design.find(name)
        own = centre if group.aim is None else group.aim[row]
        aims[name] = own = own if np.isfinite(own).all() else centre
        if not np.isfinite(own).all():
            raise InputError(
                f"heliostat {name}: no aim point is set and the plant has no "
                f"receiver; specify aim points"
            )
    return aims


class BeamCheck:
    """Checks beams, computed from the heliostats' mechanisms, against keep-out volumes and eyes.

    Parameters
    ----------
    design
        The plant, with calibrated mechanisms.
    names
        The N heliostats, in the order of all arrays here.
    volumes
        Keep-out volumes; None: the volumes in the design.
    eyes
        Points from which people may see resting beams, ENU, m, (P, 3); None: the points in the
        design.

    Attributes
    ----------
    position
        Positions of the heliostats, ENU, m, (N, 3).
    solids
        The receivers with a margin, which the beam must not cross on an approach.
    machines
        Drive limits and rest positions of heliostats, by name, as far as the design specifies them.

    Raises
    ------
    InputError
        If eye positions are not finite points.
    """

    def __init__(
        self,
        design: Plant,
        names: Sequence[str],
        volumes: Sequence[Volume] | None = None,
        eyes: npt.ArrayLike | None = None,
    ) -> None:
        place = {name: i for i, name in enumerate(design.names)}
        rows = np.array([place[name] for name in names], dtype=np.intp)
        self.names = tuple(names)
        self.volumes = tuple(design.keep_outs if volumes is None else volumes)
        self.solids = tuple(around(receiver, ROOM) for receiver in design.receivers)
        self._targets = tuple(around_target(target, ROOM) for target in design.targets)
        self._centers = [receiver.center for receiver in design.receivers]
        self._latitude = float(np.radians(design.site.latitude_deg))
        places = [*design.eyes.values()] if eyes is None else eyes
        self.eyes = as_vectors(np.reshape(as_float(places), (-1, 3)), "eyes")
        self.position = design.position[rows]
        self.armature = Armature(design.armature.table[rows])
        self.drives = Drive(design.drives.table[rows])
        self.machines: dict[str, Machine] = {
            name: machine
            for group in design.groups.values()
            if group.machines
            for name, machine in zip(group.names, group.machines, strict=True)
        }
        for row in range(len(rows)):
            self._stop(row)
        groups = design.groups.values()
        sizes = [
            np.concatenate([getattr(g, what) for g in groups])[rows] for what in ("width", "height")
        ]
        self.mirrors = MirrorOptics.of(*sizes)

    def replace(self, row: int, armature: FloatArray, drives: FloatArray) -> None:
        """Use a heliostat's new calibration: its armature, (18,), and its drives, (2, 19)."""
        self.armature.table[row] = armature
        self.drives.table[row] = drives
        self._stop(row)

    def _stop(self, row: int) -> None:
        """Use the drive limits as stops, as the local controller does for its pose.

        Without stops, the computed pose may differ from the pose that the heliostat takes.
        """
        machine, table = self.machines.get(self.names[row]), self.drives.table[row]
        for i, axis in enumerate(() if machine is None else machine.axes):
            table[i, SLOTS["min_count"]] = max(table[i, SLOTS["min_count"]], axis.low)
            table[i, SLOTS["max_count"]] = min(table[i, SLOTS["max_count"]], axis.high)

    def poses(
        self,
        rows: npt.NDArray[np.intp],
        aims: FloatArray,
        sun: FloatArray,
        counts: FloatArray | None = None,
    ) -> Tracking:
        """Return the poses that direct heliostats (K,) at aims (K, 3).

        Of the possible poses, the one nearest to the step counts (K, 2) is returned.

        The sun vector is (3,) or (K, 3).
        """
        # At night nothing moves; the pose for an overhead sun shows the beam's path just as well.
        source = np.where(sun[..., 2:] > 0.0, sun, np.array([0.0, 0.0, 1.0]))
        return track(
            Armature(self.armature.table[rows]),
            source,
            aims,
            drives=Drive(self.drives.table[rows]),
            current=counts,
        )

    def stop(self, row: int, aim: FloatArray, sun: FloatArray, counts: FloatArray) -> str:
        """Return in words which stop keeps a heliostat from aiming at a point (3,), and the remedy.

        The sun vector is (3,). Of the poses for the point, the one nearest to the counts (2,) is
        examined.
        """
        table = self.drives.table[row]
        free = table.copy()
        free[:, [SLOTS["min_count"], SLOTS["min_angle"]]] = -np.inf
        free[:, [SLOTS["max_count"], SLOTS["max_angle"]]] = np.inf
        armature = Armature(self.armature.table[row])
        wanted = track(armature, sun, aim, drives=Drive(free), current=counts).best_angles
        ends = table[:, [SLOTS["min_count"], SLOTS["max_count"]]].T
        turned = Drive(free).angles(np.where(np.isfinite(ends), ends, 0.0))
        stops = np.sort(np.where(np.isfinite(ends), turned, ends), axis=0)
        low = np.maximum(stops[0], table[:, SLOTS["min_angle"]])
        high = np.minimum(stops[1], table[:, SLOTS["max_angle"]])
        axis = int(np.maximum(wanted - high, low - wanted).argmax())
        stop = high[axis] if wanted[axis] > high[axis] else low[axis]
        return (
            f"axis {axis + 1} would have to turn to {np.degrees(wanted[axis]):.1f}°, beyond its "
            f"stop at {np.degrees(stop):.1f}°; move the stop in the plant file, or set other "
            f"points in way_m"
        )

    def problems(
        self,
        rows: npt.NDArray[np.intp],
        aims: FloatArray,
        sun: FloatArray,
        *,
        start: FloatArray,
        stopped: bool,
    ) -> dict[str, str]:
        """Return the heliostats that may not aim at given points, and the reasons.

        Parameters
        ----------
        rows
            Indices of the heliostats, (K,).
        aims
            ENU, m, (K, 3).
        sun
            Sun vector, (3,).
        start
            Points at which their beams are now, ENU, m, (K, 3); NaN if there is none. The sweep
            from there is checked as well.
        stopped
            Whether a surface at the aim (receiver, target) stops the beam. A beam at a standby
            point continues beyond it.
        """
        reasons: dict[str, str] = {}
        solved = self.poses(rows, aims, sun)
        status = solved.chosen(solved.status)
        for i in np.flatnonzero(status != TrackingStatus.OK):
            reasons[self.names[rows[i]]] = (
                f"the aim {point_text(aims[i])} m: {TrackingStatus(int(status[i])).text}"
            )
        if not self.volumes:
            return reasons
        vertex = solved.chosen(solved.vertex)
        part = _rows_of(self.mirrors, rows)
        reach = np.linalg.norm(aims - vertex, axis=-1) if stopped else np.full(len(rows), FAR)
        rest = find_entries(beams(vertex, aims, part, reach=reach), self.volumes)
        self._tell(reasons, rows, rest.entered, rest.first, "at the aim")
        swept = np.flatnonzero(np.isfinite(start).all(axis=-1) & (status == TrackingStatus.OK))
        if swept.size and sun[2] > 0.0:
            self._sweep(reasons, rows[swept], start[swept], aims[swept], sun)
        return reasons

    def glare(
        self,
        rows: npt.NDArray[np.intp],
        points: FloatArray,
        possible: Sequence[tuple[npt.NDArray[np.intp], FloatArray]],
        sun: FloatArray,
    ) -> dict[str, str]:
        """Return the heliostats whose beams at standby would dazzle anyone, and the reasons.

        At each eye all beams at standby together must stay below `MOST_SUNS`; otherwise every
        heliostat whose light reaches that eye is named.

        Parameters
        ----------
        rows, points
            Heliostats (K,) and their new standby points, ENU, m, (K, 3).
        possible
            Standby points that local controllers may have now, and the heliostats concerned; see
            `Points.possible`. For each heliostat, the standby point that sends the most light to an
            eye counts.
        sun
            Sun vector, (3,).
        """
        if not len(self.eyes) or not len(rows):
            return {}
        some = [(rows, points), *possible]
        known, places = (np.concatenate([standbys[i] for standbys in some]) for i in (0, 1))
        solved = self.poses(known, places, sun)
        part = _rows_of(self.mirrors, known)
        rest = beams(solved.chosen(solved.vertex), places, part, reach=np.full(len(known), FAR))
        concentration = crossing(rest, self.eyes, dni=1.0).concentration * part.reflectivity
        most = np.zeros((len(self.names), len(self.eyes)))
        np.maximum.at(most, known, np.nan_to_num(concentration).T)
        total = most.sum(axis=0)
        reasons: dict[str, str] = {}
        for eye in np.flatnonzero(~(total <= MOST_SUNS)):
            shining = concentration[eye, : len(rows)] > 0.0
            for row in np.unique(rows[shining]):
                reasons.setdefault(
                    self.names[row],
                    f"at rest its beam shines on the point {point_text(self.eyes[eye])} m, where "
                    f"the sum of all beams is {total[eye]:.2f} suns (limit {MOST_SUNS:g}); choose "
                    f"another standby point",
                )
        return reasons

    def on_the_way(
        self,
        rows: npt.NDArray[np.intp],
        counts: FloatArray,
        aims: FloatArray,
        sun: FloatArray,
        motion: Callable[[npt.NDArray[np.intp], FloatArray, FloatArray], FloatArray],
    ) -> dict[str, str]:
        """Return the heliostats whose beams would enter a volume on their paths, and the reasons.

        Parameters
        ----------
        rows
            Indices of the heliostats, (K,).
        counts
            Step counts of their axes, (K, 2).
        aims, sun
            As in `problems`.
        motion
            Function that returns the angles that the axes pass through between counts; see
            `Paths.motion`.
        """
        reasons: dict[str, str] = {}
        solved = self.poses(rows, aims, sun, counts)
        status = solved.chosen(solved.status)
        for i in np.flatnonzero(status != TrackingStatus.OK):
            reasons[self.names[rows[i]]] = (
                f"the aim {point_text(aims[i])} m: {TrackingStatus(int(status[i])).text}"
            )
        good = status == TrackingStatus.OK
        if good.any():
            path = motion(rows[good], counts[good], solved.best_counts[good])
            reasons |= self.moving(rows[good], path, sun)
        return reasons

    def around(
        self, rows: npt.NDArray[np.intp], aims: FloatArray, radius: float, sun: FloatArray
    ) -> dict[str, str]:
        """Return the heliostats whose beams would enter a volume near their aims (K, 3), and where.

        Parameters
        ----------
        rows, aims, sun
            As in `problems`.
        radius
            Largest angle between beams and their aims, rad. The beams are not stopped there.
        """
        reasons: dict[str, str] = {}
        if not (self.volumes and sun[2] > 0.0):
            return reasons
        solved = self.poses(rows, aims, sun)
        vertices = solved.chosen(solved.vertex)
        for k in np.flatnonzero(solved.chosen(solved.status) == TrackingStatus.OK):
            part = _rows_of(self.mirrors, rows[k : k + 1])
            # Neighbouring beams overlap, because no beam is narrower than the mirror.
            apart = 0.5 * float(np.hypot(part.width[0], part.height[0]))
            points = _disc(vertices[k], aims[k], radius, apart)
            many = MirrorOptics(
                **{name: np.repeat(v, len(points), 0) for name, v in vars(part).items()}
            )
            vertex = np.broadcast_to(vertices[k], points.shape)
            rest = find_entries(
                beams(vertex, points, many, reach=np.full(len(points), FAR)), self.volumes
            )
            hit = np.flatnonzero(rest.entered.any(axis=-1))[:1]
            same = np.repeat(rows[k : k + 1], len(hit))
            self._tell(reasons, same, rest.entered[hit], rest.first[hit], "during the beam search")
        return reasons

    def moving(
        self,
        rows: npt.NDArray[np.intp],
        path: FloatArray,
        sun: FloatArray,
        when: str = _ON_ITS_WAY,
    ) -> dict[str, str]:
        """Return the heliostats whose beams would enter a volume on a path, and the reasons.

        Parameters
        ----------
        rows
            Indices of the heliostats, (K,).
        path
            Angles that the axes pass through, rad, (K, W, 2).
        sun
            Sun vectors, (3,) or (K, 3).
        when
            Description of the motion, in words.
        """
        reasons: dict[str, str] = {}
        if len(rows) and self.volumes and sun[..., 2].max() > 0.0:
            self._check_motion(reasons, rows, path, sun, when)
        return reasons

    def crossing(
        self, rows: npt.NDArray[np.intp], path: FloatArray, sun: FloatArray, when: str
    ) -> dict[str, str]:
        """Return the heliostats whose beams would cross a receiver on a path, and the reasons.

        For the arguments see `moving`. The check uses the core of a beam; see `_MIDDLE`.
        """
        entered = self._on_receivers(rows, path, sun)
        return {
            self.names[rows[i]]: f"the beam crosses {self.solids[int(entered[i].argmax())].name} "
            f"{when}; try again when the sun has moved on"
            for i in np.flatnonzero(entered.any(axis=-1))
        }

    def lights(
        self, rows: npt.NDArray[np.intp], angles: FloatArray, sun: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """Return a mask of the beams that hit a receiver with the axes at angles (K, 2), (K,).

        For ``sun`` see `problems`; the check uses the core of a beam.
        """
        still = np.repeat(angles[:, None], 2, axis=1)
        return np.asarray(self._on_receivers(rows, still, sun).any(axis=-1))

    def _on_receivers(
        self, rows: npt.NDArray[np.intp], path: FloatArray, sun: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """Return a mask of which beams cross which of the R receivers on a path, (K, R).

        The check uses the cores of the beams.
        """
        if not (len(rows) and self.solids and sun[..., 2].max() > 0.0):
            return np.zeros((len(rows), len(self.solids)), dtype=np.bool_)
        armature = Armature(self.armature.table[rows])
        return sweep(armature, path, sun, _MIDDLE, self.solids, reach=FAR).entered

    def standing(
        self,
        rows: npt.NDArray[np.intp],
        counts: FloatArray,
        tables: tuple[FloatArray, FloatArray] | None = None,
    ) -> dict[str, str]:
        """Return the heliostats whose resting beams come too close to an object in a year, and why.

        The check covers receivers, targets and keep-out volumes, with the heliostats at rest at
        counts (K, 2) and the sun at any position of the year. See also `Machine.stow_lights`.

        Parameters
        ----------
        rows, counts
            Indices of the heliostats, (K,), and steps, (K, 2).
        tables
            Armatures and drives, (K, 18) and (K, 2, 19); None: the armatures and drives of this
            check.
        """
        armature, drives = tables or (self.armature.table[rows], self.drives.table[rows])
        normal, vertex = Armature(armature).pose(Drive(drives).angles(counts))
        volumes = (*self.solids, *self._targets, *self.volumes)
        mirrors = _rows_of(self.mirrors, rows)
        entered = entered_over_the_year(vertex, normal, mirrors, volumes, self._latitude, FAR)
        machines = [self.machines.get(self.names[row]) for row in rows]
        allowed = np.array([m is not None and m.stow_lights for m in machines], dtype=np.bool_)
        entered[:, : len(volumes) - len(self.volumes)] &= ~allowed[:, None]
        return {
            self.names[rows[i]]: f"at stow its beam would reach "
            f"{volumes[int(entered[i].argmax())].name} at some time of the year; choose "
            f"another stow position"
            for i in np.flatnonzero(entered.any(axis=-1))
        }

    def at_stow(self) -> dict[str, str]:
        """Return the heliostats that may not rest at their stow positions, and why.

        Heliostats with an unknown mechanism are left out; see `standing`.
        """
        known = [row for row, name in enumerate(self.names) if name in self.machines]
        stow = [self.machines[self.names[row]].stow for row in known]
        return self.standing(np.array(known, np.intp), np.reshape(as_float(stow), (-1, 2)))

    def together(self, angles: FloatArray, sun: FloatArray) -> Beams:
        """Return the beams of the whole field with the axes at angles (N, 2).

        Each mirror is assumed to be focused on the first receiver, where its beam is strongest.
        """
        normal, vertex = self.armature.pose(angles)
        mirrors = self.mirrors
        if len(self._centers):
            focus = np.linalg.norm(self._centers[0] - vertex, axis=-1)
            mirrors = replace(mirrors, focus=focus)
        return standing_beams(vertex, normal, sun, mirrors, FAR)

    def at_rest(
        self, rows: npt.NDArray[np.intp], points: FloatArray, sun: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """Return a mask of the heliostats that may rest with their beams at points.

        The heliostats must reach the points, and the beams must not enter receivers, targets or
        keep-out volumes on their way to the points or beyond.

        Parameters
        ----------
        rows, points
            Indices of the heliostats, (K,), and points, ENU, m, (K, 3).
        sun
            Sun vector, (3,).
        """
        solved = self.poses(rows, points, sun)
        rest = beams(solved.chosen(solved.vertex), points, _rows_of(self.mirrors, rows), reach=FAR)
        volumes = (*self.solids, *self._targets, *self.volumes)
        entered = find_entries(rest, volumes).entered.any(axis=-1)
        return np.asarray((solved.chosen(solved.status) == TrackingStatus.OK) & ~entered)

    def inside(self, row: int, poses: FloatArray, sun: FloatArray) -> npt.NDArray[np.bool_]:
        """Return a mask of the poses in which the beam of a heliostat is in a volume.

        A pose is the angles of both axes; the poses are (K, 2).

        For ``sun`` see `problems`.
        """
        if not (self.volumes and sun[2] > 0.0):
            return np.zeros(len(poses), dtype=np.bool_)
        armature, mirrors = Armature(self.armature.table[row]), _rows_of(self.mirrors, [row])
        still = np.repeat(poses[:, None], 2, axis=1)
        motion = sweep(armature, still, sun, mirrors, self.volumes, reach=FAR)
        return np.asarray(motion.entered.any(axis=-1))

    def _sweep(
        self,
        reasons: dict[str, str],
        rows: npt.NDArray[np.intp],
        start: FloatArray,
        aims: FloatArray,
        sun: FloatArray,
    ) -> None:
        """Add the volumes that beams cross on the way from one point to another."""
        before = self.poses(rows, start, sun)
        counts = before.best_counts
        after = self.poses(rows, aims, sun, counts)
        good = before.chosen(before.status) == TrackingStatus.OK
        path = np.stack([before.best_angles, after.best_angles], axis=-2)
        if good.any():
            self._check_motion(reasons, rows[good], path[good], sun)

    def _check_motion(
        self,
        reasons: dict[str, str],
        rows: npt.NDArray[np.intp],
        path: FloatArray,
        sun: FloatArray,
        when: str = _ON_ITS_WAY,
    ) -> None:
        armature, mirrors = Armature(self.armature.table[rows]), _rows_of(self.mirrors, rows)
        motion = sweep(armature, path, sun, mirrors, self.volumes, reach=FAR)
        self._tell(reasons, rows, motion.entered, motion.distance, when)

    def _tell(
        self,
        reasons: dict[str, str],
        rows: npt.NDArray[np.intp],
        entered: npt.NDArray[np.bool_],
        distance: FloatArray,
        when: str,
    ) -> None:
        for i in np.flatnonzero(entered.any(axis=-1)):
            v = int(np.flatnonzero(entered[i])[0])
            reasons.setdefault(
                self.names[rows[i]],
                f"the beam enters {self.volumes[v].name} {distance[i, v]:.0f} m from the mirror "
                f"{when}; choose another point",
            )


def _rows_of(mirrors: MirrorOptics, rows: npt.NDArray[np.intp] | list[int]) -> MirrorOptics:
    return MirrorOptics(**{name: values[rows] for name, values in vars(mirrors).items()})


def _disc(eye: FloatArray, aim: FloatArray, radius: float, apart: float) -> FloatArray:
    """Return points (P, 3) on the disc at the aim that a cone of half angle ``radius`` covers."""
    ray = aim - eye
    distance = float(np.linalg.norm(ray))
    right = np.cross(ray, (0.0, 0.0, 1.0)) if ray[:2].any() else np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, ray) / distance
    wide = distance * float(np.tan(min(radius, 0.5)))
    points = [aim]
    for ring in np.linspace(0.0, wide, int(np.ceil(wide / apart)) + 1)[1:]:
        turn = np.linspace(0.0, 2.0 * np.pi, int(np.ceil(2.0 * np.pi * ring / apart)) + 3)[:-1]
        points += [aim + ring * (np.cos(t) * right + np.sin(t) * up) for t in turn]
    return np.stack(points)


def point_text(point: FloatArray) -> str:
    """Return a point (3,), m, in the form used in error messages."""
    return "(" + ", ".join(f"{x:.1f}" for x in point) + ")"
