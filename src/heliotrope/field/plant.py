"""A plant: site, tower, targets, receivers and the heliostats, group by group."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.aim_settings import AimSettings
from heliotrope.field.approval import ApprovalSettings
from heliotrope.field.camera import Camera, check_unfolded
from heliotrope.field.coded_visits import JointSettings, ReceiverSettings
from heliotrope.field.heliostat import Heliostat
from heliotrope.field.heliostats import Heliostats, rows_in
from heliotrope.field.target import Receiver, Target
from heliotrope.field.timetable import TimetableEntry, check_timetable
from heliotrope.field.tower import Tower
from heliotrope.field.volumes import Volume
from heliotrope.files.cells import check_names
from heliotrope.frames import ENU, Framed, Labelled, Variable
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.chain import Calibrated, Mechanism, join_mechanisms
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.machine import Machine
from heliotrope.safety import CONDITIONS, Limits, limited
from heliotrope.sun import Site, check_site
from heliotrope.values import Card, Value, amount, dots

Surface = TypeVar("Surface", Target, Receiver, Camera)
#: Positions count as the same place if they are equal when rounded to this, m.
_ONE_PLACE = 0.01


@dataclass(frozen=True, eq=False, repr=False)
class Plant(Value, Framed):
    """A solar tower plant.

    Attributes
    ----------
    name
        Name of the plant.
    site
        Reference point: the origin of ENU.
    groups
        Heliostats by group name, with one kind of mechanism per group; heliostat names are unique
        over all groups.
    targets, receivers
        Surfaces that beams are sent to.
    notes
        Notes of the reader, by subject.
    cameras
        Cameras that look at the targets.
    keep_outs
        Volumes that no beam may enter.
    eyes
        Points from which people may see standby beams, ENU, m, (3,), by name.
    joint_visits
        Settings of joint visits, in which several heliostats are measured on one target at once;
        None: each heliostat is calibrated alone.
    receiver_visits
        Settings of receiver visits; None: heliostats are not measured on the receiver.
    timetable
        Calibrations that operators have scheduled, at times of day and at intervals.
    safety
        Entries of the safety table that this plant overrides; see `safety.limits`.
    approval
        Changes by an operator or engineer that need a second approval.
    aims
        How the heliostats' aims on the receiver are chosen.
    towers
        Towers and masts that shade and block heliostats.
    """

    name: str
    site: Site
    groups: Mapping[str, Heliostats]
    targets: tuple[Target, ...] = ()
    receivers: tuple[Receiver, ...] = ()
    notes: Mapping[str, str] = field(default_factory=dict)
    cameras: tuple[Camera, ...] = ()
    keep_outs: tuple[Volume, ...] = ()
    eyes: Mapping[str, FloatArray] = field(default_factory=dict)
    joint_visits: JointSettings | None = field(default_factory=JointSettings)
    receiver_visits: ReceiverSettings | None = None
    timetable: tuple[TimetableEntry, ...] = ()
    safety: Limits = field(default_factory=dict)
    approval: ApprovalSettings = field(default_factory=ApprovalSettings)
    aims: AimSettings = field(default_factory=AimSettings)
    towers: tuple[Tower, ...] = ()

    def __post_init__(self) -> None:
        check_site(self.site)
        limited(CONDITIONS, self.safety)
        groups = self.groups.values()
        check_names("heliostat", (name for group in groups for name in group.names))
        self._check_places()
        surfaces = [*(t.name for t in self.targets), *(r.name for r in self.receivers)]
        check_names("target or receiver", surfaces)
        check_names("camera", (camera.name for camera in self.cameras))
        check_names("keep-out volume", (volume.name for volume in self.keep_outs))
        for camera in self.cameras:
            check_unfolded(f"camera {camera.name}", camera)
            for target in camera.targets:
                self.target(target)
        if self.receiver_visits is not None:
            # Two things must be known: the camera's position, and a face that it can see.
            _ = self.receiver(self.receiver_visits.receiver).face
            _ = self.camera(self.receiver_visits.camera).pose
        if self.aims.limit is not None and len(self.receivers) != 1:
            raise InputError(
                'aims: strategy "limit" needs one receiver, and the plant has '
                f"{len(self.receivers)}; remove [aims], and choose aims for one receiver at a time "
                "with heliotrope aim"
            )
        if self.aims.limit is not None and self.receivers[0].mesh is not None:
            raise InputError(
                f'aims: strategy "limit" needs a planar or cylindrical receiver, and '
                f"{self.receivers[0].name} is a {self.receivers[0].kind}; remove [aims]"
            )
        self.check_towers(self.towers)
        if self.timetable:
            check_timetable(self.timetable, self.names, (t.name for t in self.targets))

    def check_towers(self, towers: Sequence[Tower]) -> None:
        """Raise InputError if a heliostat stands inside one of some towers."""
        for tower in towers:
            east, north, up = self.position.T
            away = np.hypot(east - tower.east, north - tower.north)
            inside = (away < tower.radius) & (up < tower.top)
            if inside.any():
                k = int(np.flatnonzero(inside)[0])
                raise InputError(
                    f"heliostat {self.names[k]} is {away[k]:.2f} m from the axis of a tower "
                    f"of radius {tower.radius:g} m, inside it; correct one of them"
                )

    def _check_places(self) -> None:
        """Refuse two heliostats at one place, because a row was copied or a position is wrong."""
        cells = np.round(self.position / _ONE_PLACE)
        order = np.lexsort(cells.T)
        same = (np.diff(cells[order], axis=0) == 0.0).all(axis=1)
        if same.any():
            k = int(np.flatnonzero(same)[0])
            first, other = (self.names[i] for i in sorted(order[k : k + 2].tolist()))
            east, north, up = self.position[order[k]]
            raise InputError(
                f"heliostats {first} and {other} have the same position: {east:.2f} m east, "
                f"{north:.2f} m north, {up:.2f} m up; correct one or remove it"
            )

    def _card(self) -> Card:
        s = self.site
        counts = ((self.targets, "target"), (self.receivers, "receiver"), (self.cameras, "camera"))
        parts = ", ".join(amount(len(surfaces), noun) for surfaces, noun in counts if surfaces)
        line = f"{self.name}, {amount(len(self), 'heliostat')}; {parts or 'no target'}; site "
        line += (
            f"{s.name} {s.latitude_deg:.4f}° north, {s.longitude_deg:.4f}° east, {s.height:.0f} m"
        )
        rows = [
            (
                name,
                str(len(group)),
                group.mechanism.kind,
                group.mirror,
                amount(len(group.parameters), "parameter") if group.parameters else "nominal",
            )
            for name, group in self.groups.items()
        ]
        header = ("group", "heliostats", "kind", "mirrors", "calibrated")
        places = self.position
        return Card(line, header, rows, dots(places[:, 0], places[:, 1], "map"))

    def _labelled(self) -> Labelled:
        row, groups = ("heliostat",), self.groups.items()

        def of_all(name: str) -> FloatArray:
            return np.concatenate([getattr(group, name) for _, group in groups])

        return Labelled(
            row,
            {"heliostat": self.names, "axis": ENU},
            {
                "position": Variable((*row, "axis"), self.position, "m"),
                "width": Variable(row, of_all("width"), "m"),
                "height": Variable(row, of_all("height"), "m"),
                "group": Variable(
                    row, np.repeat([n for n, _ in groups], [len(g) for _, g in groups])
                ),
            },
            notes={"name": self.name},
        )

    def __len__(self) -> int:
        return sum(len(group) for group in self.groups.values())

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all heliostats, group after group."""
        return tuple(name for group in self.groups.values() for name in group.names)

    @cached_property
    def cluster(self) -> tuple[str, ...]:
        """Cluster of each heliostat, group after group; "" without one."""
        return tuple(c for g in self.groups.values() for c in g.cluster or ("",) * len(g))

    @cached_property
    def _place(self) -> dict[str, tuple[str, int]]:
        return {
            name: (group, i)
            for group, heliostats in self.groups.items()
            for i, name in enumerate(heliostats.names)
        }

    def find(self, name: str) -> tuple[Heliostats, int]:
        """Return the group of heliostat ``name`` and its index in the group.

        Raises
        ------
        UnknownNameError
            If there is no heliostat of that name.
        """
        try:
            group, row = self._place[name]
        except KeyError:
            raise UnknownNameError("heliostat", name, self.names) from None
        return self.groups[group], row

    def __getitem__(self, name: str) -> Heliostat:
        """Return heliostat ``name``.

        Raises
        ------
        UnknownNameError
            If there is no heliostat of that name.
        """
        heliostats, row = self.find(name)
        group, _ = self._place[name]
        return Heliostat(heliostats.take([row]), group, self.site, self.targets)

    def __contains__(self, name: object) -> bool:
        return name in self._place

    def __iter__(self) -> Iterator[Heliostat]:
        return (self[name] for name in self.names)

    @cached_property
    def nominal(self) -> Mechanism:
        """The mechanisms of all heliostats as designed, (N,), in the order of ``names``.

        Raises
        ------
        InputError
            If the plant has heliostats of several kinds; use its groups one by one instead.
        """
        return join_mechanisms([g.mechanism for g in self.groups.values()])

    @cached_property
    def calibrated(self) -> Mechanism:
        """The mechanisms of all heliostats with their calibrated deviations; see `nominal`."""
        return join_mechanisms([g.calibrated for g in self.groups.values()])

    @property
    def deviations(self) -> Mapping[str, FloatArray]:
        """Deviations of the calibrated mechanisms, by name, each (N,); see `nominal`."""
        return self.calibrated.deviations

    def with_calibration(self, calibration: Calibrated) -> "Plant":
        """Return the plant with its heliostats' own deviations replaced by those of a calibration.

        Heliostats that the calibration does not include keep their deviations. A calibration
        without names must contain one entry per heliostat, in the order of ``names``.

        Raises
        ------
        InputError
            If the argument is not a calibration, or has neither names nor the right number of
            entries.
        UnknownNameError
            If the calibration includes none of the heliostats, or a kind of mechanism lacks one of
            its parameters.
        """
        rows, groups, start = rows_in(calibration, self.names), {}, 0
        for name, group in self.groups.items():
            mine = rows[start : start + len(group)]
            start += len(group)
            groups[name] = group.with_rows(calibration, mine) if (mine >= 0).any() else group
        return self.with_groups(groups)

    def machine(self, name: str) -> Machine:
        """Return the motor limits and rest positions of one heliostat.

        Raises
        ------
        InputError
            If the heliostat's group has no machine table.
        UnknownNameError
            If there is no heliostat of that name.
        """
        heliostats, row = self.find(name)
        if not heliostats.machines:
            group, _ = self._place[name]
            raise InputError(
                f"group {group}: the plant file has no table [groups.{group}.machine]; add it "
                "(rates, limits, backlash, defocus, stow); see docs/reference/plant-format.md"
            )
        return heliostats.machines[row]

    def target(self, name: str) -> Target:
        """Return a target by name."""
        return _named("target", name, self.targets)

    def receiver(self, name: str) -> Receiver:
        """Return a receiver by name."""
        return _named("receiver", name, self.receivers)

    def camera(self, name: str) -> Camera:
        """Return a camera by name."""
        return _named("camera", name, self.cameras)

    @cached_property
    def position(self) -> FloatArray:
        """Nominal positions of all heliostats, ENU metres, (N, 3)."""
        return np.concatenate([g.position for g in self.groups.values()] or [np.empty((0, 3))])

    @cached_property
    def armature(self) -> Armature:
        """Calibrated armatures of all heliostats, whatever their kind, (N,)."""
        tables = [g.calibrated.armature.table for g in self.groups.values()]
        return Armature(np.concatenate(tables or [np.empty((0, 18))]))

    @cached_property
    def drives(self) -> Drive:
        """Calibrated drives of all heliostats, batch shape (N, D).

        Raises
        ------
        InputError
            If some heliostats have one drive and some have two; use the groups one by one instead.
        """
        tables = [g.calibrated.drives.table for g in self.groups.values()]
        if len({table.shape[-2] for table in tables}) > 1:
            raise InputError(
                "the plant has heliostats with one drive and with two drives; use its groups one "
                "at a time (plant.groups)"
            )
        return Drive(np.concatenate(tables or [np.empty((0, 2, 19))]))

    @cached_property
    def attachment(self) -> FloatArray:
        """Attachments of all calibrated heliostats, (N, 4, 4); see `Mechanism.attachment`."""
        frames = [g.attachment for g in self.groups.values()]
        return np.concatenate(frames or [np.empty((0, 4, 4))])

    def with_notes(self, notes: Mapping[str, str]) -> "Plant":
        """Return the plant with additional notes."""
        return replace(self, notes={**self.notes, **notes})

    def with_groups(self, groups: Mapping[str, Heliostats]) -> "Plant":
        """Return the plant with its heliostats replaced."""
        return replace(self, groups=dict(groups))


def _named(what: str, name: str, surfaces: tuple[Surface, ...]) -> Surface:
    for surface in surfaces:
        if surface.name == name:
            return surface
    raise UnknownNameError(what, name, [s.name for s in surfaces])
