"""The rows of the safety table.

The limits are defaults. If a row has ``site``, a plant may set its limits to suit its receiver,
heliostats and weather (`limits`). The permitted ranges are our own. The wind limits are typical of
heliostats of tens of square metres; replace them with the manufacturer's.
"""

import math

from heliotrope.errors import InputError
from heliotrope.safety.condition import AcknowledgeRole, Act, Condition, Scope, Severity, Watcher

_PLANT, _CLUSTER, _NODE = Watcher.PLANT, Watcher.CLUSTER, Watcher.NODE
_ALARM, _REFUSE, _, _DEFOCUS, _STOW = Act
_HELIOSTAT, _BUS, _FIELD = Scope
_INFO, _WARNING, _SERIOUS, _EMERGENCY = Severity
_OPERATOR, _SUPERVISOR = AcknowledgeRole

#: Duration of the plant's lease to a cluster, and of the lease that a cluster's sun vector gives
#: its local controllers, s.
PLANT_LEASE, SUN_LEASE = 3.0, 6.0
#: Time from a DEFOCUS to STOW, unless the DEFOCUS is lifted, s.
_PATIENCE = 30.0
#: The same time if a cluster acts without the plant, s. A cluster does not know the keep-out
#: volumes; its DEFOCUS may have turned a beam into such a volume, where the beam must not stay for
#: 30 s.
_ALONE = 20.0


def conditions(autonomy: float = 0.0) -> tuple[Condition, ...]:
    """Return the safety table.

    Parameters
    ----------
    autonomy
        Time for which clusters may continue without the plant, s. Set it above 0 only if a
        hard-wired emergency line reaches every cluster.

    Raises
    ------
    InputError
        If ``autonomy`` is negative or not finite.
    """
    if not (math.isfinite(autonomy) and autonomy >= 0.0):
        raise InputError(f"autonomy must be finite and 0 or more, not {autonomy} s")
    return (
        *_orders(),
        *_receiver(),
        *_weather(),
        *_links(autonomy),
        *_time(),
        *_power_and_records(),
        *_mirrors(),
    )


def _orders() -> tuple[Condition, ...]:
    return (
        Condition(
            "operator_emergency", _PLANT, "emergency_order", "yes/no", "emergency order",
            "a user's emergency order is active",
            0.5, 0.4, _DEFOCUS, _FIELD, _EMERGENCY, 30.0, then_stow=_PATIENCE,
            role=_OPERATOR, release="the order is withdrawn",
            remedy="Keep people away from the receiver and the beams; find the cause, then withdraw"
            " the order and acknowledge.",
        ),
        Condition(
            "emergency_line", _CLUSTER, "emergency_line_live", "yes/no",
            "current in the emergency line", "the emergency line carries no current",
            0.5, 0.6, _DEFOCUS, _FIELD, _EMERGENCY, 30.0, then_stow=_PATIENCE, stale_after=1.0,
            role=_SUPERVISOR, release="the line is closed again",
            remedy="Find out who pressed the emergency button; if nobody did, check the line.",
        ),
        Condition(
            "nodes_unacknowledged", _PLANT, "nodes_unacknowledged", "count",
            "number of heliostats that have not acknowledged the emergency order",
            "heliostats that have not acknowledged the emergency order: {value}", 1.0, 0.0,
            _DEFOCUS, _FIELD, _EMERGENCY, 30.0, then_stow=_PATIENCE, role=_OPERATOR,
            release="every heliostat has acknowledged, or the emergency is over",
            remedy="The EMERGENCY banner names them. Assume that their beams have not moved; keep"
            " people away, and inspect each of them.",
        ),
        Condition(
            "flux_after_emergency", _PLANT, "flux_after_emergency", "share",
            "flux on the receiver after an emergency order, as a fraction of nominal",
            "flux on the receiver is {value} of nominal after an emergency order, or not known",
            0.10, 0.08, _STOW, _FIELD, _EMERGENCY, 300.0, role=_SUPERVISOR,
            release="the flux is gone, or the emergency is over",
            remedy="Look at the receiver from a safe place; find the heliostats whose beams are"
            " still on it.", site=(0.01, 0.10),
        ),
        Condition(
            "unproven_after_emergency", _PLANT, "unproven", "yes/no",
            "missing confirmation that it has carried out an emergency order",
            "an emergency has ended, but nothing shows that it has carried out the order", 0.5, 0.4,
            _DEFOCUS, _HELIOSTAT, _SERIOUS, 30.0, waiver=_SUPERVISOR,
            release="its reports show that it has carried out the order",
            remedy="Assume that its beam has not moved, and inspect the heliostat from a safe "
                "place. An engineer who has seen that the beam is off acknowledges the alarm for "
                "this heliostat.",
        ),
        Condition(
            "authority_lost", _PLANT, "authority_silence", "s",
            "time since the command authority was renewed",
            "nobody has renewed the command authority for {value}",
            10.0, 5.0, _REFUSE, _FIELD, _WARNING, 15.0, ages=True,
            release="someone has the command authority again",
            remedy="Take the command authority, or switch automatic control on.",
        ),
    )  # fmt: skip


def _receiver() -> tuple[Condition, ...]:
    return (
        Condition(
            "receiver_flux_high", _PLANT, "receiver_flux", "share",
            "flux on the receiver as a fraction of its limit",
            "flux on the receiver is {value} of its limit",
            1.0, 0.9, _DEFOCUS, _FIELD, _EMERGENCY, 30.0, delay=1.0, stale_after=5.0,
            clear_for=10.0, role=_OPERATOR, release="the flux is well below its limit",
            remedy="Let the receiver cool; return with fewer heliostats or other aim points.",
            site=(0.5, 1.0),
        ),
        Condition(
            "receiver_temperature_high", _PLANT, "receiver_temperature", "share",
            "temperature of the receiver as a fraction of its limit",
            "temperature of the receiver is {value} of its limit", 1.0, 0.95, _DEFOCUS, _FIELD,
            _EMERGENCY, 30.0, delay=1.0, stale_after=5.0, clear_for=60.0, role=_OPERATOR,
            release="the temperature is well below its limit",
            remedy="Check the flow first, then the aim points.", site=(0.5, 1.0),
        ),
        Condition(
            "receiver_flow_low", _PLANT, "receiver_flow", "share",
            "flow through the receiver as a fraction of demand",
            "flow through the receiver is {value} of demand",
            0.8, 0.9, _DEFOCUS, _FIELD, _EMERGENCY, 30.0, delay=1.0, stale_after=3.0,
            clear_for=30.0, role=_OPERATOR, release="the flow is back",
            remedy="Check pumps and valves before the field returns.", site=(0.5, 1.0),
        ),
        Condition(
            "receiver_camera_lost", _PLANT, "receiver_camera_silence", "s",
            "time since the last picture of the receiver camera",
            "no picture from the receiver camera for {value}",
            10.0, 5.0, _REFUSE, _FIELD, _SERIOUS, 15.0, ages=True, clear_for=10.0,
            release="pictures arrive again", remedy="Check the camera and its network.",
            site=(6.0, 15.0),
        ),
    )  # fmt: skip


def _weather() -> tuple[Condition, ...]:
    return (
        Condition(
            "wind_gust_stow", _PLANT, "wind_gust", "m/s", "wind gust (3 s)",
            "wind gust of {value}", 20.0, 15.0, _STOW, _FIELD, _SERIOUS, 300.0, clear_for=600.0,
            release="gusts have dropped",
            remedy="Wait; walk the field before heliostats leave stow.", site=(5.0, 30.0),
        ),
        Condition(
            "wind_gust_defocus", _PLANT, "wind_gust", "m/s", "wind gust (3 s)",
            "wind gust of {value}", 15.0, 12.0, _DEFOCUS, _FIELD, _WARNING, 30.0, delay=3.0,
            clear_for=600.0, release="gusts have dropped", remedy="Wait for the wind to drop.",
            site=(4.0, 25.0),
        ),
        Condition(
            "wind_mean_stow", _PLANT, "wind_mean", "m/s", "mean wind (600 s)",
            "mean wind of {value}", 14.0, 11.0, _STOW, _FIELD, _SERIOUS, 300.0, clear_for=600.0,
            release="the wind has dropped",
            remedy="Wait; walk the field before heliostats leave stow.", site=(4.0, 22.0),
        ),
        Condition(
            "wind_mean_defocus", _PLANT, "wind_mean", "m/s", "mean wind (600 s)",
            "mean wind of {value}", 11.0, 9.0, _DEFOCUS, _FIELD, _WARNING, 30.0,
            clear_for=600.0, release="the wind has dropped", remedy="Wait for the wind to drop.",
            site=(3.0, 20.0),
        ),
        Condition(
            "cold", _PLANT, "temperature", "°C", "air temperature",
            "the air is at {value}: ice may block the drives, and a stalled drive reports "
            "steps that the mirror has not made", 1.0, 4.0, _REFUSE, _FIELD, _WARNING, 65.0,
            clear_for=1800.0, stale_after=60.0, release="the air is warm again",
            remedy="Wait until it is warmer; check the mirrors for ice before heliostats leave "
                "stow.", site=(-20.0, 20.0),
        ),
        Condition(
            "sun_below_horizon", _PLANT, "sun_elevation", "rad", "elevation of the sun",
            "the sun is down: its elevation is {value}", 0.0, 0.035, _STOW, _FIELD, _INFO, 300.0,
            clear_for=60.0, stale_after=10.0, release="the sun is up",
            remedy="Nothing to do.", site=(0.0, math.radians(20.0)),
        ),
    )  # fmt: skip


def _links(autonomy: float) -> tuple[Condition, ...]:
    return (
        Condition(
            "plant_link_lost", _CLUSTER, "plant_silence", "s",
            "time since the plant renewed its lease", "no lease from the plant for {value}",
            PLANT_LEASE + autonomy, 2.0, _DEFOCUS, _BUS, _SERIOUS, 30.0 + autonomy,
            then_stow=_ALONE, ages=True, release="leases of the plant arrive again",
            remedy="Check the plant, the network and the broker.",
        ),
        Condition(
            "cluster_silent", _PLANT, "cluster_silence", "s",
            "time since the last status of the cluster",
            "no status from the cluster for {value}", PLANT_LEASE, 2.0, _DEFOCUS, _BUS, _SERIOUS,
            30.0, then_stow=_PATIENCE, ages=True, release="the cluster reports again",
            remedy="Check the cluster's computer and its link; the tab Clusters shows why.",
        ),
        Condition(
            "broker_lost", _PLANT, "broker_silence", "s",
            "time since a heartbeat came back from the broker",
            "no heartbeat back from the broker for {value}",
            PLANT_LEASE, 2.0, _REFUSE, _FIELD, _SERIOUS, 10.0, ages=True, clear_for=5.0,
            release="heartbeats come back from the broker",
            remedy="Check Mosquitto and the computer on which it runs.",
        ),
        Condition(
            "bus_errors", _CLUSTER, "bus_errors", "share",
            "share of bad frames on the bus over 10 s",
            "{value} of the frames on the bus are bad",
            0.2, 0.05, _REFUSE, _BUS, _WARNING, 20.0, delay=5.0, clear_for=30.0,
            release="the bus is sound again",
            remedy="Check the cable and the termination; look for a controller that transmits out "
                "of turn.",
            site=(0.02, 0.5),
        ),
        Condition(
            "bus_failed", _CLUSTER, "bus_errors", "share",
            "share of bad frames on the bus over 10 s",
            "{value} of the frames on the bus are bad",
            0.9, 0.2, _DEFOCUS, _BUS, _SERIOUS, 30.0, then_stow=_PATIENCE, delay=2.0,
            clear_for=30.0, release="the bus works again",
            remedy="Check the bus adapter and the cable; without the bus each heliostat defocuses"
            " by itself within 6 s.", site=(0.3, 0.95),
        ),
        Condition(
            "sun_stale", _NODE, "sun_age", "s", "age of the sun vector",
            "no sun vector for {value}", SUN_LEASE, 3.0, _DEFOCUS, _HELIOSTAT, _SERIOUS, 30.0,
            then_stow=_PATIENCE, ages=True,
            release="new sun vectors arrive; tracking needs a new command",
            remedy="Check its cluster; then command it to track again.",
        ),
    )  # fmt: skip


def _time() -> tuple[Condition, ...]:
    return (
        Condition(
            "cluster_time_differs", _PLANT, "cluster_time_off", "s",
            "difference between the cluster's time and the plant's",
            "the cluster's time differs from the plant's by {value}",
            2.0, 1.0, _DEFOCUS, _BUS, _SERIOUS, 30.0, then_stow=_PATIENCE, delay=3.0,
            clear_for=10.0, release="the two times agree again",
            remedy="Check the clocks of both computers; if every cluster differs, the plant's "
                "clock is wrong.", site=(0.2, 2.0),
        ),
        Condition(
            "cluster_site_differs", _PLANT, "cluster_sun_off", "rad",
            "angle between the sun vectors of the cluster's site and the plant's site",
            "the sun vector of the cluster's site is {value} off that of the plant's site",
            1e-3, 5e-4, _DEFOCUS, _BUS, _SERIOUS, 30.0, then_stow=_PATIENCE, delay=3.0,
            clear_for=10.0, release="the sun vectors of the two sites agree",
            remedy="Correct the table [site] of the cluster file, or the site in the plant file.",
            site=(1e-4, 1e-3),
        ),
        Condition(
            "clock_jump", _CLUSTER, "clock_step", "s",
            "step of the cluster's time against its monotonic clock",
            "the cluster's time stepped by {value}",
            0.5, 0.1, _DEFOCUS, _BUS, _SERIOUS, 30.0, then_stow=_PATIENCE, clear_for=10.0,
            role=_OPERATOR, release="the time agrees again",
            remedy="Check the time receiver and the clock; acknowledge when the time is right.",
            site=(0.2, 0.5),
        ),
        Condition(
            "time_source_lost", _CLUSTER, "time_source_silence", "s",
            "time since the time source was heard", "no time source for {value}",
            60.0, 10.0, _ALARM, _BUS, _WARNING, 65.0, ages=True, clear_for=10.0,
            release="the time source is back; until then the cluster runs on its own clock",
            remedy="Check the antenna and the receiver before the holdover ends.",
            site=(15.0, 65.0),
        ),
        Condition(
            "holdover_exhausted", _CLUSTER, "time_uncertainty", "s",
            "uncertainty of the cluster's time",
            "the cluster's time is uncertain by {value}",
            1.0, 0.5, _DEFOCUS, _BUS, _SERIOUS, 30.0, then_stow=_PATIENCE, clear_for=10.0,
            release="the time is known again", remedy="Check the antenna and the receiver.",
            site=(0.1, 1.0),
        ),
    )  # fmt: skip


def _power_and_records() -> tuple[Condition, ...]:
    return (
        Condition(
            "ups_on_battery", _PLANT, "ups_on_battery", "yes/no", "UPS on battery",
            "the UPS runs on battery: mains power is lost",
            0.5, 0.4, _DEFOCUS, _FIELD, _SERIOUS, 30.0, then_stow=_PATIENCE, delay=5.0,
            clear_for=60.0, release="mains power is back", remedy="Check the mains supply.",
            site=(0.5, 0.5),
        ),
        Condition(
            "ups_charge_low", _PLANT, "ups_charge", "share", "charge of the UPS",
            "charge of the UPS is {value}",
            0.5, 0.8, _STOW, _FIELD, _SERIOUS, 300.0, clear_for=60.0, stale_after=30.0,
            release="the UPS is charged", remedy="Restore the mains supply immediately.",
            site=(0.2, 0.9),
        ),
        Condition(
            "database_unwritable", _PLANT, "audit_silence", "s",
            "time since the audit log last confirmed a write",
            "the audit log has not confirmed a write for {value}",
            5.0, 2.0, _REFUSE, _FIELD, _SERIOUS, 10.0, ages=True, clear_for=5.0,
            release="writes are confirmed",
            remedy="Check the disk or the database; the alarm records gives the reason.",
            site=(3.0, 10.0),
        ),
    )  # fmt: skip


def _mirrors() -> tuple[Condition, ...]:
    return (
        Condition(
            "keep_out_predicted", _PLANT, "keep_out_predicted", "yes/no",
            "beam in or heading for a keep-out volume",
            "its beam is in a keep-out volume or heading for one", 0.5, 0.4, _DEFOCUS, _HELIOSTAT,
            _SERIOUS, 30.0, then_stow=_PATIENCE, or_stow=True,
            release="the beam and its path are clear",
            remedy="Keep people out of the volume until the alarm is over; then choose another aim"
            " point for the heliostat.", site=(0.5, 0.5),
        ),
        Condition(
            "beam_unsent", _PLANT, "beam_unsent", "yes/no",
            "beam on a receiver that was not sent there",
            "its beam is on a receiver, but it was not sent there", 0.5, 0.4, _DEFOCUS, _HELIOSTAT,
            _SERIOUS, 30.0, then_stow=10.0, or_stow=True, delay=5.0,
            release="the beam is off the receiver",
            remedy="If it stays there, inspect the heliostat; to hold it, lock it at stow.",
            site=(0.5, 0.5),
        ),
        Condition(
            "pointing_disagrees", _PLANT, "pointing_error", "rad",
            "angle between its beam (by its step counts) and its aim or standby point",
            "by its step counts its beam is {value} away from where it was sent",
            3e-3, 2e-3, _DEFOCUS,
            _HELIOSTAT, _SERIOUS, 30.0, delay=3.0, role=_OPERATOR,
            release="its step counts agree with its aim or standby point, or its beam is off",
            remedy="Check the parameters and the address of its local controller, and the time and"
            " the site of its cluster; then acknowledge.", site=(1e-3, 5e-3),
        ),
        Condition(
            "pointing_disagrees_many", _PLANT, "pointing_errors", "count",
            "number of heliostats whose step counts disagree with their aims or standby points",
            "by their step counts the beams of at least {value} heliostats are not where they were "
            "sent", 100.0, 20.0,
            _DEFOCUS, _FIELD, _SERIOUS, 30.0, then_stow=_PATIENCE, delay=3.0, role=_OPERATOR,
            release="fewer heliostats disagree",
            remedy="Check the plant computer's clock and the plant's site first, then the "
                "clusters.",
            site=(1.0, 200.0),
        ),
        Condition(
            "node_faults", _PLANT, "node_fault_share", "share",
            "share of the heliostats that failed within 600 s",
            "{value} of the heliostats failed within 600 s", 0.02, 0.01, _REFUSE, _FIELD,
            _WARNING, 20.0, delay=5.0, clear_for=60.0, role=_OPERATOR, release="few faults",
            remedy="Find out what they share: a cluster, a supply, a firmware version.",
            site=(0.002, 0.2),
        ),
        Condition(
            "node_faults_many", _PLANT, "node_fault_share", "share",
            "share of the heliostats that failed within 600 s",
            "{value} of the heliostats failed within 600 s", 0.10, 0.05, _DEFOCUS, _FIELD,
            _SERIOUS, 30.0, delay=5.0, clear_for=60.0, role=_SUPERVISOR, release="few faults",
            remedy="Find out immediately what they share: a cluster, a supply, a firmware version.",
            site=(0.01, 0.3),
        ),
    )  # fmt: skip


#: The safety table with autonomy 0.
CONDITIONS = conditions()
