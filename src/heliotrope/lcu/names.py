"""Descriptions of the state table and of STATUS for display, which boards do not need."""

from . import states

#: Who can cause an event: anyone at any time; the command authority, with a fresh frame; the
#: controller itself.
SAFE, COMMAND, INTERNAL = range(3)

#: Event: kind, meaning.
EVENTS = {
    "DEFOCUS": (SAFE, "beams off the receiver, now"),
    "STOW": (SAFE, "go to stow; turn away if the stow position or the step counts are unknown"),
    "LOCK": (COMMAND, "stop and hold position; complete a motion that takes the beam off first"),
    "APPROACH": (COMMAND, "leave stow for standby"),
    "IDLE": (COMMAND, "go to standby; hold if it was never reached (refused: DEFOCUSED)"),
    "TRACK": (COMMAND, "track the sun onto the aim"),
    "REFOCUS": (COMMAND, "return from defocus to the aim"),
    "SEARCH": (COMMAND, "move the beam in a spiral about its aim"),
    "JOG": (COMMAND, "move one axis by hand"),
    "GOTO": (COMMAND, "move to step counts"),
    "DIAGNOSE": (COMMAND, "move a short distance and back"),
    "UNLOCK": (COMMAND, "release a lock, away from stow"),
    "UNLOCK_STOWED": (COMMAND, "release a lock, at stow"),
    "UNLOCK_FAULT": (COMMAND, "release a lock while a fault is latched"),
    "CLEAR_FAULT": (COMMAND, "clear a fault whose cause has gone, away from stow"),
    "CLEAR_FAULT_STOWED": (COMMAND, "clear a fault whose cause has gone, at stow"),
    "CONFIGURED": (INTERNAL, "the last missing setting has arrived"),
    "BOOT_STOWED": (INTERNAL, "started with all settings, at stow"),
    "BOOT_AWAY": (INTERNAL, "started with all settings, away from stow"),
    "BOOT_LOCKED": (INTERNAL, "started with all settings, locked before the reset"),
    "BOOT_FAULT": (INTERNAL, "started with all settings, with a fault latched before the reset"),
    "ARRIVED": (INTERNAL, "the motion is complete"),
    "SEARCHED": (INTERNAL, "the spiral is complete"),
    "LAPSED": (INTERNAL, "the sun vector or, for a mirror at rest, the last message is too old"),
    "SILENT": (INTERNAL, "throughout the stow delay, nothing arrived that keeps it from stow"),
    "UNREACHABLE": (INTERNAL, "no pose sends the beam to the aim"),
    "FAULTED": (INTERNAL, "a fault has been detected"),
}

#: Motion: meaning.
MOTIONS = {
    "hold": "slow down and stop",
    "lock": "complete a turn away or a motion to stow; otherwise slow down and stop",
    "defocus": "turn away by the defocus angles, without needing the sun",
    "stow": "back along the approach path, then to stow, azimuth last",
    "stow_directly": "straight to stow: elevation first, azimuth last",
    "approach": "azimuth first, elevation last, along the ground to the tower and up",
    "standby": "follow the sun onto the standby point; hold if it was never reached",
    "track": "follow the sun onto the aim",
    "search": "follow the sun onto a spiral about the aim",
    "move": "go to the commanded step counts",
    "diagnose": "move each axis a short distance and back, and read the sensor",
}


def transitions() -> list[tuple[int, str, int, str]]:
    """Return all transitions: state, event, new state, and motion (empty if none starts)."""
    rows = []
    for line in states.TABLE.split("\n"):
        if line:
            words = line.split(" ") + [""]
            start, end = states.STATES.index(words[0]), states.STATES.index(words[2])
            rows.append((start, words[1], end, words[3]))
    return rows


#: Flags of STATUS, from bit 0 up.
FLAGS = ("MOVING", "SUN_FRESH", "CLOCK_SET", "CONFIGURED", "READY", "AT_STOW", "AIM_LOCKED",
         "ROUGH", "COUNTS_DOUBTFUL", "COUNTS_UNKNOWN", "UNREACHABLE", "CUT", "CLOCK_JUMPED",
         "TICKS_JUMPED", "FAULT_PRESENT", "DIAGNOSING", "SUN_JUMPED", "LOCAL_SWITCH",
         "BUS_KEY", "SESSION_WANTED")  # fmt: skip
# Their bits.
(MOVING, SUN_FRESH, CLOCK_SET, CONFIGURED, READY, AT_STOW, AIM_LOCKED,
 ROUGH, COUNTS_DOUBTFUL, COUNTS_UNKNOWN, UNREACHABLE, CUT, CLOCK_JUMPED,
 TICKS_JUMPED, FAULT_PRESENT, DIAGNOSING, SUN_JUMPED, LOCAL_SWITCH,
 BUS_KEY, SESSION_WANTED) = [1 << bit for bit in range(20)]  # fmt: skip

#: Faults.
FAULTS = ("none", "primary drive stuck", "secondary drive stuck", "limit switch", "supply",
          "temperature", "sensor", "step counts unknown", "boots again and again", "journal",
          "latched before the reset")  # fmt: skip
