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
        Name of the row or of the `AlarmKind`; the cluster, heliostat, target or sensor that the
        alarm concerns, "" for the plant.
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
        Control tier that raises it.
    severity
        Usual severity.
    meaning
        Circumstances in which it is raised.
    text
        What is wrong and where, with ``{subject}`` and other fields to fill in.
    consequence, remedy
        What happens automatically, and what the operator should do: one sentence each.
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
    "The monotonic clock of the plant's or a cluster's machine went back or gave no number.",
    "the monotonic time went from {before:g} s to {now:g} s",
    "DEFOCUS of the field; nothing ages or releases meanwhile.",
    "Restart the controller and replace its machine.",
    over="the monotonic time runs forwards again",
)
UNKNOWN_READING = AlarmKind(
    "unknown_reading",
    _PLANT,
    Severity.WARNING,
    "A reading arrives that no row of the safety table uses.",
    "reading {reading!r} is in no row of the safety table, so nothing watches it",
    "The reading is ignored.",
    "Correct the name of the reading.",
    over="every reading belongs to a row again",
)
PARAMETERS_DIFFER = AlarmKind(
    "parameters_differ",
    _PLANT,
    Severity.WARNING,
    "A local controller stores parameters that differ from the wanted ones.",
    "{subject}: stored parameters differ from the wanted ones: {items}",
    "No motion but DEFOCUS and STOW is accepted; they are written as soon as there is a command "
    "authority and the heliostat stands where its beam is safe.",
    "Stow it; lock it at stow if more than armature, biases, location and defocus differ. If it "
    "returns, replace the controller's flash memory.",
)
IDENTITY = AlarmKind(
    "identity",
    _PLANT,
    Severity.ALARM,
    "A local controller reports the armature of another heliostat, or another one reports its own.",
    "{subject}: {problem}",
    "It is sent to stow, and neither moved nor written; DEFOCUS and STOW still go to its address.",
    "See that both stand at stow; then correct their addresses, or write the parameters of the "
    "mirror that is there.",
    over="{subject}: its own parameters answer again",
)
UNLISTED = AlarmKind(
    "heliostat_unlisted",
    _PLANT,
    Severity.ALARM,
    "A cluster's status has no row for a heliostat of the plant: its file does not list it.",
    "{subject}: cluster {cluster} does not list it, so nothing shows its state",
    "Its mirror stays as it is while the cluster sends the sun, and no command by name reaches it. "
    "DEFOCUS and STOW of the whole cluster do, and so does EMERGENCY, which cannot prove it off.",
    "Send EMERGENCY if its beam may be out; then add it to the cluster's file and restart the "
    "cluster.",
    over="{subject}: cluster {cluster} lists it again",
)
SECOND_PLANT = AlarmKind(
    "second_plant",
    _PLANT,
    Severity.ALARM,
    "Clusters belong to another plant with the same keys, which was there before this one.",
    "this plant (run {run}) is the second one with its keys: {clusters} belong to run {holder}",
    "They take only DEFOCUS, STOW and EMERGENCY from this plant, until it is restarted.",
    "Switch one of the two plants off; if the other is off, restart this one.",
    over="the clusters belong to no other plant any more",
)
SETTINGS_DIFFER = AlarmKind(
    "cluster_settings_differ",
    _PLANT,
    Severity.WARNING,
    "For 5 s, periods or safety thresholds of a cluster have differed from those that the plant "
    "expects, or where it expects none, from those of most other clusters.",
    "cluster {subject}: its settings differ from those of {others}",
    "It goes on with its own settings.",
    "Compare [polling] of its cluster file with that of the plant's links file, delta_t_s and "
    "[safety] with those of the plant file, and the versions of the two programs; correct the "
    "wrong one and restart its program.",
    over="cluster {subject}: its settings are no longer known to differ",
)
FIRMWARE_DIFFERS = AlarmKind(
    "firmware_differs",
    _PLANT,
    Severity.WARNING,
    "Boards on the bus of a cluster have another firmware version than the plant expects.",
    "cluster {subject}: {boards} have other firmware than version {expected}, which this plant "
    "expects",
    "They go on with their own.",
    "Install the expected version on them, or correct firmware in the links file. The bus is "
    "searched when the cluster connects.",
    over="cluster {subject}: all boards that answer have the expected firmware",
)
SUN_CONTRADICTED = AlarmKind(
    "sun_contradicted",
    _PLANT,
    Severity.ALARM,
    "An independent witness sees the sun elsewhere than the plant computes it: the time or site "
    "that plant and clusters share is wrong.",
    "{problem}, at {at} UTC by the plant's clock",
    "No heliostat leaves stow or joins a receiver; those that track go on, beside their aims.",
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
    "The field goes on as it is.",
    "Compare both maps (tab Plant): if beams are beside their place, look for a wrong clock, a "
    "wrong calibration or a moved receiver; if all is darker, for clouds over the field, dirt, or "
    "a wrong sensor of irradiance or flux.",
    over="receiver {receiver}: the measured flux agrees with the predicted one again",
)
UNWITNESSED = AlarmKind(
    "unwitnessed",
    _PLANT,
    Severity.WARNING,
    "No independent witness has agreed with the plant's sun today; worse where one is required.",
    "nothing independent has seen today's sun where the plant computes it: {problem}",
    "Where a witness is required, no heliostat joins a receiver; else a time or site that is wrong "
    "in plant and clusters stays unseen.",
    "Let a heliostat that was calibrated before today visit a target, or see to the witness; name "
    "witnesses in the table witness of the links file, or accept there that there is none.",
    over="a witness sees the sun where the plant computes it",
    worse=Severity.ALARM,
)
CONSOLE = AlarmKind(
    "console",
    _PLANT,
    Severity.WARNING,
    "The console's process has ended, or gives no sign of life.",
    "the console {problem}",
    "The plant goes on without it, and starts it again after a pause.",
    "Use heliotrope ctl on the plant's computer meanwhile; if it returns, look at its messages.",
    over="the console answers again",
)
EMERGENCY_WAY = AlarmKind(
    "emergency_way",
    _PLANT,
    Severity.WARNING,
    "The process of the page's second way for EMERGENCY has ended, or gives no sign of life.",
    "the second way for EMERGENCY {problem}",
    "EMERGENCY goes on by the console alone; the process is started again after a pause.",
    "Use heliotrope ctl on the plant's computer if the console does not answer either.",
    over="the second way for EMERGENCY answers again",
)
COUNTS_DOUBTFUL = AlarmKind(
    "counts_doubtful",
    _PLANT,
    Severity.WARNING,
    "A local controller lost its power in motion, so its step counts may be wrong.",
    "{subject}: its step counts may be wrong since a power cut in motion",
    "It does not join the receiver; targets, standby, DEFOCUS and STOW go on as before.",
    "Look where its mirror stands. If that is right, acknowledge; if not, an engineer locks it and "
    "gives its step counts (ZERO). A calibration visit confirms it too.",
    over="{subject}: its step counts are confirmed, or have been given again",
)
DRIVE_STALLED = AlarmKind(
    "drive_stalled",
    _PLANT,
    Severity.ALARM,
    "The drives of a heliostat made steps, and its mirror did not follow: ice, a loose coupling, "
    "or a driver without current.",
    "{subject}: {drives} made steps, and its mirror did not follow",
    "It joins no receiver, automatic control leaves it at stow, and nothing that it reports proves "
    "an emergency: its beam may be anywhere that its drives have been since.",
    "Look where its beam is from a safe place. Remove the cause, clear the fault, and give "
    "Diagnose again; or acknowledge once you have seen the mirror follow. Its step counts need "
    "ZERO.",
    over="{subject}: its mirror follows its drives",
)
DIAGNOSIS_FAILS = AlarmKind(
    "diagnosis_fails",
    _PLANT,
    Severity.WARNING,
    "Diagnoses of a heliostat's movement did not come to their end five times in a row.",
    "{subject}: {count} diagnoses of its movement in a row failed; the last time {reason}",
    "It stays at stow, and is diagnosed again after an hour.",
    "Find the cause (tab Logs): its cluster, its supply, or orders that interrupt it; then give "
    "Diagnose by hand. If it has no tilt sensor, correct tilt_sensor in the plant file.",
    over="{subject}: a diagnosis of its movement has come to its end",
)
TILT_SENSOR_SILENT = AlarmKind(
    "tilt_sensor_silent",
    _PLANT,
    Severity.WARNING,
    "A heliostat has a tilt sensor by the plant file, and its board gets no reading from it.",
    "{subject}: its tilt sensor gives no reading, so a drive that stalls is not seen",
    "It goes on as a heliostat without such a sensor; a photograph on a target still shows whether "
    "its mirror follows.",
    "Check the sensor's wires and its pins in the settings of the board; or correct tilt_sensor in "
    "the plant file.",
    over="{subject}: its tilt sensor gives readings",
)
AIMS = AlarmKind(
    "aims",
    _PLANT,
    Severity.ALARM,
    "No aims were found that hold the flux limit, or none came within deadline_s.",
    "aims under the flux limit: {problem}",
    "The last good aims stay; after five times deadline_s the field goes to the safe spread.",
    "If beams stay where a person has aimed them, give them back with Automatic; else defocus some "
    "heliostats, and correct [aims] in the plant file.",
    over="aims hold the flux limit again",
)
FLUX_ABOVE_LIMIT = AlarmKind(
    "flux_above_limit",
    _PLANT,
    Severity.ALARM,
    "The predicted flux with its errors is above the flux limit of the plant file.",
    "receiver {subject}: the predicted flux is up to {excess:.1f} % above its limit",
    "The heliostats that heat this spot go to standby, and come back at other aims.",
    "If it stays, defocus the heliostats that a person has aimed there.",
    over="receiver {subject}: the predicted flux is within its limit",
)
RECORDS = AlarmKind(
    "records",
    _PLANT,
    Severity.ALARM,
    "Telemetry, events or results cannot be stored.",
    "records are not stored: {problem}",
    "The plant goes on without them.",
    "Check the disk or the database.",
    over="records are stored again",
)
LOCKOUT = AlarmKind(
    "sign_in_lockout",
    _PLANT,
    Severity.WARNING,
    "Sign-ins for one name or from one address have failed too often.",
    "sign-ins as {who} from {address} are refused after too many failures",
    "Open sessions go on; the refusal ends by itself, after an hour at most.",
    "Ask that person; if nobody tried, find who uses that address, and read the security events.",
    over="no sign-in was refused for ten minutes",
)
ORDERS_REFUSED = AlarmKind(
    "orders_refused",
    _PLANT,
    Severity.WARNING,
    "Five orders within five minutes were refused because the caller's role is too low.",
    "orders are refused again and again: {who} from {address} has too low a role",
    "Nothing was sent; EMERGENCY stays open to everybody who is signed in.",
    "Ask that person; revoke the token or disable the account if it is not them.",
    over="no order was refused for ten minutes",
)
CERTIFICATE = AlarmKind(
    "certificate",
    _PLANT,
    Severity.WARNING,
    "A certificate ends within 30 days, or its end is unknown; an alarm once it has ended. It "
    "comes again each day.",
    "{problem}",
    "Standing connections go on; once it has ended, no new one with TLS is made.",
    "Renew it, and put the new files in its place; they are taken within seconds.",
    over="{subject}: this certificate was renewed, or a new day begins",
    worse=Severity.ALARM,
)
RENEWAL = AlarmKind(
    "renewal",
    _PLANT,
    Severity.WARNING,
    "A key file or a certificate was changed while the program runs, and cannot be used.",
    "the changed {subject} cannot be used: {problem}",
    "The keys or certificates that were read before stay in force.",
    "Correct the file: it is read again every two seconds. A restart with it as it is fails.",
    over="the {subject} was read again and is in force",
)
SYSLOG = AlarmKind(
    "syslog",
    _PLANT,
    Severity.WARNING,
    "Security events and alarms cannot be sent on to the receiver of syslog, or some were lost.",
    "security events and alarms are not sent on: {problem}",
    "They are in the store; up to 10,000 wait for the receiver, and those beyond are lost to it.",
    "Check the receiver, its certificate and the network between.",
    over="security events and alarms are sent on again; {count} were lost since the start",
)
HEADS = AlarmKind(
    "heads",
    _PLANT,
    Severity.WARNING,
    "The heads of the hash chains cannot be exported.",
    "the heads of the records' chains are not exported: {problem}",
    "The records are kept; it is tried again at the next interval.",
    "Check the folder given by --heads, and the store.",
    over="the heads of the records' chains are exported again",
)
RECORD_REFUSED = AlarmKind(
    "record_refused",
    _PLANT,
    Severity.WARNING,
    "The store refuses a record for its content; the disk and the database are well.",
    "a record was refused: {problem}",
    "This record is lost; all others are stored.",
    "Report the text.",
    over="a record was refused: {problem}; the records after it are stored",
)
WORK = AlarmKind(
    "work",
    _PLANT,
    Severity.ALARM,
    "A part of automatic control failed.",
    "automatic control, part {subject}, failed: {reason}",
    "It is tried again after 5 s.",
    "Report the text; without this part, command the field by hand.",
    over="automatic control, part {subject}, works again",
)
RESUME_NEEDED = AlarmKind(
    "resume_needed",
    _PLANT,
    Severity.ALARM,
    "More heliostats than `losses` or `losses_share` allow left the receiver within 30 s without "
    "an order, or an emergency held when the last program ended.",
    "{what} at {since} UTC",
    "Automatic control waits and raises nothing.",
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
    "Automatic control stows it if it is defocused, since the path from stow may be free; else it "
    "leaves it where it is and tries again every five minutes.",
    "Wait where a receiver is in the way: the sun moves on. Else give it another aim point, or "
    "correct the volume in the plant file.",
    over="{subject}: it has left the blocked position",
)
CAMERA = AlarmKind(
    "camera",
    _PLANT,
    Severity.WARNING,
    "A target's camera delivers no frame.",
    "target {subject}: {problem}",
    "Nothing is calibrated on this target meanwhile.",
    "Check the camera, its network and its clock.",
    over="target {subject}: frames arrive again",
)
BEAM_DISPROVED = AlarmKind(
    "beam_disproved",
    _PLANT,
    Severity.WARNING,
    "In a joint visit the light of a heliostat did not move with its aim, moved at the place of "
    "another one, or was far from where it was expected.",
    "{subject}: in a joint visit, {problem}",
    "Nothing is learnt from that visit; it goes alone to its next one.",
    "Look at its drives and couplings if it does not move; at addresses and the wiring of its bus "
    "if it is exchanged with another one.",
    over="{subject}: a photograph has shown its own beam at its place",
)
CALIBRATION_GIVEN_UP = AlarmKind(
    "calibration_given_up",
    _PLANT,
    Severity.WARNING,
    "A heliostat was not calibrated in several visits to targets, the last of them alone with a "
    "search for its beam.",
    "{subject}: {count} visits to targets have not calibrated it; the last: {reason}",
    "It keeps the parameters that it has, and takes no target time from others for 16 hours; then "
    "it gets one visit a day. New parameters and a flight of a drone give it new visits.",
    "Look at its photographs (tab Heliostat), at its mirror and its drives; then press Calibrate "
    "now, or Out of service.",
    over="{subject}: it is calibrated, or gets new visits for new parameters",
)
RAISING_GIVEN_UP = AlarmKind(
    "raising_given_up",
    _PLANT,
    Severity.WARNING,
    "Within half an hour each a heliostat has left the receiver without an order, or could not go "
    "on from where it was, five times in a row.",
    "{subject}: it was raised {count} times in a row in vain; the last time it {reason}",
    "Automatic control does not raise it any more; after 16 hours it is raised once.",
    "Find the cause (tab Heliostat, tab Logs): its supply, its cluster or a fault; then give it "
    "back with Automatic.",
    over="{subject}: it is up, or a person has given it to automatic control again",
)
NOT_PARKED = AlarmKind(
    "not_parked",
    _PLANT,
    Severity.ALARM,
    "A heliostat was taken out of service, and was not seen in stow within five minutes.",
    "{subject}: it is out of service and not in stow: {reason}",
    "STOW is sent to it once a minute until it is seen in stow.",
    "Nobody may go to its mirror: its beam is where its state says, or unknown. Check its fault, "
    "its supply and its cable.",
    over="{subject}: it is in stow, or was given back to service",
)
VISITS_FAIL = AlarmKind(
    "visits_fail",
    _PLANT,
    Severity.WARNING,
    "Visits to a target or receiver have come to nothing several times in a row, through no fault "
    "of one heliostat.",
    "{subject}: {count} visits in a row have come to nothing; the last: {reason}",
    "Nothing is calibrated there but what a person asks for; each hour there is one more visit.",
    "Check its camera, the light on it and its view; then press Calibrate now.",
    over="{subject}: a visit has brought a result",
)
SENSOR = AlarmKind(
    "sensor",
    _PLANT,
    Severity.ALARM,
    "A sensor gives no reading.",
    "sensor {subject}: {problem}",
    "Once its last reading is stale, the safety table counts the worst case.",
    "Check the program that writes its file, or the camera of the receiver.",
    over="sensor {subject}: its readings come again",
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
    "A local controller does not answer; an alarm if its beam was out when it was last heard.",
    "{subject}: no answer for {silence:g} s; {last}",
    "The cluster keeps polling it.",
    "Assume that its beam has not moved; check its supply and its cable.",
    over="{subject}: it answers again",
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
    "Its reports are ignored, so it counts as silent.",
    "Install the same firmware version on heliostat and cluster.",
    over="{subject}: its state is known again",
)
SUN_JUMPED = AlarmKind(
    "sun_jumped",
    _CLUSTER,
    Severity.WARNING,
    "A local controller was sent a sun that cannot follow from the one before.",
    "{subject}: its cluster sent a sun that cannot follow from the one before",
    "It refused that sun, or took it after a lapse; if it was tracking, it has turned away.",
    "Check the clock, the time source and the site of the cluster.",
    over="{subject}: no jump for a minute; another shows only once its local controller restarts",
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
    "The cluster obeys the plant that it belongs to; of the other it takes only DEFOCUS, STOW and "
    "EMERGENCY.",
    "Switch the second plant off; a run is named after the UTC time at which its plant started.",
    over="the second plant has not asked for a minute",
)
BUS_KEY_MISSING = AlarmKind(
    "bus_key_missing",
    _CLUSTER,
    Severity.ALARM,
    "Local controllers have a key of the bus, and their cluster has none.",
    "cluster {cluster} has no key of its bus, and {heliostats} obey signed frames only",
    "They get no sun from it: they defocus and stow by themselves. DEFOCUS and STOW still reach "
    "them.",
    "Name the file of the key in the cluster file (bus_key), and start the cluster again; to give "
    "signed frames up, name one that heliotrope keys bus off has made.",
    over="cluster {cluster}: no local controller obeys signed frames only",
)
BUS_UNSIGNED = AlarmKind(
    "bus_unsigned",
    _CLUSTER,
    Severity.WARNING,
    "A cluster signs its frames, and local controllers have not the key of the bus.",
    "cluster {cluster} signs its frames, and {heliostats} have not the key of its bus: {why}",
    "The cluster gives them the key as soon as it can. Until then they obey a stranger on the wire "
    "too, or, with another key or older firmware, get no sun.",
    "Stow them; if the alarm stays, check their keys in the cluster's key file and their firmware.",
    over="cluster {cluster}: all local controllers that answer have the key of the bus",
)
TIME_SOURCE = AlarmKind(
    "time_source",
    _CLUSTER,
    Severity.WARNING,
    "Nothing keeps the cluster's clock, or its receiver and its clock contradict each other.",
    "{problem}",
    "The cluster goes on; it defocuses when the error of its time passes 1 s.",
    "Run chronyc sources on that computer, and check antenna and receiver.",
    over="the cluster's clock is kept again",
)
AUTONOMY_LIMITED = AlarmKind(
    "autonomy_limited",
    _CLUSTER,
    Severity.WARNING,
    "The plant grants more autonomy than the cluster is configured for.",
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
    "The cluster goes on; after a restart without a known time, local controllers may refuse its "
    "commands.",
    "Check the cluster's disk.",
    over="the cluster's epoch is stored again",
)

#: All kinds of alarm, by name.
KINDS: dict[str, AlarmKind] = {
    kind.name: kind for kind in tuple(globals().values()) if isinstance(kind, AlarmKind)
}
