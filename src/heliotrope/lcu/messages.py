"""All messages of the wire, version 2: one table.

A row: number, name, payload as (field, struct code, unit), who may send it, meaning.
Numbers are little-endian. Codes are those of ``struct``; ``s`` alone is a rest of bytes.

Who may send a message:

ANYONE     taken from everybody at any time: what makes the field safe
AUTHORITY  moves the mirror: needs the command authority's token, and expires
KEY        changes what is stored: needs a truncated HMAC, and authority
CLUSTER    from the cluster controller, every second or so
NODE       an answer of a local controller
"""

ANYONE, AUTHORITY, KEY, CLUSTER, NODE = 0, 1, 2, 3, 4

#: Every command that moves carries this head: the authority's token, and the time (s of GPS
#: week time, of the cluster's clock) after which it is void.
HEAD = (("token", "I", ""), ("expires_s", "I", "s"))

MESSAGES = (
    # Questions and answers.
    (0x01, "QUERY_STEPS", (), CLUSTER, "ask for step counts"),
    (0x02, "STEPS", (("primary", "i", "steps"), ("secondary", "i", "steps"),
                     ("primary_goal", "i", "steps"), ("secondary_goal", "i", "steps")),
     NODE, "step counts and where they are going"),
    (0x03, "QUERY_STATUS", (), CLUSTER, "ask for state and flags"),
    (0x04, "STATUS", (("state", "B", ""), ("flags", "I", ""), ("fault", "B", ""),
                      ("uptime_s", "I", "s"), ("sun_age_ms", "I", "ms"),
                      ("supply_mv", "H", "mV"), ("temperature_c", "b", "°C"),
                      ("armature_crc", "I", ""), ("boots", "H", "")),
     NODE, "state, flags and health"),
    (0x05, "QUERY_POSITION", (), CLUSTER, "ask where the heliostat stands"),
    (0x06, "POSITION", (("east", "f", "m"), ("north", "f", "m"), ("up", "f", "m")),
     NODE, "where the heliostat stands, ENU"),
    (0x07, "QUERY_DIAGNOSIS", (), CLUSTER, "ask for the last movement diagnosis"),
    (0x08, "DIAGNOSIS", (("result", "B", ""), ("moved_primary", "i", "steps"),
                         ("moved_secondary", "i", "steps"), ("tilt_x", "f", "rad"),
                         ("tilt_y", "f", "rad")),
     NODE, "whether the mirror moved as ordered, by accelerometer or limit switch"),
    (0x09, "QUERY_STORED", (("item", "B", ""),), CLUSTER, "ask for a stored record"),
    (0x0A, "STORED", (("item", "B", ""), ("data", "s", "")), NODE, "a stored record"),
    (0x0B, "DISCOVER", (("low", "I", ""), ("high", "I", "")), CLUSTER,
     "ask all whose serial number lies between to answer, in slots drawn by chance"),
    (0x0C, "HERE", (("serial", "I", ""), ("firmware", "H", ""), ("address", "H", "")),
     NODE, "serial number, firmware and address"),
    (0x0D, "ACK", (("sequence_of", "H", ""), ("type_of", "B", ""), ("result", "B", "")),
     NODE, "what became of a command"),
    # Time and sun.
    (0x10, "TIME", (("week", "H", ""), ("time_of_week_ms", "I", "ms"), ("quality", "B", "")),
     CLUSTER, "GPS time"),
    (0x11, "SUN", (("time_s", "I", "s"), ("east", "i", "2^-30"), ("north", "i", "2^-30"),
                   ("up", "i", "2^-30"), ("east_rate", "h", "2^-30/s"),
                   ("north_rate", "h", "2^-30/s"), ("up_rate", "h", "2^-30/s")),
     CLUSTER, "unit vector to the sun and its rate; the only thing that renews the lease"),
    # What makes the field safe: from anyone, always.
    (0x20, "DEFOCUS", (), ANYONE, "beams off the receiver, now"),
    (0x21, "STOW", (), ANYONE, "go to the stow position"),
    (0x22, "LOCK", (), ANYONE, "stop and hold position"),
    # System states.
    (0x30, "APPROACH", HEAD, AUTHORITY, "leave stow for standby by the safe way"),
    (0x31, "IDLE", HEAD, AUTHORITY, "hold position, ready"),
    (0x32, "TRACK", HEAD, AUTHORITY, "track the sun onto the aim"),
    (0x33, "REFOCUS", HEAD, AUTHORITY, "back from defocus to the aim"),
    (0x34, "UNLOCK", HEAD, AUTHORITY, "release a lock"),
    (0x35, "CLEAR_FAULT", HEAD, AUTHORITY, "leave FAULT for IDLE, the cause being gone"),
    # Aim and motion.
    (0x40, "AIM", HEAD + (("east", "f", "m"), ("north", "f", "m"), ("up", "f", "m")),
     AUTHORITY, "point to send the beam to, ENU"),
    (0x41, "LOCK_AIM", HEAD + (("locked", "B", ""),), AUTHORITY, "hold the aim against changes"),
    (0x42, "JOG", HEAD + (("axis", "B", ""), ("steps", "i", "steps")), AUTHORITY,
     "move one axis by hand: up and down, east and west"),
    (0x43, "GOTO", HEAD + (("primary", "i", "steps"), ("secondary", "i", "steps")), AUTHORITY,
     "move to step counts"),
    (0x44, "ROUGH", HEAD + (("rough", "B", ""),), AUTHORITY, "rough or fine stepping"),
    (0x45, "SEARCH", HEAD + (("pitch", "f", "rad"), ("radius", "f", "rad")), AUTHORITY,
     "move the beam in a spiral about its aim, to be found by the target's camera"),
    (0x46, "DIAGNOSE", HEAD, AUTHORITY, "move a little and back, and see whether it moved"),
    (0x47, "STANDBY", HEAD + (("east", "f", "m"), ("north", "f", "m"), ("up", "f", "m")),
     AUTHORITY, "standby point beside the receiver, ENU"),
    # What is stored.
    (0x50, "SET_ARMATURE", (("numbers", "18d", ""),), KEY,
     "axes, origins, vertex and normal of the calibrated heliostat, in place of a matrix"),
    (0x51, "SET_DRIVES", (("axis", "B", ""), ("kind", "B", ""), ("numbers", "10d", "")), KEY,
     "how steps become angles"),
    (0x52, "SET_BIAS", (("primary", "f", "rad"), ("secondary", "f", "rad")), KEY,
     "biases of the angles"),
    (0x53, "SET_POSITION", (("east", "d", "m"), ("north", "d", "m"), ("up", "d", "m")), KEY,
     "where the heliostat stands, ENU"),
    (0x54, "SET_ADDRESS", (("serial", "I", ""), ("address", "H", "")), KEY, "address on the bus"),
    (0x55, "ZERO", (("primary", "i", "steps"), ("secondary", "i", "steps")), KEY,
     "declare the present step counts"),
    (0x56, "SET_STOW", (("primary", "i", "steps"), ("secondary", "i", "steps")), KEY,
     "step counts of the stow position"),
    (0x57, "SET_LIMITS", (("axis", "B", ""), ("low", "i", "steps"), ("high", "i", "steps"),
                          ("rate", "I", "steps/s"), ("acceleration", "I", "steps/s²"),
                          ("backlash", "H", "steps")), KEY, "range, rate and backlash of an axis"),
    (0x58, "SET_DEFOCUS", (("primary", "f", "rad"), ("secondary", "f", "rad")), KEY,
     "how far angles go when defocused"),
)  # fmt: skip

NUMBER_OF = {row[1]: row[0] for row in MESSAGES}
ROW_OF = {row[0]: row for row in MESSAGES}

#: Results in ACK.
DONE, REFUSED_STATE, REFUSED_AUTHORITY, REFUSED_KEY, EXPIRED, DUPLICATE, BAD_VALUE, BUSY = range(8)
RESULTS = ("done", "not in this state", "not the authority", "wrong key", "expired",
           "duplicate", "value out of range", "busy")  # fmt: skip
