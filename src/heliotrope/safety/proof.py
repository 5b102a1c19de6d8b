"""The proof that an emergency order was carried out.

It is a proof of reports: of states and step counts. Only the flux on the receiver is measured after
the order, where a sensor feeds it, and that shows the field, not a single mirror. What has shown
earlier that mirrors follow their drives is said beside it.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum

from heliotrope.errors import InputError
from heliotrope.safety.condition import Reading

#: Longest time from the order to the last acknowledgement, to beams off the receiver, and to
#: stow, s.
ORDER_BUDGET, DEFOCUS_BUDGET, STOW_BUDGET = 1.0, 30.0, 300.0
#: Limit of the flux on the receiver after a defocus, as a share of the nominal.
FLUX_LIMIT = 0.10
#: A flux reading older than this (s) proves nothing.
FLUX_AGE = 5.0
#: Sensor of the flux on the receiver, as a share of its nominal value.
FLUX_READING = "receiver_flux_nominal"


class FluxProof(Enum):
    """The statement of a proof about the flux on the receiver; the value is its text."""

    #: No sensor feeds it: the proof rests on what each heliostat reports.
    NOT_MEASURED = "flux on the receiver not measured"
    #: There is still time for a reading.
    AWAITED = "flux not proven yet"
    #: A fresh reading, taken after the order, shows it below its limit.
    BELOW = (
        "measured: the flux is below its limit "
        f"({FLUX_LIMIT:.0%} of nominal, where single beams do not show)"
    )
    #: No such reading came in time.
    NOT_BELOW = f"flux not proven to be below {FLUX_LIMIT:.0%}"


@dataclass(frozen=True)
class ProofReport:
    """The progress of an emergency order.

    Attributes
    ----------
    unacknowledged, not_done
        Heliostats that have not acknowledged the order, and that have not carried it out; sorted.
    late
        Heliostats that missed the deadline for either, sorted.
    flux
        Whether the flux is proven to be below its limit.
    complete
        Whether every heliostat has acknowledged and is done, and the flux is proven or is not
        measured.
    unknown
        What is known of each heliostat of which nothing can show that it is done.
    followed
        Number of the heliostats that are done whose mirrors were seen to follow their drives
        earlier today, by what showed it.
    believed
        Those that are done by their reports alone, sorted.
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
            return f"every heliostat has acknowledged and is done, as it reports; {self.basis}"
        parts = []
        for names, what in ((self.unacknowledged, "not acknowledged"), (self.not_done, "not done")):
            if names:
                parts.append(f"{len(names)} {what}: {_first(names)}")
        return "; ".join([*parts, *self.unknown[:8], self.basis])

    @property
    def basis(self) -> str:
        """The measured and the believed parts of the proof, in one line."""
        parts = [self.flux.value]
        if self.flux is not FluxProof.BELOW and (self.complete or self.believed or self.followed):
            parts[0] += ", so this is believed: a stalled drive reports the same"
        parts += [
            f"{count} seen to move today by {by}" for by, count in sorted(self.followed.items())
        ]
        if self.believed:
            parts.append(f"{len(self.believed)} by reports alone: {_first(self.believed)}")
        return "; ".join(parts)

    def with_evidence(self, done: Iterable[str], shown: Mapping[str, str]) -> "ProofReport":
        """Return the report with what showed today that mirrors follow, by heliostat.

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
    """The record of one DEFOCUS or STOW order: every heliostat has acknowledged it or is named.

    Attributes
    ----------
    order
        "DEFOCUS" or "STOW".
    ordered_at
        Monotonic s.
    nodes
        Heliostats that must obey.
    acknowledged, done
        Time at which each of them acknowledged the order and carried it out, s.
    flux
        Last reading of the flux after the order, as a share of the nominal.
    flux_measured
        Whether a sensor feeds the flux.
    refused
        Number of reports that prove nothing: from other heliostats, or from before the order.
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
        """Return the proof of an order given to ``nodes`` at ``now``; nothing is proven yet."""
        return cls(order, now, frozenset(nodes), flux_measured=flux_measured)

    @property
    def budget(self) -> float:
        """Longest time from the order to the finished action, s."""
        return DEFOCUS_BUDGET if self.order == "DEFOCUS" else STOW_BUDGET

    def with_news(
        self,
        *,
        acknowledged: Mapping[str, float] | None = None,
        done: Mapping[str, float] | None = None,
    ) -> "Proof":
        """Return the proof with reports of heliostats, each with its time, s.

        Only the first report of a heliostat counts. One that it is done acknowledges the order too.
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
        """Return the proof without what some heliostats had done: it holds no longer."""
        undone = frozenset(nodes)
        return replace(self, done={n: at for n, at in self.done.items() if n not in undone})

    def with_flux(self, share: float, at: float) -> "Proof":
        """Return the proof with a flux reading, as a share of the nominal."""
        newer = self.flux is None or at > self.flux.at
        if not (math.isfinite(share) and at >= self.ordered_at and newer):
            return replace(self, refused=self.refused + 1)
        return replace(self, flux=Reading(share, at))

    def _counts(self, node: str, at: float) -> bool:
        return node in self.nodes and math.isfinite(at) and at >= self.ordered_at

    def report(self, now: float) -> ProofReport:
        """Return the progress at ``now``, with the heliostats that are late."""
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
    """Return the readings that the safety table takes from a proof; None: no emergency.

    ``nodes_unacknowledged`` is 0 until the deadline of the acknowledgements, then the number of
    heliostats that have not acknowledged. ``flux_after_emergency`` is 0 until the deadline of the
    defocus, then the flux as a share of the nominal, or 1 if its sensor is silent; it stays 0
    where no sensor feeds it.
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
