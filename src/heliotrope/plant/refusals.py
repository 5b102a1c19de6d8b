"""Every kind of refusal by the plant, as data: when, text and remedy.

`docs/reference/alarms.md` lists them. The code that refuses fills in the text:
``ROLE_TOO_LOW.error(what="TRACK", ...)``.

::

    HeliotropeError
    └── RefusedError          a command that is not accepted; nothing was sent
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from heliotrope.errors import HeliotropeError, once

#: Heliostats with one reason that are named; of more, their number is.
_NAMED = 3


class RefusedError(HeliotropeError):
    """A command that is not accepted; nothing was sent and nothing moves."""


class NoFreePath(str):
    """The reason why the path of a beam is not free: that changes with the sun, aim or volumes.

    Other reasons end by themselves, or have alarms of their own.
    """

    __slots__ = ()


def by_reason(reasons: Mapping[str, str], most: int = 3) -> str:
    """Return the reasons of heliostats in one line, each once, with the number that it stops.

    Parameters
    ----------
    reasons
        By heliostat.
    most
        Reasons that are written out, those of most heliostats first.
    """
    groups: dict[str, list[str]] = {}
    for name, text in reasons.items():
        groups.setdefault(text, []).append(name)
    ordered = sorted(groups.items(), key=lambda group: -len(group[1]))
    parts = [f"{_several(names)}: {text}" for text, names in ordered[:most]]
    if left := sum(len(names) for _, names in ordered[most:]):
        parts.append(f"{left} more for other reasons")
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
        What to do: one sentence.
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
    "The person's role does not allow it.",
    "{what}: {person} is {role}; it needs {needed}",
    "Ask a person with that role. DEFOCUS, STOW and EMERGENCY need none.",
)
NO_AUTHORITY = Refusal(
    "no command authority",
    "Nobody has the command authority, or it has expired.",
    "command authority: nobody has it; {person} must take command first",
    "Take command, then give the command again.",
)
OTHER_AUTHORITY = Refusal(
    "another's command authority",
    "Another person has the command authority, or the token is of an earlier grant.",
    "command authority: {holder} has it, so nothing was sent for {person}; take command first",
    "Ask the holder to give it back, or break it with a reason.",
)
AUTHORITY_HELD = Refusal(
    "command authority held",
    "A person takes the command authority while another holds it.",
    "command authority: {holder} has it and renewed it {age:.0f} s ago; ask for it, or break it",
    "Ask the holder to give it back, or break it with a reason.",
)
HOLDER_OUTRANKS = Refusal(
    "holder's role higher",
    "A person breaks the command authority of a holder with a higher role.",
    "command authority: {holder} has it as {holder_role}; {person} as {role} cannot break it; "
    "DEFOCUS and STOW need no authority",
    "Ask the holder. DEFOCUS, STOW and EMERGENCY remain open to everybody.",
)
REASON_MISSING = Refusal(
    "reason missing",
    "A command that needs a reason for the audit was given without one.",
    "{what}: a reason is needed; give one",
    "Give a reason.",
)
SECOND_PERSON = Refusal(
    "second person needed",
    "The author of a change approves or refuses it.",
    "change {number} of {heliostat}: {person} asked for it, so another engineer must decide",
    "Ask another engineer with an account of their own, or withdraw the change.",
)
NOT_AUTHOR = Refusal(
    "not the author",
    "A person withdraws a change that another has asked for.",
    "change {number} of {heliostat}: {author} asked for it; {person} can refuse it",
    "Refuse it with a reason, or ask its author.",
)
CHANGE_WAITS = Refusal(
    "change waits",
    "Another change of the same heliostat's parameters waits for its approval.",
    "parameters {heliostat}: change {number} of {author} waits for approval; nothing was asked for",
    "Have it approved or refused first, or let its author withdraw it.",
)
CHANGE_OVERTAKEN = Refusal(
    "change overtaken",
    "The time of the change was over, or the heliostat has had new parameters since.",
    "change {number} of {heliostat}: {reason}; it has ended",
    "Compare the versions, and ask for the change again if it is still right.",
)
NOT_NOW = Refusal(
    "not accepted now",
    "An emergency holds, a row of the safety table refuses new motions, or a second plant runs.",
    "{what}: not accepted now: {reason}",
    "Look up the alarm that the text names. LOCK, DEFOCUS and STOW are still accepted.",
)
NOT_RECORDED = Refusal(
    "not recorded",
    "The audit cannot write the record of the command.",
    "{what}: not accepted, because it cannot be recorded: {problem}",
    "Check the disk or the database. DEFOCUS and STOW are sent all the same.",
)
BEAM_REFUSED = Refusal(
    "beam",
    "A beam would enter a keep-out volume, shine into an eye, cross a receiver on its way from "
    "stow, or it cannot reach the point.",
    "{what} {heliostat}{more}: {reason}",
    "Choose another point, or leave out the heliostat that the text names.",
)
OUT_OF_SERVICE = Refusal(
    "out of service",
    "The heliostat is out of service, and the command would move it.",
    "{what} {heliostat}{more}: {reason}",
    "Each owner makes sure that nobody is there, then returns their lock. DEFOCUS and STOW pass.",
)
NOT_OWNER = Refusal(
    "not the owner",
    "A person gives back what only others have locked.",
    "{what}: {who} has no lock on {name}, which is locked: {text}",
    "Each person returns their own lock; an engineer may remove another's by the owner's name.",
)
NOT_CALLER = Refusal(
    "not the caller",
    "A person withdraws an emergency order of theirs, and none stands.",
    "withdraw: no emergency order of {who} stands; {calls}",
    "Each person withdraws their own order; an engineer withdraws another's by the owner's name. "
    "Once every order is withdrawn, acknowledge `operator_emergency`.",
)
EMERGENCY_GOES_ON = Refusal(
    "emergency goes on",
    "A person resumes while an order of an emergency stands, or a row demands it.",
    "resume: the emergency goes on: {causes}",
    "Withdraw the order; remove the cause of each row that the text names, and acknowledge it.",
)
EMERGENCY_PAUSED = Refusal(
    "emergency paused",
    "A person's emergency order was withdrawn while it was being repeated, or five times "
    "by others within ten minutes. That person alone pauses: 30 s, then twice as long each time.",
    "EMERGENCY: that of {who} was withdrawn again and again; the next one is taken in {wait} s",
    "Let another person order it: nobody else pauses. If a program repeats it, disable the account "
    "or revoke its token.",
)
NOT_ACKNOWLEDGED = Refusal(
    "not acknowledged",
    "The row is not tripped, its cause has not gone, or it needs another role.",
    "{reason}",
    "Remove the cause that the text names, then acknowledge again.",
)
ONE_HELIOSTAT = Refusal(
    "one heliostat",
    "A command whose values are true of one heliostat only is given to several.",
    "{what}: {count} heliostats; step counts differ from one to the next, give one heliostat",
    "Repeat the command for each heliostat.",
)
NO_POSITION = Refusal(
    "no position to lock",
    "LOCK POSITION is given where the counts of the aim cannot be the mirror's.",
    "LOCK POSITION: {heliostat}: {why}",
    "Bring the beam to its aim by JOG, lock the heliostat, and repeat the command; where its "
    "counts are lost, give it counts by ZERO first.",
)
IN_VISIT = Refusal(
    "in a visit",
    "Stepping (ROUGH) or the lock of the aim would change in the middle of a measurement.",
    "it is in a visit to {where}; give the command again when the visit has ended",
    "Wait until the page *Calibration* shows the visit no more. The other heliostats of the same "
    "command have got it.",
)
NO_CALIBRATION = Refusal(
    "no calibration now",
    "A heliostat is to be calibrated while automatic control cannot do it.",
    "calibration of {heliostat}: {why}",
    "Give the heliostat to automatic control (*Automatic*), release the command authority, switch "
    "calibration on, or wait for the sun, as the text says; then repeat the command.",
)
PARAMETERS_DIFFER = Refusal(
    "parameters differ",
    "A motion is given to a heliostat that stores parameters other than the wanted ones.",
    "it stores parameters that differ from the wanted ones ({items})",
    "Stow the heliostat: the wanted ones are written there. Lock it at stow if the text names more "
    "than armature, biases, location and defocus.",
)
NOT_COMPARED = Refusal(
    "not compared",
    "A motion is given to a heliostat whose stored parameters have not been compared with the "
    "wanted ones since its cluster connected.",
    "its stored parameters have not been compared with the wanted ones yet",
    "Wait some seconds; an answer that is lost is asked for again after 30 s. If it stays, see to "
    "its cluster or its supply. DEFOCUS and STOW are still sent.",
)
OTHER_PARAMETERS = Refusal(
    "other parameters",
    "A heliostat is moved, unlocked or written, and its address answers as another heliostat.",
    "its address answers with the parameters of {other}",
    "Correct the addresses of both. LOCK, DEFOCUS and STOW are still sent.",
)
UNLISTED = Refusal(
    "unlisted",
    "A heliostat is moved, unlocked or written, and its cluster does not list it.",
    "its cluster {cluster} does not list it",
    "Add it to the cluster's file and restart the cluster. EMERGENCY reaches it until then.",
)
NOT_HEARD = Refusal(
    "not heard",
    "A heliostat is moved, unlocked or written before its board is known.",
    "it has not been heard since its cluster connected, so its board is not known",
    "Wait for its next status, a second at most. If none comes, see to its cluster or its supply.",
)
COUNTS_DOUBTFUL = Refusal(
    "counts doubtful",
    "A heliostat that lost its power in motion is sent to the receiver.",
    "its step counts may be wrong since a power cut in motion, and nobody has confirmed them",
    "Look where its mirror stands, then acknowledge the alarm `counts_doubtful`; or calibrate it.",
)
DRIVE_STALLED = Refusal(
    "drive stalled",
    "A heliostat whose mirror did not follow its drives is sent to the receiver.",
    "its drives made steps, and its mirror did not follow, so its step counts are wrong",
    "Look for ice, a loose coupling or a driver without current; then give Diagnose again, or "
    "acknowledge the alarm `drive_stalled` once you have seen the mirror follow, and give ZERO.",
)
NOT_VERIFIED = Refusal(
    "not verified",
    "A heliostat is sent to the receiver while a calibration verifies its new parameters.",
    "a calibration has yet to verify its new parameters by a photograph",
    "Wait until the visit has ended; DEFOCUS, STOW and LOCK end it at once.",
)
AIM_NOT_TAKEN = Refusal(
    "aim not taken",
    "A heliostat is sent to its aim, and its local controller did not take the last one.",
    "its last aim was not taken ({reason}), so its beam would go to an earlier one",
    "Give the aim again.",
)
STANDBY_NOT_TAKEN = Refusal(
    "standby point not taken",
    "A heliostat is sent to standby, and no standby point is known that its local controller has: "
    "the plant's store was restored from a backup, or the first one was not taken.",
    "its standby point was not taken ({reason}), so its beam would go to an unknown one",
    "Give the standby point again; automatic control does so.",
)
PLACE_UNKNOWN = Refusal(
    "place unknown",
    "Where there are keep-out volumes: a heliostat is ordered to standby, moved by counts (JOG, "
    "GOTO, DIAGNOSE) or given a standby point, and has reported nothing since the last order "
    "that moved it; or is sent to its aim and has reported nothing since its DEFOCUS or STOW; or "
    "is silent.",
    "no report shows where it is now, so its path is not proven",
    "Try again in two seconds; if it stays silent, see to its cluster or its supply. DEFOCUS and "
    "STOW are accepted at once.",
)
STILL_MOVING = Refusal(
    "still moving",
    "Where there are keep-out volumes: a heliostat on its way is ordered to standby, or given "
    "another standby point on its way there.",
    "it is still moving, so its path to standby is not proven",
    "Wait until it stands, then order it again. DEFOCUS and STOW are accepted at once.",
)
SEEN_ASTRAY = Refusal(
    "seen astray from the air",
    "A heliostat is sent to the receiver that a flight of a drone sees far from where its "
    "parameters say.",
    "a flight sees it far from where its parameters say, and no photograph has settled that yet",
    "Let automatic control calibrate it: it goes to a target before all others.",
)
UNWITNESSED = Refusal(
    "sun not witnessed",
    "A heliostat is sent to the receiver, or up from stow, and an independent witness contradicts "
    "the sun of plant and clusters; or to the receiver, and none of those required has agreed "
    "today.",
    "no independent witness confirms the sun of this plant: {problem}",
    "Follow the alarm `sun_contradicted` or `unwitnessed`. Raised heliostats may go to targets.",
)
PARAMETERS_NOT_HERE = Refusal(
    "parameters not here",
    "Parameters that change a pose are given where the beam would move or is not proven free.",
    "PARAMETERS {heliostat}: {reason}; stow it first",
    "Stow the heliostat, or lock it at standby, then give the parameters again.",
)
STOW_UNPROVEN = Refusal(
    "stow unproven",
    "A stow position is given from which the beam would light something at some time of the year.",
    "PARAMETERS {heliostat}: {reason}",
    "Choose a stow position that `heliotrope field check` accepts; a mirror that looks to the "
    "horizon, away from the tower, is one.",
)
CHANGE_TOO_LARGE = Refusal(
    "change too large",
    "Parameters would move the beam by more than the limit, and the change is not confirmed.",
    "PARAMETERS {heliostat}: they would move its beam by {change:.1f} mrad, and {limit:.1f} are "
    "allowed; are they its own? Confirm with a reason",
    "Check that they belong to this heliostat. If so, confirm the change with a reason.",
)
NO_ANSWER = Refusal(
    "no answer",
    "A local controller does not report its stored parameters.",
    "{heliostat}: its stored parameters cannot be read: {problem}",
    "Check that the heliostat is live, and ask again.",
)
BUS_NOT_RECORDED = Refusal(
    "bus not recorded",
    "A cluster does not record the frames of its bus.",
    "cluster {cluster}: the frames of its bus were not recorded: {problem}",
    "Check that the cluster is connected and nobody else records, then ask again.",
)
FLIGHT_KNOWN = Refusal(
    "flight taken before",
    "The plant has taken a flight of that name already.",
    "flight {name}: {person} gave it on {at}; its orientations count already",
    "Give another flight; the same photographs evaluated again are no new measurement.",
)
FLIGHT_CONTRADICTS = Refusal(
    "flight contradicts the field",
    "The orientations of most mirrors of a flight cannot be theirs.",
    "flight {name}: {wrong} of {all} mirrors cannot stand like that, first {first}; nothing was "
    "taken",
    "Check that the flight is of this field, its times and counts, and the position of the RTK "
    "base.",
)
FLIGHT_BUSY = Refusal(
    "another flight is being fitted",
    "The plant fits one flight at a time.",
    "flight {name}: the plant is still fitting flight {other}",
    "Give it again in a minute.",
)

#: Reasons that end by themselves within seconds.
SOON = frozenset(kind.text for kind in (NOT_HEARD, NOT_COMPARED, PLACE_UNKNOWN, STILL_MOVING))

#: All kinds of refusal, in the order of the reference.
KINDS: tuple[Refusal, ...] = tuple(
    kind for kind in tuple(globals().values()) if isinstance(kind, Refusal)
)
