"""All kinds of refusal by the plant, as data: circumstances, text and remedy.

`docs/reference/alarms.md` lists them. The code that refuses fills in the text:
``ROLE_TOO_LOW.error(what="TRACK", ...)``.

::

    HeliotropeError
    └── RefusedError          a command that is not accepted; nothing was sent
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from heliotrope.errors import HeliotropeError, once

#: Number of heliostats with the same reason that are named; beyond it, their number is stated.
_NAMED = 3


class RefusedError(HeliotropeError):
    """A command is not accepted; nothing was sent and nothing moves."""


class NoFreePath(str):
    """The reason why the path of a beam is not clear; it depends on sun, aim and volumes.

    Reasons of other kinds end by themselves, or have alarms of their own.
    """

    __slots__ = ()


def by_reason(reasons: Mapping[str, str], most: int = 3) -> str:
    """Return the heliostats' reasons in one line, each once with its number of heliostats.

    Parameters
    ----------
    reasons
        Reasons by heliostat.
    most
        Number of reasons written out, starting with the most frequent.
    """
    groups: dict[str, list[str]] = {}
    for name, text in reasons.items():
        groups.setdefault(text, []).append(name)
    ordered = sorted(groups.items(), key=lambda group: -len(group[1]))
    parts = [f"{_several(names)}: {text}" for text, names in ordered[:most]]
    if left := sum(len(names) for _, names in ordered[most:]):
        parts.append(f"{left} more refused for other reasons")
    return "; ".join(parts)


def _several(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= _NAMED else f"{len(names):,} heliostats"


@dataclass(frozen=True)
class Refusal:
    """A kind of refusal.

    Attributes
    ----------
    name
        Unique.
    meaning
        Circumstances in which a command is refused.
    text
        Display text, with fields to fill in.
    remedy
        What to do, in one sentence.
    """

    name: str
    meaning: str
    text: str
    remedy: str

    def error(self, **fields: object) -> RefusedError:
        """Return the error to raise; ``fields`` complete its text."""
        return RefusedError(once(self.text.format(**fields)))


ROLE_TOO_LOW = Refusal(
    "role too low",
    "The user's role does not allow the command.",
    "{what}: {person} is {role}, but the command needs {needed}",
    "Ask a user with that role. DEFOCUS, STOW and EMERGENCY need no role.",
)
NO_AUTHORITY = Refusal(
    "no command authority",
    "Nobody has the command authority, or it has expired.",
    "command authority: nobody has it, so {person} must take command first",
    "Take command, then repeat the command.",
)
OTHER_AUTHORITY = Refusal(
    "command authority held by another user",
    "Another user has the command authority, or the token belongs to an earlier grant.",
    "command authority: {holder} has it, so the order of {person} was not sent; take command first",
    "Ask the holder to release it, or break it and state a reason.",
)
AUTHORITY_HELD = Refusal(
    "command authority held",
    "A user takes the command authority while another user holds it.",
    "command authority: {holder} has it and renewed it {age:.0f} s ago; ask the holder to release "
    "it, or break it",
    "Ask the holder to release it, or break it and state a reason.",
)
HOLDER_OUTRANKS = Refusal(
    "holder's role higher",
    "A user tries to break the command authority of a holder with a higher role.",
    "command authority: {holder} has it as {holder_role}, so {person} as {role} cannot break it; "
    "DEFOCUS and STOW need no authority",
    "Ask the holder. Anyone can still order DEFOCUS, STOW and EMERGENCY.",
)
REASON_MISSING = Refusal(
    "reason missing",
    "A command that needs a reason for the audit log was sent without one.",
    "{what}: a reason is needed; enter one",
    "Enter a reason.",
)
SECOND_PERSON = Refusal(
    "second engineer needed",
    "The author of a change tries to approve or refuse it.",
    "change {number}, {subject}: {person} requested it, so another engineer must decide",
    "Ask another engineer with an account of their own, or withdraw the change.",
)
NOT_AUTHOR = Refusal(
    "not the author",
    "A user tries to withdraw a change that another user requested.",
    "change {number}, {subject}: {author} requested it, so {person} can only refuse it",
    "Refuse it with a reason, or ask its author to withdraw it.",
)
CHANGE_WAITS = Refusal(
    "change waits",
    "Another change of the same heliostat's parameters, or of the plant file, is waiting for "
    "approval.",
    "{subject}: change {number} of {author} is waiting for approval, so no new change "
    "was requested",
    "Have that change approved, refused or withdrawn first.",
)
CHANGE_OVERTAKEN = Refusal(
    "change overtaken",
    "The time limit for approval has passed, or the heliostat has received new parameters since.",
    "change {number}, {subject}: {reason}, so it is no longer valid",
    "Compare the versions, and request the change again if it is still right.",
)
NOT_NOW = Refusal(
    "not accepted now",
    "An emergency is active, a condition of the safety table blocks new motions, or a second plant "
    "is running.",
    "{what}: not accepted now: {reason}",
    "Look up the alarm named in the text. LOCK, DEFOCUS and STOW are still accepted.",
)
NOT_RECORDED = Refusal(
    "not recorded",
    "The audit log cannot record the command.",
    "{what}: not accepted, because it cannot be recorded: {problem}",
    "Check the disk or the database. DEFOCUS and STOW are still sent.",
)
BEAM_REFUSED = Refusal(
    "beam",
    "A beam cannot reach the point, or it would enter a keep-out volume, dazzle an observer, "
    "or cross a receiver on its way from stow.",
    "{what} {heliostat}{more}: {reason}",
    "Choose another point, or leave out the heliostat named in the text.",
)
OUT_OF_SERVICE = Refusal(
    "out of service",
    "The heliostat is out of service, and the command would move it.",
    "{what} {heliostat}{more}: {reason}",
    "Each owner makes sure that nobody is at the heliostat, then returns their lock. DEFOCUS and "
    "STOW are still sent.",
)
NOT_OWNER = Refusal(
    "not the owner",
    "A user tries to return a lock that belongs to someone else.",
    "{what}: {who} has no lock on {name}, which others have locked: {text}",
    "Each owner returns their own lock; an engineer can remove another owner's lock by naming the "
    "owner.",
)
NOT_CALLER = Refusal(
    "not the one who ordered it",
    "A user tries to withdraw an emergency order, but has no active order.",
    "withdraw: {who} has no active emergency order; {calls}",
    "Each user withdraws their own order; an engineer can withdraw another user's order by name. "
    "Once every order is withdrawn, acknowledge `operator_emergency`.",
)
EMERGENCY_GOES_ON = Refusal(
    "emergency still active",
    "An operator presses Resume while an emergency order is active, or while a safety condition "
    "still requires the emergency.",
    "resume: the emergency is still active: {causes}",
    "Withdraw the order; remove the cause of each condition named in the text, and acknowledge the "
    "condition.",
)
EMERGENCY_PAUSED = Refusal(
    "emergency paused",
    "A user's emergency order was withdrawn while it was being repeated, or others withdrew it "
    "five times within ten minutes. Only that user has to wait: 30 s, then twice as long each "
    "time.",
    "EMERGENCY: the order of {who} was withdrawn repeatedly; the next order is accepted in {wait} "
    "s",
    "Let another user order it; only this user has to wait. If a program repeats the order, "
    "disable its account or revoke its token.",
)
NOT_ACKNOWLEDGED = Refusal(
    "not acknowledged",
    "The condition is not tripped, its cause is not gone, or acknowledging it needs another role.",
    "{reason}",
    "Remove the cause named in the text, then acknowledge again.",
)
ONE_HELIOSTAT = Refusal(
    "one heliostat",
    "A command whose values apply to one heliostat only was sent to several.",
    "{what}: got {count} heliostats, but step counts differ between heliostats; specify one "
    "heliostat",
    "Repeat the command for each heliostat.",
)
NO_POSITION = Refusal(
    "no known position to lock",
    "LOCK POSITION is ordered for a heliostat whose mirror may not be at the step counts of "
    "its aim.",
    "LOCK POSITION: {heliostat}: {why}",
    "Bring the beam to its aim with JOG, lock the heliostat, and repeat the command; if its step "
    "counts are lost, set them with ZERO first.",
)
IN_VISIT = Refusal(
    "in a visit",
    "The stepping mode (ROUGH) or the aim lock would change during a measurement.",
    "it is on a calibration visit to {where}; repeat the command when the visit has ended",
    "Wait until the page *Calibration* no longer shows the visit. The command was sent to the "
    "other heliostats.",
)
NO_CALIBRATION = Refusal(
    "no calibration now",
    "A calibration is requested that automatic control cannot carry out now.",
    "calibration of {heliostat}: {why}",
    "Give the heliostat to automatic control (*Automatic*), release the command authority, switch "
    "calibration on, or wait for the sun, as the text says; then repeat the command.",
)
PARAMETERS_DIFFER = Refusal(
    "parameters differ",
    "A motion is ordered for a heliostat whose stored parameters differ from the intended ones.",
    "its stored parameters differ from the intended ones ({items})",
    "Stow the heliostat; the intended parameters are then written. If the text names more than "
    "armature, biases, location and defocus, lock it at stow.",
)
NOT_COMPARED = Refusal(
    "not compared",
    "A motion is ordered for a heliostat whose stored parameters have not been compared with "
    "the intended ones since its cluster connected.",
    "its stored parameters have not been compared with the intended ones yet",
    "Wait a few seconds; a lost reply is requested again after 30 s. If the refusal persists, "
    "check its cluster and its supply. DEFOCUS and STOW are still sent.",
)
OTHER_PARAMETERS = Refusal(
    "other parameters",
    "A command would move or unlock a heliostat or write its parameters, but another heliostat "
    "replies at its address.",
    "the board at its address holds the parameters of {other}",
    "Correct the addresses of both. LOCK, DEFOCUS and STOW are still sent.",
)
UNLISTED = Refusal(
    "unlisted",
    "A command would move or unlock a heliostat or write its parameters, but its cluster does not "
    "list it.",
    "its cluster {cluster} does not list it",
    "Add it to the cluster's file and restart the cluster. EMERGENCY reaches it until then.",
)
NOT_HEARD = Refusal(
    "not heard",
    "A command would move or unlock a heliostat or write its parameters before its board is "
    "identified.",
    "it has sent nothing since its cluster connected, so its board is not identified",
    "Wait for its next status, which takes a second at most. If none arrives, check its cluster "
    "and its supply.",
)
COUNTS_DOUBTFUL = Refusal(
    "counts doubtful",
    "A heliostat that lost power while moving is sent to the receiver.",
    "its step counts may be wrong since a power cut during motion, and nobody has confirmed them",
    "Check where its mirror points, then acknowledge the alarm `counts_doubtful`; or calibrate the "
    "heliostat.",
)
DRIVE_STALLED = Refusal(
    "drive stalled",
    "A heliostat whose mirror did not follow its drives is sent to the receiver.",
    "its drives made steps, but its mirror did not follow, so its step counts are wrong",
    "Look for ice, a loose coupling or a driver without current; then order Diagnose again, or "
    "acknowledge the alarm `drive_stalled` once you have seen the mirror follow, and order ZERO.",
)
NOT_VERIFIED = Refusal(
    "not verified",
    "A heliostat is sent to the receiver while a calibration is verifying its new parameters.",
    "a calibration has yet to verify its new parameters by a photograph; wait until it has ended",
    "Wait until the visit has ended; DEFOCUS, STOW and LOCK end it at once.",
)
AIM_NOT_TAKEN = Refusal(
    "aim not accepted",
    "A heliostat is sent to its aim, but its local controller did not accept the latest aim.",
    "its latest aim was not accepted ({reason}), so its beam would go to an earlier aim",
    "Send the aim again.",
)
STANDBY_NOT_TAKEN = Refusal(
    "standby point not accepted",
    "A heliostat is sent to standby, but the standby point in its local controller is unknown "
    "because the plant's store was restored from a backup, or because the controller did not "
    "accept the first one.",
    "its standby point was not accepted ({reason}), so its beam would go to an unknown point",
    "Send the standby point again; automatic control does so by itself.",
)
PLACE_UNKNOWN = Refusal(
    "place unknown",
    "Where there are keep-out volumes: a heliostat is ordered to standby, moved by step counts "
    "(JOG, GOTO, DIAGNOSE) or assigned a standby point, but has not reported since the last order "
    "that moved it; or it is sent to its aim but has not reported since its DEFOCUS or STOW; or it "
    "is silent.",
    "no report shows where it is now, so its path cannot be checked",
    "Try again in two seconds; if it stays silent, check its cluster and its supply. DEFOCUS "
    "and STOW are accepted immediately.",
)
STILL_MOVING = Refusal(
    "still moving",
    "Where there are keep-out volumes: a moving heliostat is ordered to standby, or assigned "
    "another standby point while it is moving there.",
    "it is still moving, so its path to standby cannot be checked",
    "Wait until it has stopped, then repeat the order. DEFOCUS and STOW are accepted immediately.",
)
SEEN_ASTRAY = Refusal(
    "pointing error seen from the air",
    "A heliostat is sent to the receiver although a drone flight measured its mirror far from "
    "where its parameters place it.",
    "a drone flight measured its mirror far from where its parameters place it, and no photograph "
    "has confirmed or refuted this yet",
    "Let automatic control calibrate it; it goes to a target before all other heliostats.",
)
UNWITNESSED = Refusal(
    "sun not witnessed",
    "A heliostat is sent to the receiver or raised from stow while an independent witness "
    "contradicts the sun position of the plant and the clusters; or it is sent to the receiver, "
    "and none of the required witnesses has confirmed the sun position today.",
    "no independent witness confirms this plant's sun position: {problem}",
    "Follow the alarm `sun_contradicted` or `unwitnessed`. Raised heliostats may still go to "
    "targets.",
)
PARAMETERS_NOT_HERE = Refusal(
    "parameters not in this position",
    "Parameters that change the pose are sent where the beam would move or its path is not known "
    "to be free.",
    "PARAMETERS {heliostat}: {reason}; stow it first",
    "Stow the heliostat, or lock it at standby, then send the parameters again.",
)
STOW_UNPROVEN = Refusal(
    "stow unproven",
    "A stow position is set from which the beam would illuminate something at some time of the "
    "year.",
    "PARAMETERS {heliostat}: {reason}",
    "Choose a stow position that `heliotrope field check` accepts, such as a mirror that faces the "
    "horizon away from the tower.",
)
CHANGE_TOO_LARGE = Refusal(
    "change too large",
    "Parameters would move the beam by more than the limit, and the change is not confirmed.",
    "PARAMETERS {heliostat}: they would move its beam by {change:.1f} mrad, the limit is "
    "{limit:.1f}; check that they belong to this heliostat, then confirm with a reason",
    "Check that the parameters belong to this heliostat. If they do, confirm the change with a "
    "reason.",
)
NO_ANSWER = Refusal(
    "no answer",
    "A local controller does not report its stored parameters.",
    "{heliostat}: its stored parameters cannot be read: {problem}",
    "Check that the heliostat is live, and try again.",
)
BUS_NOT_RECORDED = Refusal(
    "bus not recorded",
    "A cluster does not record the frames of its bus.",
    "cluster {cluster}: the frames of its bus were not recorded: {problem}",
    "Check that the cluster is connected and that nobody else is recording, then try again.",
)
FLIGHT_KNOWN = Refusal(
    "flight already imported",
    "The plant has already imported a flight of that name.",
    "flight {name}: {person} imported it on {at}, so its orientations are already in use",
    "Import another flight; evaluating the same photographs again is not a new measurement.",
)
FLIGHT_CONTRADICTS = Refusal(
    "flight contradicts the field",
    "Most mirrors in a flight cannot have the orientations that the flight reports.",
    "flight {name}: {wrong} of {all} mirrors cannot have the reported orientation, first {first}; "
    "nothing was imported",
    "Check that the flight is of this field, and check its times, its step counts and the RTK base "
    "position.",
)
FLIGHT_BUSY = Refusal(
    "another flight is being evaluated",
    "The plant evaluates one flight at a time.",
    "flight {name}: the plant is still evaluating flight {other}",
    "Import it again in a minute.",
)

#: Reasons that end by themselves within seconds.
SOON = frozenset(kind.text for kind in (NOT_HEARD, NOT_COMPARED, PLACE_UNKNOWN, STILL_MOVING))

#: All kinds of refusal, in the order of the reference.
KINDS: tuple[Refusal, ...] = tuple(
    kind for kind in tuple(globals().values()) if isinstance(kind, Refusal)
)
