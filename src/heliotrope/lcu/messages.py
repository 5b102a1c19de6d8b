"""All messages of the bus protocol, version 2, as one table.

A row contains the number, the name, who may send the message, the codes of the payload, the names
of its fields, and the traits. Codes are ``struct`` codes, little-endian; ``s`` alone means the
remaining bytes. A field of several numbers has a code with a count ("18d"). Field names end in
their unit. The comment above a row states the meaning of the message; ``docs/reference/wire.md``
takes it from there (on a microcontroller a comment costs no memory).

Who may send a message:

ANYONE     accepted from anyone at any time: the messages that make the field safe
AUTHORITY  moves the heliostat: carries the authority's token, and expires
KEY        changes stored settings: also carries a truncated HMAC and an edition
CLUSTER    from the cluster controller, about every second: time, sun, session
ASK        a query from the cluster controller; it changes nothing
NODE       a reply from a local controller

Payloads of AUTHORITY and KEY messages begin with a head, which their rows omit: the authority's
``token``; ``expires_s``, the GPS second after which the command is void; and for KEY the
``edition``. The edition is a number that only increases and is kept in the journal, so that a
recorded message cannot set a stored value again, whatever was reset in between.

GPS seconds count from 6 January 1980 without leap seconds, modulo 2^32.

Traits, needed by the plant and the clusters but not by boards:

moves      moves the heliostat by its parameters
joins      brings its beam to the aim
standby    brings its beam to the standby point
counts     moves it by step counts, from its present position
sliced     goes to many heliostats in slices
releases   ends a lock or a fault
stands     an idle heliostat then stands still, and tracks no standby point
point      sets a point; only the last one counts
setting    changes later motions; removes no heliostat from a visit
harmless   moves nothing, now or later
stops      only stops the heliostat; accepted even when no motion may begin
relative   a second frame would take effect again
again      its goal looks like the state before the command; a second frame does no harm
stored     written to flash before it is acknowledged
operator   an operator may send it; other AUTHORITY and KEY messages need an engineer
manual     an operator who sends it takes the heliostat from automatic control
automatic  an operator who sends it hands the heliostat to automatic control
"""

ANYONE, AUTHORITY, KEY, CLUSTER, NODE, ASK = 0, 1, 2, 3, 4, 5

#: Codes and names of the fields at the beginning of every payload of a class.
HEADS = {AUTHORITY: ("II", "token expires_s"), KEY: ("III", "token expires_s edition")}

MESSAGES = (
    # Query the step counts.
    (0x01, "QUERY_STEPS", ASK, "", "", ""),
    # Step counts and their goals.
    (0x02, "STEPS", NODE, "iiii", "primary secondary primary_goal secondary_goal", ""),
    # Query the state and the flags.
    (0x03, "QUERY_STATUS", ASK, "", "", ""),
    # State, flags and health.
    (0x04, "STATUS", NODE, "BIBIIHbIH",
     "state flags fault uptime_s sun_age_ms supply_mv temperature_degc armature_crc boots", ""),
    # Query the heliostat's location.
    (0x05, "QUERY_POSITION", ASK, "", "", ""),
    # The heliostat's location, ENU.
    (0x06, "POSITION", NODE, "fff", "east_m north_m up_m", ""),
    # Query the last motion diagnosis.
    (0x07, "QUERY_DIAGNOSIS", ASK, "", "", ""),
    # Whether the heliostat moved as ordered, by accelerometer or limit switch.
    (0x08, "DIAGNOSIS", NODE, "Biiff",
     "result moved_primary moved_secondary tilt_x_rad tilt_y_rad", ""),
    # Query a stored item, by its number in the journal.
    (0x09, "QUERY_STORED", ASK, "B", "item", ""),
    # A stored item.
    (0x0A, "STORED", NODE, "Bs", "item data", ""),
    # Ask all controllers with a serial number in a range to reply, in randomly drawn slots.
    (0x0B, "DISCOVER", ASK, "II", "low high", ""),
    # Serial number, firmware and address.
    (0x0C, "HERE", NODE, "IHH", "serial firmware address", ""),
    # Result of a command.
    (0x0D, "ACK", NODE, "HBB", "sequence_of type_of result", ""),
    # Query what a signed session needs.
    (0x0E, "QUERY_BUS", ASK, "", "", ""),
    # A number drawn by the local controller, over which the next SESSION to its address must be
    # signed, and the fingerprints of the bus keys that it holds (0: none).
    (0x0F, "BUS", NODE, "IIII", "number_high number_low key old_key", ""),
    # GPS time.
    (0x10, "TIME", CLUSTER, "HIB", "week time_of_week_ms quality", ""),
    # Unit vector to the sun at a GPS second, in 2^-30, and its rate, in 2^-28 per second (the sun's
    # 7.3e-5 rad/s would not fit 16 bits of 2^-30). Only this message renews the lease.
    (0x11, "SUN", CLUSTER, "Iiiihhh", "time_s east north up east_rate north_rate up_rate", ""),
    # The sender's session: its epoch, which increases with every start; the upper bits of its
    # sequence number; and the token of the authority that commands through it (0: none).
    (0x12, "SESSION", CLUSTER, "IHI", "epoch rollover token", ""),
    # Take the beam off the receiver, now.
    (0x20, "DEFOCUS", ANYONE, "", "", "manual"),
    # Go to the stow position: one heliostat, or all by broadcast.
    (0x21, "STOW", ANYONE, "", "", "manual"),
    # Leave stow for standby by the safe path.
    (0x30, "APPROACH", AUTHORITY, "", "", "operator moves standby automatic sliced"),
    # Hold position, ready.
    (0x31, "IDLE", AUTHORITY, "", "", "operator moves standby manual"),
    # Track the sun onto the aim.
    (0x32, "TRACK", AUTHORITY, "", "", "operator moves joins automatic"),
    # Return from defocus to the aim.
    (0x33, "REFOCUS", AUTHORITY, "", "", "operator moves joins automatic"),
    # Remove a lock.
    (0x34, "UNLOCK", AUTHORITY, "", "", "operator releases stands"),
    # Leave FAULT once its cause has gone.
    (0x35, "CLEAR_FAULT", AUTHORITY, "", "", "releases stands"),
    # Stop and hold position.
    (0x36, "LOCK", AUTHORITY, "", "", "operator harmless stops stands manual"),
    # Aim point of the beam, ENU.
    (0x40, "AIM", AUTHORITY, "fff", "east_m north_m up_m", "operator point"),
    # Hold the aim against changes.
    (0x41, "LOCK_AIM", AUTHORITY, "B", "locked", "operator harmless setting"),
    # Move one axis by hand: up and down, east and west.
    (0x42, "JOG", AUTHORITY, "Bi", "axis steps", "moves counts stands relative manual"),
    # Move to step counts.
    (0x43, "GOTO", AUTHORITY, "ii", "primary secondary", "moves counts stands again manual"),
    # Rough (1) or fine (0) stepping: by full motor steps if SET_STEPPING has specified them, else
    # by 16 steps at a time.
    (0x44, "ROUGH", AUTHORITY, "B", "rough", "harmless setting"),
    # Move the beam in a spiral about its aim until the target's camera finds it.
    (0x45, "SEARCH", AUTHORITY, "ff", "pitch_rad radius_rad", "operator moves joins again manual"),
    # Move a little and back, and check whether the mirror moved.
    (0x46, "DIAGNOSE", AUTHORITY, "", "", "moves counts stands again manual"),
    # Standby point beside the receiver, ENU.
    (0x47, "STANDBY", AUTHORITY, "fff", "east_m north_m up_m", "operator point stored"),
    # Axes, origins, vertex and normal of the calibrated heliostat, in place of a matrix.
    (0x50, "SET_ARMATURE", KEY, "18d", "numbers", ""),
    # Conversion of steps to angles.
    (0x51, "SET_DRIVES", KEY, "BB10d", "axis kind numbers", ""),
    # Biases of the angles.
    (0x52, "SET_BIAS", KEY, "ff", "primary_rad secondary_rad", ""),
    # The heliostat's location, ENU.
    (0x53, "SET_POSITION", KEY, "ddd", "east_m north_m up_m", ""),
    # Address on the bus.
    (0x54, "SET_ADDRESS", KEY, "IH", "serial address", ""),
    # Declare the present step counts.
    (0x55, "ZERO", KEY, "ii", "primary secondary", "stands"),
    # Step counts of the stow position.
    (0x56, "SET_STOW", KEY, "ii", "primary secondary", ""),
    # Range, rate and backlash of an axis.
    (0x57, "SET_LIMITS", KEY, "BiiIIH",
     "axis low high rate_steps_per_s acceleration_steps_per_s2 backlash", ""),
    # Angles by which the axes turn when defocused.
    (0x58, "SET_DEFOCUS", KEY, "ff", "primary_rad secondary_rad", ""),
    # The safe path from stow: the axis (0 or 1) that moves first when leaving and last when
    # returning, the number of points (0: the path is found without them), and the points that the
    # beam passes on its way from the ground to the standby point, ENU.
    (0x59, "SET_WAY", KEY, "BB12f", "azimuth_axis points path_m", ""),
    # Microsteps per full step of each motor, and whether the drivers rest (0, 1). If they do,
    # stepping is rough from the start, motions that track the sun end on full steps, and the
    # drivers are off in between.
    (0x5A, "SET_STEPPING", KEY, "HHB", "microsteps_primary microsteps_secondary rests", ""),
    # Bus key, encrypted under the key of the local controller; it needs no session and no clock.
    # Sending the present key again ends the previous one; zeros end both.
    (0x5B, "SET_BUS_KEY", KEY, "4I", "key", ""),
)  # fmt: skip


def having(trait: str) -> "frozenset[str]":
    """Return the names of the messages that have a trait."""
    return frozenset([row[1] for row in MESSAGES if trait in row[5].split()])


#: Commands that anyone may send at any time.
SAFE = frozenset([row[1] for row in MESSAGES if row[2] == ANYONE])
#: Commands that need the command authority.
ORDERS = frozenset([row[1] for row in MESSAGES if row[2] in (AUTHORITY, KEY)])
MOTIONS = having("moves")
JOINING = having("joins")
TO_STANDBY = having("standby")
BY_COUNTS = having("counts")
SLICED = having("sliced")
RELEASES = having("releases")
STANDS = having("stands")
POINTS = having("point")
SETTINGS = having("setting")
HARMLESS = having("harmless")
STOPS = having("stops")
BY_OPERATORS = having("operator")

NUMBER_OF = {row[1]: row[0] for row in MESSAGES}
ROW_OF = {row[0]: row for row in MESSAGES}

#: The part of the table that a board needs, as text: number (two hexadecimal digits), who, name,
#: codes with those of the head. ``scripts/shrink.py`` leaves the rest out there.
TABLE = "\n" + "".join(
    [
        f"{row[0]:02x}{row[2]}{row[1]} {HEADS[row[2]][0] if row[2] in HEADS else ''}{row[3]}\n"
        for row in MESSAGES
    ]
)


def _start(number: int) -> int:
    return TABLE.find(f"\n{number:02x}")


def name_of(number: int) -> str:
    """Return the name of a message number; empty if the table has no such number."""
    start = _start(number)
    return TABLE[start + 4 : TABLE.find(" ", start)] if start >= 0 else ""


def who_of(number: int) -> int:
    """Return who may send a message; -1 if the table has no such number."""
    start = _start(number)
    return int(TABLE[start + 3]) if start >= 0 else -1


def codes_of(number: int) -> str:
    """Return the ``struct`` codes of a message's payload with head, without byte order.

    Raises
    ------
    KeyError
        If the table has no such number.
    """
    start = _start(number)
    if start < 0:
        raise KeyError(number)
    return TABLE[TABLE.find(" ", start) + 1 : TABLE.find("\n", start + 1)]


def fields_of(number: int) -> list[str]:
    """Return the names of a message's fields, including the fields of its head."""
    row = ROW_OF[number]
    head = HEADS[row[2]][1] if row[2] in HEADS else ""
    return (head + " " + row[4]).split()


#: Result codes in ACK.
(
    DONE,
    REFUSED_STATE,
    REFUSED_AUTHORITY,
    REFUSED_KEY,
    EXPIRED,
    DUPLICATE,
    BAD_VALUE,
    BUSY,
    NOT_STORED,
    REFUSED_SWITCH,
) = range(10)
RESULTS = (
    "done",
    "not in this state",
    "not the authority",
    "wrong key",
    "expired",
    "duplicate",
    "value out of range",
    "busy",
    "flash failed",
    "drives switched off at the mirror",
)
