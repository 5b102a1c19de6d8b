"""Alarms that are not rows of the safety table, as data: severity, text, consequence, remedy.

The code that raises an alarm fills in its text: ``NODE_SILENT.raised("H12", ...)``. Each text is
therefore defined only once, and `docs/reference/alarms.md` and the operator's handbook are checked
against this table and the rows of `safety.conditions`.
"""

from dataclasses import dataclass
from typing import ClassVar

from heliotrope.errors import once
from heliotrope.safety.condition import Severity, Watcher

_PLANT, _CLUSTER = Watcher.PLANT, Watcher.CLUSTER


@dataclass(frozen=True)
class Alarm:
    """One alarm, raised or cleared; it is also a message on the links.

    Attributes
    ----------
    condition, subject
        Name of the row or of the `AlarmKind`, and the cluster, heliostat, target or sensor that the
        alarm concerns ("" for the plant).
    severity, text
        Severity, and text for the operator.
    active
        Whether the alarm is still active; False clears it.
    """

    kind: ClassVar[str] = "alarm"
    condition: str
    subject: str
    severity: Severity
    text: str
    active: bool = True


@dataclass(frozen=True)
class AlarmKind:
    """A kind of alarm.

    Attributes
    ----------
    name
        Name in messages and on the page.
    watcher
        Control tier that raises the alarm.
    severity
        Usual severity.
    meaning
        Circumstances in which the alarm is raised.
    text
        What is wrong and where, with ``{subject}`` and other fields to fill in.
    consequence, remedy
        What happens automatically, and what the operator should do, in one sentence each.
    over
        Text when the alarm has cleared; empty for an alarm that never clears by itself.
    worse
        Severity in the more serious case that ``meaning`` describes, if there is one.
    """

    name: str
    watcher: Watcher
    severity: Severity
    meaning: str
    text: str
    consequence: str
    remedy: str
    over: str = ""
    worse: Severity | None = None

    def line(self, **fields: object) -> str:
        """Return the whole text: what is wrong, what happens automatically, what to do."""
        return f"{once(self.text.format(**fields))}. {self.consequence} {self.remedy}"

    def raised(self, subject: str = "", *, worse: bool = False, **fields: object) -> Alarm:
        """Return the active alarm for a subject; ``fields`` complete its text."""
        severity = self.worse if worse and self.worse is not None else self.severity
        return Alarm(self.name, subject, severity, self.line(subject=subject, **fields))

    def ended(self, subject: str = "", **fields: object) -> Alarm:
        """Return the message that clears the alarm for a subject."""
        text = (self.over or "{subject} {name}: over").format(
            subject=subject, name=self.name, **fields
        )
        return Alarm(self.name, subject, self.severity, once(text.strip()), active=False)


TIME_WENT_BACK = AlarmKind(
    "time_went_back",
    _PLANT,
    Severity.EMERGENCY,
    "The monotonic clock of the plant's or a cluster's computer went backwards or returned no "
    "number.",
    "the monotonic time went from {before:g} s to {now:g} s",
    "The whole field is defocused; until the clock recovers, no reading ages and no condition "
    "releases.",
    "Restart the controller and replace its computer.",
    over="the monotonic time runs forwards again",
)
UNKNOWN_READING = AlarmKind(
    "unknown_reading",
    _PLANT,
    Severity.WARNING,
    "A reading arrives that no condition of the safety table uses.",
    "reading {reading!r} is not used by any condition of the safety table, so nothing monitors it",
    "The reading is ignored.",
    "Correct the name of the reading.",
    over="every reading belongs to a condition again",
)
PARAMETERS_DIFFER = AlarmKind(
    "parameters_differ",
    _PLANT,
    Severity.WARNING,
    "A local controller stores parameters that differ from the intended ones.",
    "{subject}: stored parameters differ from the intended ones: {items}",
    "No motion except DEFOCUS and STOW is accepted; the intended parameters are written as soon as "
    "someone has the command authority and the heliostat is where its beam is safe.",
    "Stow the heliostat; if more than armature, biases, location and defocus differ, lock it at "
    "stow. If the alarm returns, replace the controller's flash memory.",
)
IDENTITY = AlarmKind(
    "identity",
    _PLANT,
    Severity.ALARM,
    "A local controller reports another heliostat's armature, or another controller reports this "
    "heliostat's armature.",
    "{subject}: {problem}",
    "The heliostat is sent to stow; no other motion and no parameters are sent. DEFOCUS and STOW "
    "still go to its address.",
    "Make sure that both heliostats are at stow; then correct their addresses, or write the "
    "parameters of the heliostat that is there.",
    over="{subject}: its address reports its own parameters again",
)
UNLISTED = AlarmKind(
    "heliostat_unlisted",
    _PLANT,
    Severity.ALARM,
    "A cluster's status does not contain a heliostat of the plant because the cluster file does "
    "not list it.",
    "{subject}: cluster {cluster} does not list it, so nothing shows its state",
    "The mirror stays as it is while the cluster sends sun vectors, and no command by name reaches "
    "the heliostat. DEFOCUS and STOW of the whole cluster do reach it, and so does EMERGENCY, but "
    "nothing can prove that its beam is off.",
    "Send EMERGENCY if its mirror may not be at stow; then add it to the cluster's file and "
    "restart the cluster.",
    over="{subject}: cluster {cluster} lists it again",
)
SECOND_PLANT = AlarmKind(
    "second_plant",
    _PLANT,
    Severity.ALARM,
    "Clusters belong to another plant with the same keys, which was running before this one.",
    "this plant (run {run}) is the second one with its keys: {clusters} belong to run {holder}",
    "These clusters accept only DEFOCUS, STOW and EMERGENCY from this plant until this plant is "
    "restarted.",
    "Shut down one of the two plants; if the other plant is already off, restart this one.",
    over="the clusters no longer belong to another plant",
)
SETTINGS_DIFFER = AlarmKind(
    "cluster_settings_differ",
    _PLANT,
    Severity.WARNING,
    "For 5 s, polling periods or safety thresholds of a cluster have differed from those that "
    "the plant expects or, where it expects none, from those of most other clusters.",
    "cluster {subject}: its settings differ from those of {others}",
    "The cluster continues with its own settings.",
    "Compare [polling] of its cluster file with that of the plant's links file, delta_t_s and "
    "[safety] with those of the plant file, and the versions of the two programs; correct the "
    "wrong one and restart its program.",
    over="cluster {subject}: its settings are no longer known to differ",
)
FIRMWARE_DIFFERS = AlarmKind(
    "firmware_differs",
    _PLANT,
    Severity.WARNING,
    "Boards on a cluster's bus have a firmware version that differs from the one that the plant "
    "expects.",
    "cluster {subject}: {boards} do not have firmware version {expected}, which this plant expects",
    "The boards continue with their current firmware.",
    "Install the expected version on them, or correct firmware in the links file. The bus is "
    "searched when the cluster connects.",
    over="cluster {subject}: all boards that answer have the expected firmware",
)
SUN_CONTRADICTED = AlarmKind(
    "sun_contradicted",
    _PLANT,
    Severity.ALARM,
    "An independent witness does not see the sun where the plant computes it: the time or site "
    "that plant and clusters share is wrong.",
    "{problem}, at {at} UTC by the plant's clock",
    "No heliostat leaves stow or joins a receiver; tracking heliostats continue, but their beams "
    "are off their aims.",
    "Defocus the field. Compare the plant's clock with another one, and its site with a map; then "
    "correct them.",
    over="{subject} sees the sun where the plant computes it",
)
FLUX_DISAGREES = AlarmKind(
    "flux_disagrees",
    _PLANT,
    Severity.WARNING,
    "For two minutes the flux measured on the receiver has differed from the predicted one by more "
    "than four standard deviations.",
    "receiver {receiver}: {measured:.0f} kW are measured and {predicted:.0f} kW predicted; the "
    "flux is {far:.0f} standard deviations off",
    "The field continues unchanged.",
    "Compare both maps (tab Plant): if beams are displaced, look for a wrong clock, a wrong "
    "calibration or a moved receiver; if the whole map is darker, look for clouds over the "
    "field, dirt, or a faulty irradiance or flux sensor.",
    over="receiver {receiver}: the measured flux agrees with the predicted one again",
)
UNWITNESSED = AlarmKind(
    "unwitnessed",
    _PLANT,
    Severity.WARNING,
    "No independent witness has confirmed the plant's sun position today; an alarm instead of "
    "a warning where a witness is required.",
    "no independent witness has seen the sun today where the plant computes it: {problem}",
    "Where a witness is required, no heliostat joins a receiver. Where none is required, a wrong "
    "time or site that the plant and the clusters share goes undetected.",
    "Let a heliostat that was calibrated before today visit a target, or check the witness; name "
    "witnesses in the table witness of the links file, or declare there that there is none.",
    over="a witness sees the sun where the plant computes it",
    worse=Severity.ALARM,
)
CONSOLE = AlarmKind(
    "console",
    _PLANT,
    Severity.WARNING,
    "The console's process has ended, or does not respond.",
    "the console {problem}",
    "The plant continues without the console, and restarts it after a pause.",
    "Use heliotrope ctl on the plant's computer until the console is back; if the alarm returns, "
    "read the console's messages.",
    over="the console responds again",
)
EMERGENCY_WAY = AlarmKind(
    "emergency_way",
    _PLANT,
    Severity.WARNING,
    "The process of the page's second path for EMERGENCY has ended, or does not respond.",
    "the second path for EMERGENCY {problem}",
    "EMERGENCY still works through the console alone; the process is restarted after a pause.",
    "Use heliotrope ctl on the plant's computer if the console does not respond either.",
    over="the second path for EMERGENCY responds again",
)
COUNTS_DOUBTFUL = AlarmKind(
    "counts_doubtful",
    _PLANT,
    Severity.WARNING,
    "A local controller lost power during motion, so its step counts may be wrong.",
    "{subject}: its step counts may be wrong since a power cut during motion",
    "The heliostat does not join the receiver; targets, standby, DEFOCUS and STOW remain possible.",
    "Check where its mirror points. If the position is right, acknowledge; if not, an engineer "
    "locks the heliostat and sets its step counts (ZERO). A calibration visit also confirms the "
    "step counts.",
    over="{subject}: its step counts are confirmed, or have been set again",
)
DRIVE_STALLED = AlarmKind(
    "drive_stalled",
    _PLANT,
    Severity.ALARM,
    "The drives of a heliostat made steps, but its mirror did not follow: ice, a loose coupling, "
    "or a driver without current.",
    "{subject}: {drives} made steps, but its mirror did not follow",
    "It joins no receiver, automatic control leaves it at stow, and its reports cannot prove that "
    "it obeyed an emergency order, because its beam may be anywhere that its drives have been "
    "since.",
    "From a safe place, find out where its beam is. Remove the cause, clear the fault, and order "
    "Diagnose again; or acknowledge once you have seen the mirror follow. Then set its step counts "
    "with ZERO.",
    over="{subject}: its mirror follows its drives",
)
DIAGNOSIS_FAILS = AlarmKind(
    "diagnosis_fails",
    _PLANT,
    Severity.WARNING,
    "Movement diagnoses of a heliostat failed to finish five times in a row.",
    "{subject}: {count} movement diagnoses failed in a row; the last failure: {reason}",
    "It stays at stow, and the diagnosis is repeated after an hour.",
    "Find the cause (tab Logs): its cluster, its supply, or orders that interrupt it; then order "
    "Diagnose by hand. If it has no tilt sensor, correct tilt_sensor in the plant file.",
    over="{subject}: a movement diagnosis has finished",
)
TILT_SENSOR_SILENT = AlarmKind(
    "tilt_sensor_silent",
    _PLANT,
    Severity.WARNING,
    "According to the plant file a heliostat has a tilt sensor, but its board gets no reading from "
    "the sensor.",
    "{subject}: its tilt sensor delivers no reading, so a stalled drive is not detected",
    "The heliostat is treated as one without a tilt sensor; a photograph on a target still shows "
    "whether its mirror follows.",
    "Check the sensor's wiring and its pins in the board's settings; or correct tilt_sensor in the "
    "plant file.",
    over="{subject}: its tilt sensor delivers readings",
)
AIMS = AlarmKind(
    "aims",
    _PLANT,
    Severity.ALARM,
    "No aims were found that respect the flux limit, or none were found within deadline_s.",
    "aims under the flux limit: {problem}",
    "The last good aims stay in use; after five times deadline_s the field goes to the safe "
    "spread.",
    "Return beams that an operator has aimed to automatic control (Automatic); otherwise "
    "defocus some heliostats, and correct [aims] in the plant file.",
    over="the aims respect the flux limit again",
)
FLUX_ABOVE_LIMIT = AlarmKind(
    "flux_above_limit",
    _PLANT,
    Severity.ALARM,
    "The predicted flux with its errors, or the measured flux, is above the limit of the plant "
    "file.",
    "receiver {subject}: the {source} flux is up to {excess:.1f} % above its limit",
    "Automatic control sends the heliostats that heat this spot to standby, and later to other "
    "aims. Beams that an operator has aimed stay; while an operator has command, all stay.",
    "Defocus the heliostats that an operator has aimed there, or return them (Automatic) and "
    "release command.",
    over="receiver {subject}: the flux is within its limit",
)
RECORDS = AlarmKind(
    "records",
    _PLANT,
    Severity.ALARM,
    "Telemetry, events or results cannot be stored.",
    "records are not stored: {problem}",
    "The plant continues without these records.",
    "Check the disk or the database.",
    over="records are stored again",
)
LOCKOUT = AlarmKind(
    "sign_in_lockout",
    _PLANT,
    Severity.WARNING,
    "Sign-ins for one name or from one address have failed too often.",
    "sign-ins as {who} from {address} are refused after too many failures",
    "Open sessions continue; the block ends by itself after an hour at most.",
    "Ask that user; if they did not try to sign in, find out who uses that address, and read the "
    "security events.",
    over="no sign-in was refused for ten minutes",
)
ORDERS_REFUSED = AlarmKind(
    "orders_refused",
    _PLANT,
    Severity.WARNING,
    "Five orders within five minutes were refused because the caller's role is too low.",
    "orders are refused repeatedly: the role of {who} from {address} is too low",
    "Nothing was sent; everyone who is signed in can still order EMERGENCY.",
    "Ask that user; if the orders are not theirs, revoke the token or disable the account.",
    over="no order was refused for ten minutes",
)
CERTIFICATE = AlarmKind(
    "certificate",
    _PLANT,
    Severity.WARNING,
    "A certificate expires within 30 days, or its expiry date is unknown; the warning becomes "
    "an alarm once the certificate has expired. It is repeated each day.",
    "{problem}",
    "Existing connections continue; after the certificate expires, no new TLS connection is "
    "possible.",
    "Renew the certificate and replace the old files; the new files are loaded within seconds.",
    over="{subject}: this certificate was renewed, or a new day has begun",
    worse=Severity.ALARM,
)
RENEWAL = AlarmKind(
    "renewal",
    _PLANT,
    Severity.WARNING,
    "A key file or a certificate was changed while the program was running, and cannot be used.",
    "the changed {subject} cannot be used: {problem}",
    "The keys or certificates that were read before stay in force.",
    "Correct the file; it is read again every two seconds. With the file as it is, a restart would "
    "fail.",
    over="the {subject} was read again and is in force",
)
SYSLOG = AlarmKind(
    "syslog",
    _PLANT,
    Severity.WARNING,
    "Security events and alarms cannot be forwarded to the syslog receiver, or some were lost.",
    "security events and alarms are not being forwarded: {problem}",
    "The store keeps them; up to 10,000 wait for the receiver, and any beyond that number never "
    "reach it.",
    "Check the receiver, its certificate and the network in between.",
    over="security events and alarms are being forwarded again; {count} were lost since the start",
)
HEADS = AlarmKind(
    "heads",
    _PLANT,
    Severity.WARNING,
    "The heads of the hash chains cannot be exported.",
    "the heads of the records' chains are not exported: {problem}",
    "The records are kept; the export is repeated at the next interval.",
    "Check the folder given by --heads, and the store.",
    over="the heads of the records' chains are exported again",
)
RECORD_REFUSED = AlarmKind(
    "record_refused",
    _PLANT,
    Severity.WARNING,
    "The store refuses a record because of its content; the disk and the database work.",
    "a record was refused: {problem}",
    "This record is lost; all others are stored.",
    "Report this message to Heliotrope's maintainers.",
    over="a record was refused: {problem}; the records after it are stored",
)
WORK = AlarmKind(
    "work",
    _PLANT,
    Severity.ALARM,
    "A part of automatic control failed.",
    "automatic control, part {subject}, failed: {reason}",
    "This part is restarted after 5 s.",
    "Report this message to Heliotrope's maintainers; until this part works again, command the "
    "field by hand.",
    over="automatic control, part {subject}, works again",
)
RESUME_NEEDED = AlarmKind(
    "resume_needed",
    _PLANT,
    Severity.ALARM,
    "More heliostats than `losses` or `losses_share` allow left the receiver within 30 s without "
    "an order, or an emergency was active when the plant's program last ended.",
    "{what} at {since} UTC",
    "Automatic control waits and raises no heliostat.",
    "Find the cause, make sure that nobody is in the field, then press Resume.",
    over="automatic control was resumed",
)
BEAM_BLOCKED = AlarmKind(
    "beam_blocked",
    _PLANT,
    Severity.WARNING,
    "The beam of a heliostat would enter a keep-out volume at its aim or on its way there, or "
    "cross a receiver on its way from stow.",
    "{subject}: {reason}",
    "Automatic control stows it if it is defocused, since the path from stow may be free; "
    "otherwise it leaves it where it is and tries again every five minutes.",
    "If a receiver is in the way, wait until the sun has moved on. Otherwise set another aim "
    "point, or correct the volume in the plant file.",
    over="{subject}: it has left the blocked position",
)
CAMERA = AlarmKind(
    "camera",
    _PLANT,
    Severity.WARNING,
    "A target's camera delivers no frames.",
    "target {subject}: {problem}",
    "Nothing is calibrated on this target until frames arrive again.",
    "Check the camera, its network and its clock.",
    over="target {subject}: frames arrive again",
)
BEAM_DISPROVED = AlarmKind(
    "beam_disproved",
    _PLANT,
    Severity.WARNING,
    "In a joint visit a heliostat's beam did not move with its aim, moved where another "
    "heliostat's beam should be, or was far from its expected position.",
    "{subject}: in a joint visit, {problem}",
    "The results of that visit are not used for this heliostat; its next visit takes place alone.",
    "If the beam does not move, check the drives and couplings; if it is swapped with another "
    "heliostat's, check the addresses and the bus wiring.",
    over="{subject}: a photograph has shown its own beam at the expected position",
)
CALIBRATION_GIVEN_UP = AlarmKind(
    "calibration_given_up",
    _PLANT,
    Severity.WARNING,
    "A heliostat was not calibrated in several visits to targets, the last of them alone with a "
    "search for its beam.",
    "{subject}: {count} visits to targets failed to calibrate it; the last visit: {reason}",
    "It keeps its parameters and gets no target time for 16 hours; then it gets one visit a day. "
    "New parameters or a drone flight entitle it to new visits.",
    "Check its photographs (tab Heliostat), its mirror and its drives; then press Calibrate now, "
    "or Out of service.",
    over="{subject}: it is calibrated, or gets new visits for new parameters",
)
RAISING_GIVEN_UP = AlarmKind(
    "raising_given_up",
    _PLANT,
    Severity.WARNING,
    "Five times in a row, each within half an hour of the last, a heliostat has left the "
    "receiver without an order or could not continue from its position.",
    "{subject}: {count} attempts in a row to raise it failed; the last time it {reason}",
    "Automatic control no longer raises it; after 16 hours there is one more attempt.",
    "Find the cause (tab Heliostat, tab Logs): its supply, its cluster or a fault; then press "
    "Automatic.",
    over="{subject}: it is raised, or a person has returned it to automatic control",
)
NOT_PARKED = AlarmKind(
    "not_parked",
    _PLANT,
    Severity.ALARM,
    "A heliostat was taken out of service, and did not report stow within five minutes.",
    "{subject}: it is out of service and not in stow: {reason}",
    "STOW is sent to it once a minute until it reports that it is in stow.",
    "Nobody may approach its mirror; its beam is where its state says, or its position is unknown. "
    "Check its fault, its supply and its cable.",
    over="{subject}: it is in stow, or was returned to service",
)
VISITS_FAIL = AlarmKind(
    "visits_fail",
    _PLANT,
    Severity.WARNING,
    "Several visits to a target or receiver in a row have had no result, and no single heliostat "
    "was at fault.",
    "{subject}: {count} visits in a row have had no result; the last visit: {reason}",
    "Only calibrations that a user requests take place there, and one automatic visit an hour.",
    "Check its camera, the light on it and its view; then press Calibrate now.",
    over="{subject}: a visit has had a result",
)
SENSOR = AlarmKind(
    "sensor",
    _PLANT,
    Severity.ALARM,
    "A sensor delivers no reading.",
    "sensor {subject}: {problem}",
    "Once its last reading is stale, the safety table assumes the worst case.",
    "Check the program that writes its file, or the camera of the receiver.",
    over="sensor {subject}: its readings arrive again",
)
ORDER_UNACKNOWLEDGED = AlarmKind(
    "order_unacknowledged",
    _CLUSTER,
    Severity.EMERGENCY,
    "A heliostat has not acknowledged DEFOCUS or STOW within a second.",
    "{subject} has not acknowledged {order}; the position of its beam is unknown",
    "The cluster repeats the order until it is acknowledged.",
    "Keep people away from its beam and inspect the heliostat.",
    over="{subject} has acknowledged",
)
NODE_SILENT = AlarmKind(
    "node_silent",
    _CLUSTER,
    Severity.WARNING,
    "A local controller does not reply; an alarm if it was approaching, at standby, tracking or "
    "searching when it last reported.",
    "{subject}: no reply for {silence:g} s; {last}",
    "The cluster keeps polling it.",
    "Assume that its beam has not moved; check its supply and its cable.",
    over="{subject}: it replies again",
    worse=Severity.ALARM,
)
NODE_FAULT = AlarmKind(
    "node_fault",
    _CLUSTER,
    Severity.ALARM,
    "A local controller has latched a fault.",
    "{subject}: fault: {fault}",
    "The heliostat has turned away or stopped.",
    "See Faults of a heliostat in the handbook; an engineer clears the fault.",
    over="{subject}: fault cleared",
)
NODE_UNINTELLIGIBLE = AlarmKind(
    "node_unintelligible",
    _CLUSTER,
    Severity.ALARM,
    "A local controller reports a state that the cluster does not know.",
    "{subject}: state {state} is not known",
    "Its reports are ignored, so the heliostat counts as silent.",
    "Install matching firmware and cluster versions.",
    over="{subject}: its state is known again",
)
SUN_JUMPED = AlarmKind(
    "sun_jumped",
    _CLUSTER,
    Severity.WARNING,
    "A local controller was sent a sun vector that cannot follow from the previous one.",
    "{subject}: its cluster sent a sun vector that cannot follow from the previous one",
    "It refused that sun vector, or accepted it after a gap; if it was tracking, it has turned "
    "away.",
    "Check the clock, the time source and the site of the cluster.",
    over="{subject}: no jump for a minute; another jump is reported only after its local "
    "controller restarts",
)
PLANT_UNINTELLIGIBLE = AlarmKind(
    "plant_unintelligible",
    _CLUSTER,
    Severity.WARNING,
    "The plant sends a message that the cluster does not know.",
    "message from the plant ignored: {problem}",
    "The message is ignored.",
    "Install matching versions of plant and cluster.",
)
LEASE_REFUSED = AlarmKind(
    "lease_refused",
    _CLUSTER,
    Severity.ALARM,
    "The plant's lease is out of range.",
    "{problem}",
    "The cluster ignores the lease, and defocuses when the last valid one ends.",
    "Correct the plant's settings lease and autonomy.",
    over="the plant's lease is accepted again",
)
TWO_PLANTS = AlarmKind(
    "two_plants",
    _CLUSTER,
    Severity.ALARM,
    "A second plant with the same keys asks for the lease while the first one renews it.",
    "a second plant with the same keys is running: run {runs}; the cluster belongs to run {holder}",
    "The cluster obeys the plant that it belongs to; from the other plant it accepts only DEFOCUS, "
    "STOW and EMERGENCY.",
    "Shut down the second plant; a run is named after the UTC time at which its plant started.",
    over="the second plant has not asked for a minute",
)
BUS_KEY_MISSING = AlarmKind(
    "bus_key_missing",
    _CLUSTER,
    Severity.ALARM,
    "Local controllers have a bus key, but their cluster has none.",
    "cluster {cluster} has no bus key, but {heliostats} obey only signed frames",
    "They accept no sun vectors from the cluster, so they defocus and stow by themselves. DEFOCUS "
    "and STOW still reach them.",
    "Name the key file in the cluster file (bus_key), and restart the cluster; to stop signing "
    "frames, name a key file made by heliotrope keys bus off.",
    over="cluster {cluster}: no local controller obeys signed frames only",
)
BUS_UNSIGNED = AlarmKind(
    "bus_unsigned",
    _CLUSTER,
    Severity.WARNING,
    "A cluster signs its frames, but some local controllers do not have the bus key.",
    "cluster {cluster} signs its frames, but {heliostats} do not have its bus key: {why}",
    "The cluster sends them the key as soon as it can. Until then they also obey unsigned frames "
    "from anyone on the bus or, with another key or older firmware, accept no sun vectors.",
    "Stow them; if the alarm stays, check their keys in the cluster's key file and their firmware.",
    over="cluster {cluster}: all local controllers that reply have the bus key",
)
TIME_SOURCE = AlarmKind(
    "time_source",
    _CLUSTER,
    Severity.WARNING,
    "The cluster's clock is not synchronised, or its time receiver and its clock contradict each "
    "other.",
    "{problem}",
    "The cluster continues; it defocuses when its time error exceeds 1 s.",
    "Run chronyc sources on that computer, and check antenna and receiver.",
    over="the cluster's clock is synchronised again",
)
AUTONOMY_LIMITED = AlarmKind(
    "autonomy_limited",
    _CLUSTER,
    Severity.WARNING,
    "The plant grants more autonomy than the cluster's configuration allows.",
    "the plant grants {granted:g} s of autonomy; cluster {cluster} is configured for {longest:g} s",
    "The cluster keeps to its own limit.",
    "Set longest_autonomy_s of the cluster, or lower the plant's setting autonomy.",
    over="the autonomy granted is within the cluster's limit",
)
STATE_UNWRITABLE = AlarmKind(
    "state_unwritable",
    _CLUSTER,
    Severity.ALARM,
    "The cluster cannot store its epoch.",
    "the cluster's epoch cannot be stored: {problem}",
    "The cluster continues; after a restart without a known time, local controllers may refuse its "
    "commands.",
    "Check the cluster's disk.",
    over="the cluster's epoch is stored again",
)

#: All kinds of alarm, by name.
KINDS: dict[str, AlarmKind] = {
    kind.name: kind for kind in tuple(globals().values()) if isinstance(kind, AlarmKind)
}
