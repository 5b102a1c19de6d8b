"""What surrounds an emergency: readings, the proof that it was carried out, joining in steps."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from heliotrope.errors import InputError

#: From the order: to the last local controller; beams off; mirrors stowed, s.
ORDER_BUDGET, DEFOCUS_BUDGET, STOW_BUDGET = 1.0, 30.0, 300.0
#: Largest share of the nominal flux on the receiver after a defocus.
FLUX_LIMIT = 0.10
#: A reading of the flux older than this (s) proves nothing.
FLUX_AGE = 5.0


@dataclass(frozen=True)
class Reading:
    """A value in the unit of its row, and when it was taken, monotonic s."""

    value: float
    at: float


@dataclass(frozen=True)
class ProofReport:
    """How far an emergency has come.

    Attributes
    ----------
    unacknowledged
        Nodes that have not acknowledged the order, sorted.
    not_done
        Nodes that have not reported that they are defocused or stowed, sorted.
    late
        Nodes beyond the deadline of their acknowledgement or of the action, sorted.
    flux_proven
        Whether the flux is below its limit, by a fresh reading taken after the order;
        ``None`` while the time for it is not over and it is not.
    complete
        Every node acknowledged and done, and the flux proven.
    """

    unacknowledged: tuple[str, ...]
    not_done: tuple[str, ...]
    late: tuple[str, ...]
    flux_proven: bool | None
    complete: bool

    @property
    def text(self) -> str:
        """One line for the operator."""
        if self.complete:
            return "every node acknowledged and done; the flux is below its limit"
        parts = []
        for names, what in ((self.unacknowledged, "not acknowledged"), (self.not_done, "not done")):
            if names:
                shown = ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
                parts.append(f"{len(names)} {what}: {shown}")
        if self.flux_proven is None:
            parts.append("flux not proven yet")
        elif not self.flux_proven:
            parts.append(f"flux not proven to be below {FLUX_LIMIT:.0%}")
        return "; ".join(parts)


@dataclass(frozen=True)
class Proof:
    """Bookkeeping of one DEFOCUS or STOW order: every node acknowledged, or named.

    Attributes
    ----------
    order
        "DEFOCUS" or "STOW".
    ordered_at
        Monotonic s.
    nodes
        Who must obey.
    acknowledged, done
        When each node acknowledged the order and reported the action done, s.
    flux
        Last reading of the flux as a share of the nominal, taken after the order.
    refused
        Reports that prove nothing: of strangers, or from before the order.
    """

    order: str
    ordered_at: float
    nodes: frozenset[str]
    acknowledged: Mapping[str, float] = field(default_factory=dict)
    done: Mapping[str, float] = field(default_factory=dict)
    flux: Reading | None = None
    refused: int = 0

    def __post_init__(self) -> None:
        if self.order not in ("DEFOCUS", "STOW"):
            raise InputError(f"proof of {self.order!r}: only DEFOCUS and STOW are proven")
        if not math.isfinite(self.ordered_at):
            raise InputError(f"proof of {self.order}: ordered at {self.ordered_at} s, not a time")

    @classmethod
    def of(cls, order: str, nodes: Iterable[str], now: float) -> "Proof":
        """Return the proof of an order given to ``nodes`` at ``now``; nothing is proven yet."""
        return cls(order, now, frozenset(nodes))

    @property
    def budget(self) -> float:
        """From the order to the finished action, s."""
        return DEFOCUS_BUDGET if self.order == "DEFOCUS" else STOW_BUDGET

    def with_acknowledged(self, node: str, at: float) -> "Proof":
        """Return the proof with a node's acknowledgement; only the first one counts."""
        return self.with_news(acknowledged={node: at})

    def with_done(self, node: str, at: float) -> "Proof":
        """Return the proof with a node's report that it is done, which acknowledges too."""
        return self.with_news(done={node: at})

    def with_news(
        self,
        *,
        acknowledged: Mapping[str, float] | None = None,
        done: Mapping[str, float] | None = None,
    ) -> "Proof":
        """Return the proof with the reports of many nodes, each with its time: one copy for all."""
        told, ready = dict(acknowledged or {}), dict(done or {})
        good_told = {node: at for node, at in told.items() if self._counts(node, at)}
        good_ready = {node: at for node, at in ready.items() if self._counts(node, at)}
        wrong = len(told) + len(ready) - len(good_told) - len(good_ready)
        return replace(
            self,
            acknowledged={**good_ready, **good_told, **self.acknowledged},
            done={**good_ready, **self.done},
            refused=self.refused + wrong,
        )

    def with_flux(self, share: float, at: float) -> "Proof":
        """Return the proof with a reading of the flux, as a share of the nominal."""
        newer = self.flux is None or at > self.flux.at
        if not (math.isfinite(share) and at >= self.ordered_at and newer):
            return replace(self, refused=self.refused + 1)
        return replace(self, flux=Reading(share, at))

    def _counts(self, node: str, at: float) -> bool:
        return node in self.nodes and math.isfinite(at) and at >= self.ordered_at

    def report(self, now: float) -> ProofReport:
        """Return what is proven at ``now``, and who is late."""
        silent = self.nodes - set(self.acknowledged)
        open_ = self.nodes - set(self.done)
        late = {n for n, at in self.acknowledged.items() if at - self.ordered_at > ORDER_BUDGET}
        late |= {n for n, at in self.done.items() if at - self.ordered_at > self.budget}
        # A time that cannot be compared is as late as can be.
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
            complete=not silent and not open_ and flux is True,
        )

    def _flux_proven(self, now: float) -> bool | None:
        known = self.flux is not None and 0.0 <= now - self.flux.at <= FLUX_AGE
        if known and self.flux is not None and self.flux.value < FLUX_LIMIT:
            return True
        return None if now - self.ordered_at <= DEFOCUS_BUDGET else False


def proof_readings(proof: Proof | None, now: float) -> dict[tuple[str, str], Reading]:
    """Return the readings that rows of the table take from a proof; ``None``: no emergency.

    ``nodes_unacknowledged`` is the number of nodes without acknowledgement once the time for
    it is over; ``flux_after_emergency`` is 0 until the time to defocus is over, then the
    share of the nominal flux, and 1 if that is not known.
    """
    silent, flux = 0.0, 0.0
    if proof is not None:
        report = proof.report(now)
        if not now - proof.ordered_at <= ORDER_BUDGET:
            silent = float(len(report.unacknowledged))
        if report.flux_proven is False:
            fresh = proof.flux is not None and 0.0 <= now - proof.flux.at <= FLUX_AGE
            flux = proof.flux.value if fresh and proof.flux is not None else 1.0
    return {
        ("nodes_unacknowledged", ""): Reading(silent, now),
        ("flux_after_emergency", ""): Reading(flux, now),
    }


@dataclass(frozen=True)
class JoinLimiter:
    """Bounds how many mirrors join the receiver: a token bucket without a clock.

    In any span of T seconds at most ``burst + rate · T`` mirrors join.

    Attributes
    ----------
    rate
        Mirrors a second, 0 or more.
    burst
        Mirrors at once after a rest, a whole number from 1.
    tokens, at
        What may join at the monotonic time ``at``, s. A new limiter is empty.
    """

    rate: float
    burst: int
    tokens: float = 0.0
    at: float | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate) and self.rate >= 0.0):
            raise InputError(f"joining rate {self.rate} mirrors/s must be 0 or more and finite")
        if self.burst < 1:
            raise InputError(f"joining burst {self.burst} must be a whole number from 1")

    def admit(self, wanted: int, now: float) -> tuple["JoinLimiter", int]:
        """Return the limiter afterwards and how many of ``wanted`` mirrors may join now.

        A clock that stands, goes back or is not a number grants no new tokens; one that
        jumps ahead fills the bucket at most to its burst.
        """
        at = self.at
        tokens = self.tokens
        if math.isfinite(now):
            if at is not None and now > at:
                tokens = min(float(self.burst), tokens + self.rate * (now - at))
            at = now if at is None else max(at, now)
        # Rounding must not withhold a token that is earned.
        granted = max(0, min(wanted, math.floor(tokens + 1e-9)))
        return replace(self, tokens=max(0.0, tokens - granted), at=at), granted
