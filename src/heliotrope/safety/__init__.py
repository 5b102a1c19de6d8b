"""Safety: the condition table and its evaluation, alarms, and confirmation of emergency orders.

Begin with `CONDITIONS`, the rows of the table, and `evaluate`, which determines the required
actions from readings and the time. `Proof` records whether every heliostat obeyed an emergency
order. `limited` returns the table with the limits that a plant sets for its site. `JoinLimiter`
limits the rate at which heliostats join the receiver. `Alarm` is a message to operators, and
`heliotrope.safety.alarms` lists every kind of alarm that is not a row of the table.

No function in this package reads a clock, a sensor or a link.
"""

from heliotrope.safety.alarms import Alarm, AlarmKind
from heliotrope.safety.condition import (
    AcknowledgeRole,
    Act,
    Condition,
    Reading,
    Scope,
    Severity,
    Watcher,
)
from heliotrope.safety.conditions import CONDITIONS, conditions
from heliotrope.safety.evaluation import (
    Action,
    SafetyState,
    acknowledge,
    decision,
    evaluate,
    narrowed,
    recalled,
    start,
    watched_by,
)
from heliotrope.safety.joining import JoinLimiter
from heliotrope.safety.limits import Limits, differences, limited, numbers, settings_of
from heliotrope.safety.proof import (
    DEFOCUS_BUDGET,
    FLUX_READING,
    ORDER_BUDGET,
    STOW_BUDGET,
    FluxProof,
    Proof,
    ProofReport,
    proof_readings,
)

__all__ = [
    "CONDITIONS",
    "DEFOCUS_BUDGET",
    "FLUX_READING",
    "ORDER_BUDGET",
    "STOW_BUDGET",
    "AcknowledgeRole",
    "Act",
    "Action",
    "Alarm",
    "AlarmKind",
    "Condition",
    "FluxProof",
    "JoinLimiter",
    "Limits",
    "Proof",
    "ProofReport",
    "Reading",
    "SafetyState",
    "Scope",
    "Severity",
    "Watcher",
    "acknowledge",
    "conditions",
    "decision",
    "differences",
    "evaluate",
    "limited",
    "narrowed",
    "numbers",
    "proof_readings",
    "recalled",
    "settings_of",
    "start",
    "watched_by",
]
