"""Errors passed over the local interface: a kind and a text, converted back to the same class."""

from heliotrope.errors import HeliotropeError, InputError, UnknownNameError
from heliotrope.local import CallError
from heliotrope.plant.interface.admission import BusyError
from heliotrope.plant.orders.audit import AuditError
from heliotrope.plant.refusals import RefusedError
from heliotrope.store.records import StoreError

#: Classes by kind; a class precedes its base classes.
_CLASSES: dict[str, type[HeliotropeError]] = {
    "busy": BusyError,
    "unknown": UnknownNameError,
    "input": InputError,
    "refused": RefusedError,
    "audit": AuditError,
    "store": StoreError,
}


def kind_of(error: HeliotropeError) -> tuple[str, str]:
    """Return the kind and the text of an error."""
    for kind, made in _CLASSES.items():
        if isinstance(error, made):
            return kind, str(error)
    return "other", str(error)


def remade(error: CallError) -> HeliotropeError:
    """Return the error that the plant's process raised, in the same class."""
    kind = _CLASSES.get(error.kind, HeliotropeError)
    # The text is complete; the constructor of `UnknownNameError` would create another text.
    made = kind.__new__(kind)
    made.args = (str(error),)
    return made
