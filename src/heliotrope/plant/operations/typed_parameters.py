"""Error parameters that an operator enters where calibration is impossible: show, set, restore.

They become a version of the heliostat's calibration without sightings. They are written in the same
way as calibrations: at rest, where the beam is clear under the old and the new parameters;
afterwards the stored parameters are compared. The next fit replaces them. Earlier versions come
from the store.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from heliotrope.calibration.record import HeliostatCalibration, Provenance
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.local import Buckets
from heliotrope.mechanism.board_items import differing, items_of
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.versions import (
    ComparedParameter,
    ParameterComparison,
    ParameterVersion,
    beam_change,
    suns_of_day,
)
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.visits.settings import CycleSettings
from heliotrope.store.records import Records

#: Longest wait for the reply of a local controller, s.
_PATIENCE = 5.0
#: Queries of one user to local controllers: rate, 1/s, and burst.
ASKED = (0.2, 5.0)


@dataclass(frozen=True)
class ParameterState:
    """A parameter: deviation from the nominal mechanism, in the plant file and in use; and σ."""

    name: str
    unit: str
    file: float
    value: float
    sigma: float
    prior: float


@dataclass(frozen=True)
class EarlierParameters:
    """A version of a heliostat's parameters: time (POSIX s), person, note, sightings, values."""

    version: int
    at: float
    person: str
    note: str
    sightings: int
    values: Mapping[str, float]


@dataclass(frozen=True)
class ParametersView:
    """The parameters of a heliostat.

    Attributes
    ----------
    heliostat, version
        Name, and the version in use; 0 before the first.
    stored
        Whether the local controller stores the parameters in use, in words.
    parameters
        Each parameter.
    earlier
        Versions before the one in use, newest first.
    approval
        Whether a change waits until another engineer approves it; see `approvals`.
    """

    heliostat: str
    version: int
    stored: str
    parameters: tuple[ParameterState, ...]
    earlier: tuple[EarlierParameters, ...]
    approval: bool = False


@dataclass(frozen=True)
class PreparedChange:
    """Checked new parameters of a heliostat, ready to be written.

    Attributes
    ----------
    record
        The calibration with the new parameters; time, person and version are set when it is
        written.
    items
        Items that the change writes to the board, with their bytes.
    shown, reason
        The change in words, and the author's reason.
    """

    record: HeliostatCalibration
    items: Mapping[str, bytes]
    shown: str
    reason: str


@dataclass(frozen=True)
class SecondPerson:
    """The author of a change, and who approved it."""

    author: str
    approver: str

    @property
    def text(self) -> str:
        """Both names, for the audit log and the event."""
        return f"requested by {self.author}, approved by {self.approver}"


class TypedParameters:
    """Parameters of heliostats, for operators.

    Parameters
    ----------
    plant, log
        The controller, and the logbook for events.
    records
        The store with the earlier versions; None: there is no store.
    most
        Largest deviation that may be set, in standard deviations of the prior.
    """

    def __init__(
        self,
        plant: PlantController,
        log: Logbook,
        records: Records | None,
        most: float = CycleSettings().most,
    ) -> None:
        self._plant, self._log, self._records, self._most = plant, log, records, most
        self._asked = Buckets(*ASKED, plant.clock.monotonic)

    # -- looking ---------------------------------------------------------------------------

    async def view(self, heliostat: str, who: Person) -> ParametersView:
        """Return the parameters of a heliostat, and what its local controller stores.

        For an operator the local controller is queried, at most as often as `ASKED` allows, since
        one query takes some twenty messages on the bus. Other users see the plant's last
        comparison.
        """
        record, group = self._plant.beliefs.record(heliostat), self._plant.design.find(heliostat)[0]
        stored = await self._stored(heliostat, who)
        now = self.in_use(heliostat)
        in_file = self._file(heliostat)
        states = []
        for name in group.mechanism.parameters:
            known, sigma = group.mechanism.parameter(name), float("nan")
            if record is not None and name in record.names:
                sigma = float(record.sigma_at(self._utc())[record.names.index(name)])
            value, file = now.get(name, 0.0), in_file.get(name, 0.0)
            states.append(ParameterState(name, known.unit, file, value, sigma, known.prior))
        version = 0 if record is None else record.version
        earlier = [
            EarlierParameters(
                one.version, one.at, one.person, one.note, len(one.sightings), one.parameters
            )
            for one in await self._history(heliostat)
            if one.version != version
        ]
        approval = self._plant.design.approval.parameters
        return ParametersView(
            heliostat, version, stored, tuple(states), tuple(earlier[::-1]), approval
        )

    async def compare(self, heliostat: str, first: int, second: int) -> ParameterComparison:
        """Compare two versions of a heliostat's parameters; version 0 is the plant file.

        Raises
        ------
        UnknownNameError
            If there is no such heliostat or version.
        """
        group = self._plant.design.find(heliostat)[0]
        kept = {one.version: one for one in await self._history(heliostat)}
        last = self._plant.beliefs.record(heliostat)
        if last is not None:
            kept[last.version] = last
        for version in (first, second):
            if version and version not in kept:
                raise UnknownNameError(f"version of {heliostat}", str(version), map(str, kept))
        file = self._file(heliostat)
        known = [kept.get(version) for version in (first, second)]
        values = [file if one is None else one.parameters for one in known]
        sigmas = [{} if one is None else _sigmas(one) for one in known]
        rows = [
            ComparedParameter(
                name,
                group.mechanism.parameter(name).unit,
                values[0].get(name, 0.0),
                sigmas[0].get(name, np.nan),
                values[1].get(name, 0.0),
                sigmas[1].get(name, np.nan),
            )
            for name in group.mechanism.parameters
        ]
        rms, most = self.beam_change(heliostat, *values)
        return ParameterComparison(
            heliostat,
            0 if last is None else last.version,
            _version(first, known[0]),
            _version(second, known[1]),
            tuple(rows),
            rms,
            most,
        )

    def beam_change(
        self, heliostat: str, first: Mapping[str, float], second: Mapping[str, float]
    ) -> tuple[float, float]:
        """Return how far a beam moves at its aim between two sets of parameters, m.

        Returns RMS and maximum over the sun positions of this day; NaN if the heliostat can track
        at none of them. See `beam_change`.
        """
        nominal = self._plant.beliefs.nominal(heliostat)
        machines = [nominal.with_parameters(each) for each in (first, second)]
        aim = self._plant.aims[self._plant.field.place(heliostat)]
        aim = aim if np.isfinite(aim).all() else self._plant.default_aims((heliostat,))[heliostat]
        suns = suns_of_day(self._utc(), self._plant.design.site)
        change = beam_change(machines[0], machines[1], suns, aim)
        change = change[np.isfinite(change)]
        if not len(change):
            return np.nan, np.nan
        return float(np.sqrt(np.mean(change**2))), float(change.max())

    async def _stored(self, heliostat: str, who: Person) -> str:
        if who.role < Role.OPERATOR:
            return self._plant.compared(heliostat)
        if wait := self._asked.take(who.name):
            known = self._plant.compared(heliostat)
            return f"{known} (at the last comparison; they can be queried again in {ceil(wait)} s)"
        try:
            sums = await self._plant.stored(heliostat, _PATIENCE)
        except RefusedError as error:
            return f"unknown: {error}"
        other = differing(items_of(self._plant.beliefs.present(heliostat)[0]), sums)
        return f"others: {', '.join(other)}" if other else "the same"

    async def _history(self, heliostat: str) -> list[HeliostatCalibration]:
        if self._records is None:
            return []
        return await self._records.read(lambda records: records.calibration_history(heliostat))

    def _file(self, heliostat: str) -> dict[str, float]:
        group, row = self._plant.design.find(heliostat)
        return {name: float(values[row]) for name, values in group.parameters.items()}

    def _utc(self) -> float:
        return self._plant.clock.utc().timestamp()

    def in_use(self, heliostat: str) -> dict[str, float]:
        """Return the parameters that a heliostat uses, by name."""
        record = self._plant.beliefs.record(heliostat)
        return self._file(heliostat) if record is None else record.parameters

    # -- setting ---------------------------------------------------------------------------

    def change(
        self,
        person: Person,
        token: int,
        heliostat: str,
        values: Mapping[str, float],
        reason: str,
    ) -> Ticket:
        """Set parameters of one heliostat that is in a pose in which they may be written.

        Parameters
        ----------
        person, token
            An engineer, with the token of the command authority.
        heliostat, values, reason
            See `prepare`.

        Raises
        ------
        RefusedError
            If the change is not accepted.
        InputError, UnknownNameError
            See `prepare`.
        """
        return self.write(person, token, self.prepare(heliostat, values, reason))

    async def restore(
        self, person: Person, token: int, heliostat: str, version: int, reason: str
    ) -> Ticket:
        """Restore an earlier version of a heliostat's parameters; see `change`."""
        return self.write(person, token, await self.prepare_version(heliostat, version, reason))

    def prepare(self, heliostat: str, values: Mapping[str, float], reason: str) -> PreparedChange:
        """Check new values of a heliostat's parameters; nothing is written.

        Parameters
        ----------
        heliostat, values
            Name, and the new values by parameter, rad, m or 1; other parameters stay the same.
        reason
            Stored with the version and in the audit log.

        Raises
        ------
        InputError
            If values are implausible, the reason is missing, or nothing changes.
        UnknownNameError
            If there is no such heliostat or parameter.
        """
        mechanism = self._plant.beliefs.nominal(heliostat)
        for name, value in values.items():
            if name not in mechanism.parameters:
                raise UnknownNameError(f"parameter of {heliostat}", name, mechanism.parameters)
            prior = mechanism.parameter(name).prior
            if not abs(value) <= self._most * prior:
                raise InputError(
                    f"{heliostat}: {name} {value:g} is more than {self._most:g} standard "
                    f"deviations of the installation tolerance ({prior:g} "
                    f"{mechanism.parameter(name).unit}) away; check the unit and the installation"
                )
        last = self._plant.beliefs.record(heliostat)
        record = self._typed(heliostat, mechanism, {**self.in_use(heliostat), **values}, values)
        shown = ", ".join(f"{name} {value:g}" for name, value in values.items())
        model = "" if last is None else last.model
        record = replace(record, model=model, note=reason.strip())
        return self._prepared(record, shown, reason)

    async def prepare_version(self, heliostat: str, version: int, reason: str) -> PreparedChange:
        """Check an earlier version of a heliostat's parameters; see `prepare`."""
        self._plant.field.place(heliostat)
        known = {one.version: one for one in await self._history(heliostat)}
        if version not in known:
            raise UnknownNameError(f"version of {heliostat}", str(version), map(str, known))
        note = f"back to version {version}: {reason.strip()}"
        old = replace(known[version], growth=self._plant.beliefs.growth(heliostat))
        record = replace(old, covariance=old.covariance_at(self._utc()), note=note, pushed=())
        return self._prepared(record, f"version {version} again", reason)

    def _typed(
        self,
        heliostat: str,
        mechanism: Mechanism,
        values: Mapping[str, float],
        typed: Collection[str],
    ) -> HeliostatCalibration:
        """Return a calibration record with the values.

        Typed values have the uncertainty of a new installation.
        """
        last, names = self._plant.beliefs.record(heliostat), tuple(values)
        prior = np.array([mechanism.parameter(name).prior for name in names])
        covariance = np.diag(prior**2)
        if last is not None:
            kept = [name for name in last.names if name not in typed]
            to = np.array([names.index(name) for name in kept], dtype=np.intp)
            at = np.array([last.names.index(name) for name in kept], dtype=np.intp)
            covariance[np.ix_(to, to)] = last.covariance_at(self._utc())[np.ix_(at, at)]
        numbers = np.array([values[name] for name in names])
        return HeliostatCalibration(
            heliostat, 0.0, names, numbers, covariance, prior, provenance=Provenance.PERSON
        )

    def _prepared(self, record: HeliostatCalibration, shown: str, reason: str) -> PreparedChange:
        name, beliefs = record.heliostat, self._plant.beliefs
        if not reason.strip():
            raise InputError(
                f"{name}: a reason is needed for changing parameters; enter one for the audit log"
            )
        before = items_of(beliefs.present(name)[0])
        after = items_of(record.mechanism(beliefs.nominal(name))[0])
        items = {item: data for item, data in after.items() if before[item] != data}
        if not items:
            raise InputError(f"{name}: it already has these parameters, so nothing was changed")
        return PreparedChange(record, items, shown, reason.strip())

    def write(
        self,
        person: Person,
        token: int,
        change: PreparedChange,
        second: SecondPerson | None = None,
    ) -> Ticket:
        """Write a change to the heliostat's board; see `change`.

        With ``second``, the version, the audit log and the event name the author and the approver.
        """
        name, approved = change.record.heliostat, "" if second is None else f"; {second.text}"
        last = self._plant.beliefs.record(name)
        record = replace(
            change.record,
            at=self._utc(),
            person=person.name if second is None else second.author,
            note=change.record.note + approved,
            pushed=tuple(change.items),
            version=1 if last is None else last.version + 1,
        )
        reason = change.reason + approved
        ticket = self._plant.parameters(
            person, token, name, change.items, confirmed=reason, record=record
        )
        self._log.event("command", person.name, f"PARAMETERS {name}: {change.shown} ({reason})")
        return ticket


def _sigmas(record: HeliostatCalibration) -> dict[str, float]:
    """Return the standard deviations of a version's parameters at the time of its fit."""
    return {name: float(v) for name, v in zip(record.names, record.sigma, strict=True)}


def _version(number: int, record: HeliostatCalibration | None) -> ParameterVersion:
    if record is None:
        return ParameterVersion(number, float("nan"), "", "plant file", 0)
    return ParameterVersion(number, record.at, record.person, record.note, len(record.sightings))
