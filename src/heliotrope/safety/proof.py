"""Confirmation that an emergency order was carried out.

The confirmation is based on reports, that is, on states and step counts. The only quantity measured
after the order is the flux on the receiver, if a sensor supplies it; the flux reflects the whole
field, not a single heliostat. Earlier evidence that mirrors follow their drives is included in the
report.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum

from heliotrope.errors import InputError
from heliotrope.safety.condition import Reading

#: Maximum time from the order to the last acknowledgement, until all beams are off the receiver,
#: and until all heliostats are stowed, s.
ORDER_BUDGET, DEFOCUS_BUDGET, STOW_BUDGET = 1.0, 30.0, 300.0
#: Limit of the flux on the receiver after a defocus, as a fraction of the nominal flux.
FLUX_LIMIT = 0.10
#: A flux reading older than this, s, does not confirm anything.
FLUX_AGE = 5.0
#: Sensor of the flux on the receiver, as a fraction of its nominal value.
FLUX_READING = "receiver_flux_nominal"


class FluxProof(Enum):
    """What is known about the flux on the receiver; each value is the text to display."""

    #: No sensor supplies the flux, so the confirmation rests on what each heliostat reports.
    NOT_MEASURED = "the flux on the receiver is not measured"
    #: No reading has confirmed it yet, but there is still time for one.
    AWAITED = "flux not proven yet"
    #: A fresh reading, taken after the order, is below the limit.
    BELOW = (
        "measured: the flux is below its limit "
        f"({FLUX_LIMIT:.0%} of nominal, where single beams do not show)"
    )
    #: No reading below the limit arrived in time.
    NOT_BELOW = f"flux not proven to be below {FLUX_LIMIT:.0%}"


@dataclass(frozen=True)
class ProofReport:
    """The progress of an emergency order.

    Attributes
    ----------
    unacknowledged, not_done
        Heliostats that have not acknowledged the order, and heliostats that have not carried it
        out; sorted.
    late
        Heliostats that missed either deadline, sorted.
    flux
        Whether the flux is confirmed to be below its limit.
    complete
        Whether every heliostat has acknowledged and completed the order, and the flux is confirmed
        or not measured.
    unknown
        What is known about each heliostat for which nothing can confirm that it carried out the
        order.
    followed
        For each kind of evidence, the number of heliostats that have completed the order and whose
        mirrors were observed earlier today to follow their drives.
    believed
        Heliostats whose completion rests on their own reports alone, sorted.
    """

    unacknowledged: tuple[str, ...]
    not_done: tuple[str, ...]
    late: tuple[str, ...]
    flux: FluxProof
    complete: bool
    unknown: tuple[str, ...] = ()
    followed: Mapping[str, int] = field(default_factory=dict)
    believed: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """One line for the operator."""
        if self.complete:
            return f"every heliostat has acknowledged and reports that it is done; {self.basis}"
        parts = []
        for names, what in ((self.unacknowledged, "not acknowledged"), (self.not_done, "not done")):
            if names:
                parts.append(f"{len(names)} {what}: {_first(names)}")
        return "; ".join([*parts, *self.unknown[:8], self.basis])

    @property
    def evidence(self) -> str:
        """The measured and the reported parts of the confirmation, without names."""
        parts = [self.flux.value]
        if self.flux is not FluxProof.BELOW and (self.complete or self.believed or self.followed):
            parts[0] += ", so this is not proven, because a stalled drive reports the same"
        parts += [
            f"{count} seen to move today by {by}" for by, count in sorted(self.followed.items())
        ]
        if self.believed:
            parts.append(f"{len(self.believed)} by reports alone")
        return "; ".join(parts)

    @property
    def basis(self) -> str:
        """The same, with the first of the heliostats that are believed."""
        names = f": {_first(self.believed)}" if self.believed else ""
        return f"{self.evidence}{names}"

    def with_evidence(self, done: Iterable[str], shown: Mapping[str, str]) -> "ProofReport":
        """Return the report with today's evidence, by heliostat, that mirrors follow their drives.

        ``done`` are the heliostats that have carried out the order.
        """
        names = sorted(done)
        followed = Counter(shown[name] for name in names if name in shown)
        return replace(
            self,
            followed=dict(followed),
            believed=tuple(name for name in names if name not in shown),
        )


def _first(names: tuple[str, ...]) -> str:
    return ", ".join(names[:8]) + (", …" if len(names) > 8 else "")


@dataclass(frozen=True)
class Proof:
    """Record of one DEFOCUS or STOW order that shows which heliostats have not obeyed.

    Attributes
    ----------
    order
        "DEFOCUS" or "STOW".
    ordered_at
        Time of the order, monotonic s.
    nodes
        Heliostats that must obey.
    acknowledged, done
        Time at which each heliostat acknowledged the order, and time at which it carried it out, s.
    flux
        Last flux reading after the order, as a fraction of the nominal flux.
    flux_measured
        Whether a sensor supplies the flux.
    refused
        Number of reports that confirm nothing, because they are from other heliostats or from
        before the order.
    """

    order: str
    ordered_at: float
    nodes: frozenset[str]
    acknowledged: Mapping[str, float] = field(default_factory=dict)
    done: Mapping[str, float] = field(default_factory=dict)
    flux: Reading | None = None
    flux_measured: bool = True
    refused: int = 0

    def __post_init__(self) -> None:
        if self.order not in ("DEFOCUS", "STOW"):
            raise InputError(f"proof of {self.order!r}: only DEFOCUS and STOW are proven")
        if not math.isfinite(self.ordered_at):
            raise InputError(f"proof of {self.order}: ordered at {self.ordered_at} s, not a time")

    @classmethod
    def of(
        cls, order: str, nodes: Iterable[str], now: float, *, flux_measured: bool = True
    ) -> "Proof":
        """Return the record of an order given to ``nodes`` at ``now``; nothing is confirmed yet."""
        return cls(order, now, frozenset(nodes), flux_measured=flux_measured)

    @property
    def budget(self) -> float:
        """Maximum time from the order to the completed action, s."""
        return DEFOCUS_BUDGET if self.order == "DEFOCUS" else STOW_BUDGET

    def with_news(
        self,
        *,
        acknowledged: Mapping[str, float] | None = None,
        done: Mapping[str, float] | None = None,
    ) -> "Proof":
        """Return the record updated with reports from heliostats, each with its time, s.

        Only the first report of a heliostat counts. A report of completion also acknowledges the
        order.
        """
        orders, ends = dict(acknowledged or {}), dict(done or {})
        taken = {node: at for node, at in orders.items() if self._counts(node, at)}
        ended = {node: at for node, at in ends.items() if self._counts(node, at)}
        rejected = len(orders) + len(ends) - len(taken) - len(ended)
        return replace(
            self,
            acknowledged={**ended, **taken, **self.acknowledged},
            done={**ended, **self.done},
            refused=self.refused + rejected,
        )

    def without(self, nodes: Iterable[str]) -> "Proof":
        """Return the record after withdrawing the completion reports of some heliostats."""
        undone = frozenset(nodes)
        return replace(self, done={n: at for n, at in self.done.items() if n not in undone})

    def with_flux(self, share: float, at: float) -> "Proof":
        """Return the record updated with a flux reading, as a fraction of the nominal flux."""
        newer = self.flux is None or at > self.flux.at
        if not (math.isfinite(share) and at >= self.ordered_at and newer):
            return replace(self, refused=self.refused + 1)
        return replace(self, flux=Reading(share, at))

    def _counts(self, node: str, at: float) -> bool:
        return node in self.nodes and math.isfinite(at) and at >= self.ordered_at

    def report(self, now: float) -> ProofReport:
        """Return the progress at ``now``, including the heliostats that are late."""
        silent = self.nodes - set(self.acknowledged)
        open_ = self.nodes - set(self.done)
        late = {n for n, at in self.acknowledged.items() if at - self.ordered_at > ORDER_BUDGET}
        late |= {n for n, at in self.done.items() if at - self.ordered_at > self.budget}
        # A time that is not a number counts as too late.
        if not now - self.ordered_at <= ORDER_BUDGET:
            late |= silent
        if not now - self.ordered_at <= self.budget:
            late |= open_
        flux = self._flux_proven(now)
        return ProofReport(
            tuple(sorted(silent)),
            tuple(sorted(open_)),
            tuple(sorted(late)),
            flux,
            complete=not silent and not open_ and flux in (FluxProof.BELOW, FluxProof.NOT_MEASURED),
        )

    def _flux_proven(self, now: float) -> FluxProof:
        if not self.flux_measured:
            return FluxProof.NOT_MEASURED
        known = self.flux is not None and 0.0 <= now - self.flux.at <= FLUX_AGE
        if known and self.flux is not None and self.flux.value < FLUX_LIMIT:
            return FluxProof.BELOW
        early = now - self.ordered_at <= DEFOCUS_BUDGET
        return FluxProof.AWAITED if early else FluxProof.NOT_BELOW


def proof_readings(proof: Proof | None, now: float) -> dict[tuple[str, str], Reading]:
    """Return the safety-table readings that an emergency order's record implies.

    ``proof`` is None if there is no emergency. ``nodes_unacknowledged`` is 0 until the
    acknowledgement deadline, then the number of heliostats that have not acknowledged.
    ``flux_after_emergency`` is 0 until the defocus deadline, then the flux as a fraction of the
    nominal flux, or 1 if its sensor is silent; it stays 0 if no sensor supplies it.
    """
    silent, flux = 0.0, 0.0
    if proof is not None:
        report = proof.report(now)
        if not now - proof.ordered_at <= ORDER_BUDGET:
            silent = float(len(report.unacknowledged))
        if report.flux is FluxProof.NOT_BELOW:
            fresh = proof.flux is not None and 0.0 <= now - proof.flux.at <= FLUX_AGE
            flux = proof.flux.value if fresh and proof.flux is not None else 1.0
    return {
        ("nodes_unacknowledged", ""): Reading(silent, now),
        ("flux_after_emergency", ""): Reading(flux, now),
    }
