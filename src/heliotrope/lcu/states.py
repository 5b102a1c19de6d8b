"""States of a local controller, and all its transitions in one table.

A line contains the state, the event, the new state and the motion that starts, if any. An event
that is not in the table is refused and changes nothing. A motion that starts replaces any other
motion. ``names`` describes the events and motions. The table is text, because on a microcontroller
a tuple per line would take 7 kB more.
"""

STATES = (
    "UNCONFIGURED",
    "STOWED",
    "STOWING",
    "APPROACHING",
    "IDLE",
    "TRACKING",
    "DEFOCUSED",
    "LOCKED",
    "SEARCHING",
    "FAULT",
)
(
    UNCONFIGURED,
    STOWED,
    STOWING,
    APPROACHING,
    IDLE,
    TRACKING,
    DEFOCUSED,
    LOCKED,
    SEARCHING,
    FAULT,
) = range(10)

#: States that need a fresh sun vector to enter and to remain in: LAPSED leaves them.
NEED_SUN = (APPROACHING, TRACKING, SEARCHING)

#: States in which a beam is at its aim.
ON_AIM = (TRACKING, SEARCHING)
#: States in which a beam is at the receiver or the standby point, or on its way there.
BEAM_OUT = (APPROACHING, IDLE, TRACKING, SEARCHING)
#: States in which a heliostat is neither at stow nor on its way there, and obeys STOW.
UP = (APPROACHING, IDLE, TRACKING, SEARCHING, DEFOCUSED)
#: States from which a heliostat can be sent to a target.
AVAILABLE = (IDLE, TRACKING)
#: States in which a beam leaves, or has left, by DEFOCUS or STOW.
LEAVING = (DEFOCUSED, STOWING)
#: States in which a heliostat is at stow or on its way there.
TO_STOW = (STOWED, STOWING)
#: States in which a beam is off and a command brings it out again.
AWAY = (STOWED, DEFOCUSED)
#: States that STOW does not change, although the heliostat may turn away or go to stow in them.
KEPT = (UNCONFIGURED, LOCKED, FAULT)

TABLE = """
UNCONFIGURED DEFOCUS UNCONFIGURED defocus
UNCONFIGURED STOW UNCONFIGURED stow_directly
UNCONFIGURED LOCK UNCONFIGURED lock
UNCONFIGURED CONFIGURED LOCKED hold
UNCONFIGURED BOOT_STOWED STOWED hold
UNCONFIGURED BOOT_AWAY DEFOCUSED defocus
UNCONFIGURED BOOT_LOCKED LOCKED hold
UNCONFIGURED BOOT_FAULT FAULT defocus
UNCONFIGURED LAPSED UNCONFIGURED defocus
UNCONFIGURED SILENT UNCONFIGURED stow_directly
UNCONFIGURED FAULTED UNCONFIGURED
STOWED DEFOCUS STOWED
STOWED STOW STOWED
STOWED LOCK LOCKED lock
STOWED APPROACH APPROACHING approach
STOWED IDLE IDLE hold
STOWED FAULTED FAULT hold
STOWING DEFOCUS STOWING stow_directly
STOWING STOW STOWING
STOWING LOCK LOCKED lock
STOWING ARRIVED STOWED hold
STOWING LAPSED STOWING stow_directly
STOWING UNREACHABLE STOWING stow_directly
STOWING FAULTED FAULT stow_directly
APPROACHING DEFOCUS DEFOCUSED defocus
APPROACHING STOW STOWING stow
APPROACHING LOCK LOCKED lock
APPROACHING ARRIVED IDLE standby
APPROACHING LAPSED DEFOCUSED defocus
APPROACHING UNREACHABLE DEFOCUSED defocus
APPROACHING FAULTED FAULT defocus
IDLE DEFOCUS DEFOCUSED defocus
IDLE STOW STOWING stow
IDLE LOCK LOCKED lock
IDLE IDLE IDLE standby
IDLE TRACK TRACKING track
IDLE SEARCH SEARCHING search
IDLE JOG IDLE move
IDLE GOTO IDLE move
IDLE DIAGNOSE IDLE diagnose
IDLE LAPSED DEFOCUSED defocus
IDLE UNREACHABLE DEFOCUSED defocus
IDLE FAULTED FAULT defocus
TRACKING DEFOCUS DEFOCUSED defocus
TRACKING STOW STOWING stow
TRACKING LOCK LOCKED lock
TRACKING IDLE IDLE standby
TRACKING TRACK TRACKING
TRACKING SEARCH SEARCHING search
TRACKING LAPSED DEFOCUSED defocus
TRACKING UNREACHABLE DEFOCUSED defocus
TRACKING FAULTED FAULT defocus
DEFOCUSED DEFOCUS DEFOCUSED
DEFOCUSED STOW STOWING stow
DEFOCUSED LOCK LOCKED lock
DEFOCUSED IDLE IDLE standby
DEFOCUSED TRACK TRACKING track
DEFOCUSED REFOCUS TRACKING track
DEFOCUSED SILENT STOWING stow_directly
DEFOCUSED FAULTED FAULT defocus
LOCKED DEFOCUS LOCKED defocus
LOCKED STOW LOCKED stow_directly
LOCKED LOCK LOCKED lock
LOCKED UNLOCK IDLE hold
LOCKED UNLOCK_STOWED STOWED hold
LOCKED UNLOCK_FAULT FAULT hold
LOCKED LAPSED LOCKED defocus
LOCKED SILENT LOCKED stow_directly
LOCKED UNREACHABLE LOCKED stow_directly
LOCKED FAULTED LOCKED lock
SEARCHING DEFOCUS DEFOCUSED defocus
SEARCHING STOW STOWING stow
SEARCHING LOCK LOCKED lock
SEARCHING IDLE IDLE standby
SEARCHING TRACK TRACKING track
SEARCHING SEARCH SEARCHING search
SEARCHING SEARCHED IDLE standby
SEARCHING LAPSED DEFOCUSED defocus
SEARCHING UNREACHABLE DEFOCUSED defocus
SEARCHING FAULTED FAULT defocus
FAULT DEFOCUS FAULT defocus
FAULT STOW FAULT stow_directly
FAULT LOCK LOCKED lock
FAULT CLEAR_FAULT IDLE hold
FAULT CLEAR_FAULT_STOWED STOWED hold
FAULT LAPSED FAULT defocus
FAULT SILENT FAULT stow_directly
FAULT FAULTED FAULT
"""


def transition(state: int, event: str) -> "tuple[int, str] | None":
    """Return the new state and the motion (empty if none starts); None if the event is refused."""
    key = "\n" + STATES[state] + " " + event + " "
    start = TABLE.find(key)
    if start < 0:
        return None
    start += len(key)
    words = TABLE[start : TABLE.find("\n", start)].split(" ")
    return STATES.index(words[0]), words[1] if len(words) > 1 else ""
