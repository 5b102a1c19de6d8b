"""A field-wide emergency order, and the proof that it was carried out.

A heliostat has acknowledged the order when its local controller says so, or when a state reported
after the order implies it. Whether a heliostat counts as done depends on its state *and* on its
axes. Its beam is off the receiver when the axes are within `NEAR` of the defocus goals, whatever
the state is called, and when the beam, computed from step counts and the believed mechanism, is on
no receiver, because a heliostat at standby may turn its beam onto a receiver. A heliostat with
unknown step counts is never done; the report says where its beam was last.
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

#: An axis this close to its defocus goal (rad) has taken the beam off the receiver.
NEAR = 5e-3
#: A heliostat on its way to stow has left the receiver by this time (s) after the order.
LEAVING = 5.0

Mask = npt.NDArray[np.bool_]


class EmergencyOrder:
    """One field-wide DEFOCUS or STOW.

    Attributes
    ----------
    act
        `Act.DEFOCUS` or `Act.STOW`.
    who, reason
        The person or part of the plant that gave the order, and why.
    at
        Monotonic s.
    ticket
        Ticket with the stage of each heliostat.
    unknown
        Last known beam position of each heliostat with unknown step counts, by name; none of these
        heliostats counts as done.
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
        # A proof is an immutable value, so the reports of a whole field are added to it together.
        self.unknown: dict[str, str] = {}
        self._acknowledged: dict[str, float] = {}
        self._done: dict[str, float] = {}

    @property
    def proof(self) -> Proof:
        """How far the order has been proven to be carried out."""
        if self._acknowledged or self._done:
            self._proof = self._proof.with_news(acknowledged=self._acknowledged, done=self._done)
            self._acknowledged, self._done = {}, {}
        return self._proof

    def take_flux(self, share: float, at: float) -> None:
        """Accept a flux reading, which is a fraction of the nominal flux."""
        self._proof = self.proof.with_flux(share, at)

    def is_acknowledged(self, heliostat: str) -> bool:
        """Whether a heliostat has acknowledged the order."""
        return (
            heliostat in self._acknowledged
            or heliostat in self._done
            or (heliostat in self._proof.acknowledged)
        )

    def is_done(self, heliostat: str) -> bool:
        """Whether a heliostat has carried out the order, as far as is known."""
        return heliostat in self._done or heliostat in self._proof.done

    def take_back(
        self, names: tuple[str, ...], rows: npt.NDArray[Any], heard: npt.NDArray[np.float64]
    ) -> tuple[str, ...]:
        """Return which of K heliostats carried out the order but have since moved back.

        These heliostats no longer count as done. A record (`NODE`) from before the order is
        ignored.
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
        """Return which of some heliostats have not acknowledged the order."""
        return tuple(name for name in heliostats if not self.is_acknowledged(name))

    def take_stage(self, heliostats: tuple[str, ...], stage: Stage, now: float) -> None:
        """Accept a cluster's report on the order."""
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
        """Accept `NODE` records of heliostats (K,), their times of validity, and the drives.

        Step counts (``counted``) from before the order are ignored, because they do not show where
        the beam is now.

        ``mismatched`` heliostats do not match their address: their counts may belong to another
        heliostat, so their reports prove nothing. As long as a beam is still on a receiver
        (``shining``), the heliostat is not done.
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
    """Return a mask of the heliostats that cannot obey: away from stow, local switch off."""
    return np.asarray((flags & meanings.LOCAL_SWITCH != 0) & (flags & meanings.AT_STOW == 0))


def at_stow(rows: npt.NDArray[Any]) -> Mask:
    """Return a mask of the `NODE` records (K,) that show a heliostat at rest at stow.

    A heliostat that is locked there or has a fault counts; a heliostat that is IDLE there does not,
    because it may start to track.
    """
    resting = (rows["state"] == states.STOWED) | (rows["flags"] & meanings.AT_STOW != 0)
    return np.asarray(resting & ~np.isin(rows["state"], states.BEAM_OUT))


def carried_out(act: Act, rows: npt.NDArray[Any], drives: Drive, settled: Mask) -> Mask:
    """Return a mask of the `NODE` records (K,) that show DEFOCUS or STOW carried out.

    Parameters
    ----------
    act
        DEFOCUS or STOW.
    rows
        The records as reported by the clusters.
    drives
        Drives of these heliostats, (K, 2).
    settled
        Whether a heliostat on its way to stow has had enough time to leave the receiver, (K,).
    """
    off = ~np.isin(rows["state"], states.BEAM_OUT)
    known = (rows["flags"] & meanings.COUNTS_UNKNOWN == 0) & ~switched_off(rows["flags"])
    stowed = known & at_stow(rows)
    if act is Act.STOW:
        return np.asarray(stowed)
    counts = np.stack([rows["primary"], rows["secondary"]], axis=-1).astype(np.float64)
    goals = np.stack([rows["primary_goal"], rows["secondary_goal"]], axis=-1).astype(np.float64)
    remaining = np.abs((goals - counts) * drives.radians_per_count(counts)).max(axis=-1)
    # On the way to stow the goal is far away, although the beam has already left.
    leaving = rows["state"] == states.STOWING
    return np.asarray(stowed | (off & known & np.where(leaving, settled, remaining < NEAR)))
