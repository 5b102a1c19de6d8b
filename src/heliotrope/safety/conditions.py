"""The rows of the safety table.

Numbers are defaults; a plant adjusts them to its receiver, mirrors and weather. Those of the
wind are common for heliostats of tens of square metres and must be replaced by the maker's.
"""

import math

from heliotrope.errors import InputError
from heliotrope.safety.condition import Act, Condition, Role, Scope, Severity, Watcher

_PLANT, _CLUSTER, _NODE = Watcher.PLANT, Watcher.CLUSTER, Watcher.NODE
_ALARM, _REFUSE, _HOLD, _DEFOCUS, _STOW = Act
_HELIOSTAT, _BUS, _FIELD = Scope
_INFO, _WARNING, _SERIOUS, _EMERGENCY = Severity
_OPERATOR, _SUPERVISOR = Role

#: Lease of the plant to a cluster, and of a cluster's sun to its local controllers, s.
PLANT_LEASE, SUN_LEASE = 3.0, 6.0
#: From a defocus that nobody lifts to stowing, s.
_PATIENCE = 30.0


def conditions(autonomy: float = 0.0) -> tuple[Condition, ...]:
    """Return the table.

    Parameters
    ----------
    autonomy
        How long clusters may go on without the plant, s. Above 0 only where a hard-wired
        emergency line reaches every cluster.

    Raises
    ------
    InputError
        If ``autonomy`` is negative or not finite.
    """
    if not (math.isfinite(autonomy) and autonomy >= 0.0):
        raise InputError(f"autonomy {autonomy} s must be 0 or more and finite")
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
            "operator_emergency", _PLANT, "emergency_order", "1", "emergency order",
            0.5, 0.4, _DEFOCUS, _FIELD, _EMERGENCY, 30.0, then_stow=_PATIENCE,
            role=_OPERATOR, release="order withdrawn",
        ),
        Condition(
            "emergency_line", _CLUSTER, "emergency_line_live", "1", "current in the emergency line",
            0.5, 0.6, _DEFOCUS, _FIELD, _EMERGENCY, 30.0, then_stow=_PATIENCE, stale_after=1.0,
            role=_SUPERVISOR, release="line closed again",
        ),
        Condition(
            "nodes_unacknowledged", _PLANT, "nodes_unacknowledged", "1",
            "number of nodes that have not acknowledged the emergency", 1.0, 0.0, _DEFOCUS,
            _FIELD, _EMERGENCY, 30.0, then_stow=_PATIENCE, role=_OPERATOR,
            release="every node has acknowledged, or the emergency is over",
        ),
        Condition(
            "flux_after_emergency", _PLANT, "flux_after_emergency", "1",
            "share of the nominal flux after an emergency", 0.10, 0.08, _STOW, _FIELD,
            _EMERGENCY, 300.0, role=_SUPERVISOR, release="flux gone, or the emergency over",
        ),
        Condition(
            "authority_lost", _PLANT, "authority_silence", "s", "silence of the command authority",
            10.0, 5.0, _REFUSE, _FIELD, _WARNING, 15.0, ages=True,
            release="an authority is there again",
        ),
    )  # fmt: skip


def _receiver() -> tuple[Condition, ...]:
    return (
        Condition(
            "receiver_flux_high", _PLANT, "receiver_flux", "1", "receiver flux over its limit",
            1.0, 0.9, _DEFOCUS, _FIELD, _EMERGENCY, 30.0, delay=1.0, stale_after=5.0,
            clear_for=10.0, role=_OPERATOR, release="flux well below its limit",
        ),
        Condition(
            "receiver_temperature_high", _PLANT, "receiver_temperature", "1",
            "receiver temperature over its limit", 1.0, 0.95, _DEFOCUS, _FIELD, _EMERGENCY, 30.0,
            delay=1.0, stale_after=5.0, clear_for=60.0, role=_OPERATOR,
            release="temperature well below its limit",
        ),
        Condition(
            "receiver_flow_low", _PLANT, "receiver_flow", "1", "receiver flow over its demand",
            0.8, 0.9, _DEFOCUS, _FIELD, _EMERGENCY, 30.0, delay=1.0, stale_after=3.0,
            clear_for=30.0, role=_OPERATOR, release="flow back",
        ),
        Condition(
            "receiver_camera_lost", _PLANT, "receiver_camera_silence", "s",
            "silence of the receiver's camera", 10.0, 5.0, _REFUSE, _FIELD, _SERIOUS, 15.0,
            ages=True, clear_for=10.0, release="pictures come again",
        ),
    )  # fmt: skip


def _weather() -> tuple[Condition, ...]:
    return (
        Condition(
            "wind_gust_stow", _PLANT, "wind_gust", "m/s", "gust of wind (3 s)",
            20.0, 15.0, _STOW, _FIELD, _SERIOUS, 300.0, clear_for=600.0,
            release="gusts are weak",
        ),
        Condition(
            "wind_gust_defocus", _PLANT, "wind_gust", "m/s", "gust of wind (3 s)",
            15.0, 12.0, _DEFOCUS, _FIELD, _WARNING, 30.0, delay=3.0, clear_for=600.0,
            release="gusts are weak",
        ),
        Condition(
            "wind_mean_stow", _PLANT, "wind_mean", "m/s", "mean wind (600 s)",
            14.0, 11.0, _STOW, _FIELD, _SERIOUS, 300.0, clear_for=600.0,
            release="wind is weak",
        ),
        Condition(
            "wind_mean_defocus", _PLANT, "wind_mean", "m/s", "mean wind (600 s)",
            11.0, 9.0, _DEFOCUS, _FIELD, _WARNING, 30.0, clear_for=600.0,
            release="wind is weak",
        ),
        Condition(
            "sun_below_horizon", _PLANT, "sun_elevation", "rad", "elevation of the sun",
            0.0, 0.035, _STOW, _FIELD, _INFO, 300.0, clear_for=60.0, stale_after=10.0,
            release="sun is up",
        ),
    )  # fmt: skip


def _links(autonomy: float) -> tuple[Condition, ...]:
    return (
        Condition(
            "plant_link_lost", _CLUSTER, "plant_silence", "s", "silence of the plant",
            PLANT_LEASE + autonomy, 2.0, _DEFOCUS, _BUS, _SERIOUS, 30.0 + autonomy,
            then_stow=_PATIENCE, ages=True, release="heartbeats of the plant",
        ),
        Condition(
            "cluster_silent", _PLANT, "cluster_silence", "s", "silence of the cluster",
            PLANT_LEASE, 2.0, _DEFOCUS, _BUS, _SERIOUS, 30.0, then_stow=_PATIENCE, ages=True,
            release="heartbeats of the cluster",
        ),
        Condition(
            "broker_lost", _PLANT, "broker_silence", "s", "silence of the broker",
            PLANT_LEASE, 2.0, _REFUSE, _FIELD, _SERIOUS, 10.0, ages=True, clear_for=5.0,
            release="our heartbeats come back through it",
        ),
        Condition(
            "bus_errors", _CLUSTER, "bus_errors", "1", "share of bad frames on the bus (10 s)",
            0.2, 0.05, _REFUSE, _BUS, _WARNING, 20.0, delay=5.0, clear_for=30.0,
            release="bus is sound",
        ),
        Condition(
            "bus_failed", _CLUSTER, "bus_errors", "1", "share of bad frames on the bus (10 s)",
            0.9, 0.2, _DEFOCUS, _BUS, _SERIOUS, 30.0, then_stow=_PATIENCE, delay=2.0,
            clear_for=30.0, release="bus works",
        ),
        Condition(
            "sun_stale", _NODE, "sun_age", "s", "age of the sun vector",
            SUN_LEASE, 3.0, _DEFOCUS, _HELIOSTAT, _SERIOUS, 30.0, then_stow=_PATIENCE, ages=True,
            release="fresh sun vectors; a fresh command to track",
        ),
    )  # fmt: skip


def _time() -> tuple[Condition, ...]:
    return (
        Condition(
            "clock_jump", _CLUSTER, "clock_step", "s", "step of the time against the counter",
            0.5, 0.1, _DEFOCUS, _BUS, _SERIOUS, 30.0, then_stow=_PATIENCE, clear_for=10.0,
            role=_OPERATOR, release="time agrees again",
        ),
        Condition(
            "time_source_lost", _CLUSTER, "time_source_silence", "s", "silence of the time source",
            60.0, 10.0, _ALARM, _BUS, _WARNING, 65.0, ages=True, clear_for=10.0,
            release="time source back; until then holdover",
        ),
        Condition(
            "holdover_exhausted", _CLUSTER, "time_uncertainty", "s", "uncertainty of the time",
            1.0, 0.5, _DEFOCUS, _BUS, _SERIOUS, 30.0, then_stow=_PATIENCE, clear_for=10.0,
            release="time is known again",
        ),
    )  # fmt: skip


def _power_and_records() -> tuple[Condition, ...]:
    return (
        Condition(
            "ups_on_battery", _PLANT, "ups_on_battery", "1", "UPS on battery",
            0.5, 0.4, _DEFOCUS, _FIELD, _SERIOUS, 30.0, then_stow=_PATIENCE, delay=5.0,
            clear_for=60.0, release="mains back",
        ),
        Condition(
            "ups_charge_low", _PLANT, "ups_charge", "1", "charge of the UPS",
            0.5, 0.8, _STOW, _FIELD, _SERIOUS, 300.0, clear_for=60.0, stale_after=30.0,
            release="charged",
        ),
        Condition(
            "database_unwritable", _PLANT, "audit_silence", "s", "time without a confirmed write",
            5.0, 2.0, _REFUSE, _FIELD, _SERIOUS, 10.0, ages=True, clear_for=5.0,
            release="writes are confirmed",
        ),
    )  # fmt: skip


def _mirrors() -> tuple[Condition, ...]:
    return (
        Condition(
            "keep_out_predicted", _PLANT, "keep_out_predicted", "1",
            "predicted entry into a keep-out volume", 0.5, 0.4, _HOLD, _HELIOSTAT, _SERIOUS, 10.0,
            release="the checked way is clear",
        ),
        Condition(
            "node_faults", _PLANT, "node_fault_share", "1", "share of nodes that failed in 600 s",
            0.02, 0.01, _REFUSE, _FIELD, _WARNING, 20.0, delay=5.0, clear_for=60.0,
            role=_OPERATOR, release="few faults",
        ),
        Condition(
            "node_faults_many", _PLANT, "node_fault_share", "1",
            "share of nodes that failed in 600 s", 0.10, 0.05, _DEFOCUS, _FIELD, _SERIOUS, 30.0,
            delay=5.0, clear_for=60.0, role=_SUPERVISOR, release="few faults",
        ),
    )  # fmt: skip


#: The table at autonomy 0.
CONDITIONS = conditions()
