"""An emergency order to the whole field, and the proof that it was carried out.

A heliostat has acknowledged the order when its local controller says so, or when a state heard
after the order shows it. A heliostat is done by its state *and* by its axes: its beam is off the
receiver when the axes are within `NEAR` of the goals of the defocus, whatever the state is called,
and the beam, by step counts and believed mechanism, is on no receiver: a mirror at standby may turn
its beam onto one. A heliostat with unknown step counts is never done: the report says where its
beam was last.
"""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.messages import Stage
from heliotrope.mechanism.drives import Drive
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import Act, Proof, ProofReport

#: An axis this close to the goal of its defocus (rad) has taken the beam off the receiver.
NEAR = 5e-3
#: A heliostat on its way to stow has left the receiver this long (s) after the order.
LEAVING = 5.0

Mask = npt.NDArray[np.bool_]


class EmergencyOrder:
    """One DEFOCUS or STOW of the whole field.

    Attributes
    ----------
    act
        `Act.DEFOCUS` or `Act.STOW`.
    who, reason
        The person or part of the plant that gave it, and why.
    at
        Monotonic s.
    ticket
        Ticket with the stage of each heliostat.
    unknown
        Where each heliostat with unknown step counts was last, by name: none of them is done.
    """

    def __init__(
        self,
        act: Act,
        who: str,
        reason: str,
        at: float,
        ticket: Ticket,
        *,
        flux_measured: bool,
    ) -> None:
        self.act, self.who, self.reason, self.at, self.ticket = act, who, reason, at, ticket
        self._proof = Proof.of(act.name, ticket.heliostats, at, flux_measured=flux_measured)
        # A proof is a value, so reports of a whole field are added to it together.
        self.unknown: dict[str, str] = {}
        self._acknowledged: dict[str, float] = {}
        self._done: dict[str, float] = {}

    @property
    def proof(self) -> Proof:
        """The proof so far."""
        if self._acknowledged or self._done:
            self._proof = self._proof.with_news(acknowledged=self._acknowledged, done=self._done)
            self._acknowledged, self._done = {}, {}
        return self._proof

    def take_flux(self, share: float, at: float) -> None:
        """Take a flux reading, as a share of the nominal."""
        self._proof = self.proof.with_flux(share, at)

    def is_acknowledged(self, heliostat: str) -> bool:
        """Whether a heliostat has acknowledged the order."""
        return (
            heliostat in self._acknowledged
            or heliostat in self._done
            or (heliostat in self._proof.acknowledged)
        )

    def is_done(self, heliostat: str) -> bool:
        """Whether a heliostat has carried out the order."""
        return heliostat in self._done or heliostat in self._proof.done

    def take_back(
        self, names: tuple[str, ...], rows: npt.NDArray[Any], heard: npt.NDArray[np.float64]
    ) -> tuple[str, ...]:
        """Return those of K heliostats that carried out the order and have come back since.

        They are no longer done. A row (`NODE`) from before that says nothing.
        """
        done = self.proof.done
        out = np.isin(rows["state"], states.BEAM_OUT)
        later = heard > np.array([done.get(name, np.inf) for name in names])
        back = tuple(names[i] for i in np.flatnonzero(out & later))
        if back:
            self._proof = self._proof.without(back)
        return back

    def report(self, now: float, shown: Mapping[str, str] = MappingProxyType({})) -> ProofReport:
        """Return how far the order has been carried out.

        ``shown`` is today's evidence that mirrors follow their drives, by heliostat.
        """
        report = replace(self.proof.report(now), unknown=tuple(self.unknown.values()))
        return report.with_evidence(self.proof.done, shown)

    def unacknowledged(self, heliostats: tuple[str, ...]) -> tuple[str, ...]:
        """Return those of some heliostats that have not acknowledged the order."""
        return tuple(name for name in heliostats if not self.is_acknowledged(name))

    def take_stage(self, heliostats: tuple[str, ...], stage: Stage, now: float) -> None:
        """Take a cluster's report on the order."""
        if stage is Stage.ACKNOWLEDGED:
            for name in heliostats:
                self._acknowledged.setdefault(name, now)
        elif stage is Stage.DONE:
            for name in heliostats:
                self._done.setdefault(name, now)

    def take_rows(
        self,
        names: tuple[str, ...],
        rows: npt.NDArray[Any],
        heard: npt.NDArray[np.float64],
        counted: npt.NDArray[np.float64],
        drives: Drive,
        now: float,
        mismatched: Mask,
        shining: Mask,
    ) -> None:
        """Take the state of heliostats (K,): rows of `NODE`, when they were true, and drives.

        Step counts (``counted``) from before the order prove nothing: they do not show the beam.

        ``mismatched`` ones are not what their address says: their counts may be another mirror's,
        so nothing that they report proves anything. Where a beam is still on a receiver
        (``shining``), nothing is done.
        """
        settled = heard >= self.at + LEAVING
        stowed = carried_out(Act.STOW, rows, drives, settled)
        off = carried_out(self.act, rows, drives, settled)
        fulfilled = (stowed | off) & ~mismatched & ~shining
        fulfilled &= (heard >= self.at) & (counted >= self.at)
        ready = tuple(names[i] for i in np.flatnonzero(fulfilled))
        if ready:
            self.take_stage(ready, Stage.DONE, now)
            self.ticket.advance(ready, Stage.DONE)


def switched_off(flags: npt.NDArray[Any]) -> Mask:
    """Return whether drives are switched off at the mirror, away from stow: it cannot obey."""
    return np.asarray((flags & meanings.LOCAL_SWITCH != 0) & (flags & meanings.AT_STOW == 0))


def at_stow(rows: npt.NDArray[Any]) -> Mask:
    """Return a mask of the rows (K,) of `NODE` whose heliostat rests at stow.

    One that is locked there, or has a fault, does; one that is IDLE there may go on to track.
    """
    resting = (rows["state"] == states.STOWED) | (rows["flags"] & meanings.AT_STOW != 0)
    return np.asarray(resting & ~np.isin(rows["state"], states.BEAM_OUT))


def carried_out(act: Act, rows: npt.NDArray[Any], drives: Drive, settled: Mask) -> Mask:
    """Return a mask of the rows (K,) of `NODE` that show DEFOCUS or STOW carried out.

    Parameters
    ----------
    act
        DEFOCUS or STOW.
    rows
        As the clusters report them.
    drives
        Of these heliostats, (K, 2).
    settled
        Whether a heliostat on its way to stow has had the time to leave the receiver, (K,).
    """
    off = ~np.isin(rows["state"], states.BEAM_OUT)
    known = (rows["flags"] & meanings.COUNTS_UNKNOWN == 0) & ~switched_off(rows["flags"])
    stowed = known & at_stow(rows)
    if act is Act.STOW:
        return np.asarray(stowed)
    counts = np.stack([rows["primary"], rows["secondary"]], axis=-1).astype(np.float64)
    goals = np.stack([rows["primary_goal"], rows["secondary_goal"]], axis=-1).astype(np.float64)
    remaining = np.abs((goals - counts) * drives.radians_per_count(counts)).max(axis=-1)
    # On the way to stow the goal is far away, although the beam has left.
    leaving = rows["state"] == states.STOWING
    return np.asarray(stowed | (off & known & np.where(leaving, settled, remaining < NEAR)))
