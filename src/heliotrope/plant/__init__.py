"""The plant: the central controller of a field, and the operations built on it.

`PlantController` ties the parts together: `Authority` (who may command), `PlantOrders` (records,
tickets, messages), `JoinQueue` (the rate at which heliostats join the receiver), `PathProofs` and
`BeamWatch` (no beam in a keep-out volume), `ParameterSync` (what local controllers store) and
`Sentinel` (the safety table and emergencies). Begin with `heliotrope.plant.controller`.

Operators and pages use `operations`; `visits` brings a beam to a target, and `schedule` chooses
which heliostat is measured next. `kept_audit` needs the libraries of the store and must be imported
from its module.
"""

from heliotrope.plant.controller import PlantController, Stores
from heliotrope.plant.emergency import EmergencyOrder
from heliotrope.plant.field.aims import BeamCheck, default_aims, spread
from heliotrope.plant.field.assigned import Assigned, AssignedError, AssignedFile, rest_on
from heliotrope.plant.field.state import FieldState, HeliostatState
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.orders.audit import Audit, AuditError, JsonLines, Record
from heliotrope.plant.orders.authority import OPERATOR_COMMANDS, Authority, Grant, Person, Role
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.refusals import Refusal, RefusedError
from heliotrope.plant.settings import PlantSettings, clusters_of

__all__ = [
    "OPERATOR_COMMANDS",
    "Assigned",
    "AssignedError",
    "AssignedFile",
    "Audit",
    "AuditError",
    "Authority",
    "BeamCheck",
    "BeamError",
    "EmergencyOrder",
    "FieldState",
    "Grant",
    "HeliostatState",
    "JsonLines",
    "Person",
    "PlantController",
    "PlantSettings",
    "Record",
    "Refusal",
    "RefusedError",
    "Role",
    "Stores",
    "Ticket",
    "clusters_of",
    "default_aims",
    "rest_on",
    "spread",
]
