"""Explains why a heliostat tracks or not, what happens next, and what an operator can do."""

from datetime import UTC, datetime

from heliotrope.errors import once
from heliotrope.links.messages import Stage
from heliotrope.plant.controller import PlantController
from heliotrope.plant.field.state import HeliostatState
from heliotrope.plant.operations.automatic import AutomaticControl
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.views import Button, Explanation, LastOrder
from heliotrope.store.records import Kind

#: Reason, what follows by itself, what an operator can do, and the command that does it.
_Case = tuple[str, str, str, Button]

_AIMED_BY_HAND = (
    "an operator has aimed it, so its beam stays there",
    "Press Automatic to return it to automatic control.",
    Button.AUTOMATIC,
)


def explain(
    plant: PlantController,
    automatic: AutomaticControl,
    logbook: Logbook,
    name: str,
    on: str,
    *,
    by_hand: bool = False,
) -> Explanation:
    """Explain why a heliostat tracks or not.

    Parameters
    ----------
    plant, automatic, logbook
        The running plant.
    name
        Heliostat.
    on
        Receiver or target at which the heliostat aims; empty if there is none.
    by_hand
        Whether an operator has aimed it, so that the aims under the flux limit leave it there.

    Raises
    ------
    UnknownNameError
        If there is no such heliostat.
    """
    shown = plant.field.of(name, plant.now())
    tracks = (
        shown.live
        and shown.state == "TRACKING"
        and on in {receiver.name for receiver in plant.design.receivers}
    )
    why, follows, remedy, button = _case(plant, automatic, shown, tracks=tracks)
    if tracks and by_hand and not why:
        why, remedy, button = _AIMED_BY_HAND
    alarms = tuple(row for row in logbook.alarms() if row.subject == name and row.active)
    if alarms and not remedy:
        remedy = "See its alarm."
    where = f" on {on}" if on and shown.live else ""
    text = once(f"{name} is {shown.condition}{where}{why and f': {why}'}")
    order = _last_order(plant, name)
    return Explanation(name, tracks, text, follows, remedy, button, order, alarms)


def _case(
    plant: PlantController,
    automatic: AutomaticControl,
    shown: HeliostatState,
    *,
    tracks: bool,
) -> _Case:
    """Return the first applicable reason among the reasons that take precedence over all others."""
    name = shown.name
    if held := plant.lockouts.text(Kind.HELIOSTAT, name):
        return (
            f"it is out of service: {held}",
            "It does not move until each owner has returned their lock.",
            "When nobody is at the heliostat any longer, return the lock, then press Automatic.",
            Button.RETURN_LOCK,
        )
    if not shown.live:
        return (
            (
                f"its cluster {shown.cluster} receives no reply from it, or the plant receives "
                f"nothing from the cluster"
            ),
            (
                "The cluster keeps polling it; a board that receives no messages turns the mirror "
                "away by itself."
            ),
            f"Check cluster {shown.cluster} (tab Clusters), and the board's supply and bus.",
            Button.NONE,
        )
    if plant.sentinel.on:
        causes = "; ".join(f"{who}: {text}" for who, text in plant.sentinel.causes().items())
        return (
            f"an emergency is active ({causes})",
            "Its beam stays off the receiver; after the emergency, nothing moves by itself.",
            "When the cause is gone, "
            + ("withdraw the order, then " if plant.sentinel.calls else "")
            + "press Resume.",
            Button.WITHDRAW if plant.sentinel.calls else Button.RESUME,
        )
    if shown.state == "LOCKED":
        button = Button.NONE if name in plant.authority.visited() else Button.UNLOCK
        return plant.locked_for(name), "It does not move while it is locked.", "", button
    if shown.state == "FAULT":
        return (
            f"its board has detected a fault: {shown.fault}",
            "It does not move until the fault is cleared.",
            "Find the cause at the heliostat, then clear the fault.",
            Button.CLEAR_FAULT,
        )
    if shown.state == "UNCONFIGURED":
        return (
            "its board stores no parameters",
            "It moves only to defocus or to stow until its parameters are stored.",
            "An engineer stores its parameters (heliotrope run --configure).",
            Button.NONE,
        )
    if (run := automatic.visit_of(name)) is not None:
        follows = "It returns to the receiver when the visit has ended."
        return f"it is being calibrated at {run.target}: {run.stage}", follows, "", Button.NONE
    return _automatic_case(automatic, name, tracks=tracks)


def _automatic_case(automatic: AutomaticControl, name: str, *, tracks: bool) -> _Case:
    """Return the reason why a heliostat is not on the receiver, or its next step."""
    planned = next((visit for visit in automatic.plan(50) if visit.heliostat == name), None)
    follows = ""
    if planned is not None:
        at = datetime.fromtimestamp(planned.at, UTC)
        follows = f"Its next measurement is planned for {at:%H:%M} UTC on {planned.target}."
    if tracks:
        return "", follows, "", Button.NONE
    if automatic.left_by_emergency(name):
        return (
            "an emergency has taken it out of automatic control",
            "It stays where it is.",
            (
                "Press Resume to return all heliostats to automatic control, or Automatic to "
                "return only this one."
            ),
            Button.RESUME,
        )
    if not automatic.wants(name):
        return (
            "it is not under automatic control",
            "It stays as it is; nothing stows it before the night unless an operator does.",
            "Press Automatic, or command it yourself.",
            Button.AUTOMATIC,
        )
    if automatic.waits:
        return (
            automatic.waits,
            "Automatic control raises no heliostat until an operator presses Resume.",
            "Make sure that nobody is in the field, then resume.",
            Button.RESUME,
        )
    step = automatic.following(-float("inf"), (name,))[name]
    tried = next((retry for retry in automatic.retries() if retry.subject == name), None)
    if tried is not None:
        again = "at the next opportunity" if tried.left == 0.0 else f"in {tried.left:.0f} s"
        again = "not by itself" if tried.left == float("inf") else again
        follows = (
            f"{tried.work}: {tried.count} of {tried.most} attempts have failed ({tried.reason}); "
            f"the next attempt is {again}; after the last, {tried.following}."
        )
    remedy = ""
    if step.stage is Stage.DONE and automatic.needs_calibration(name):
        off = automatic.view().reason
        if off:
            follows = f"It stays at standby while calibration is off: {off}."
        else:
            remedy = "Press Calibrate now to calibrate it before the others."
    if not follows and step.stage is not Stage.FAILED:
        follows = "It continues by itself."
    return step.text, follows, remedy, Button.NONE


def _last_order(plant: PlantController, name: str) -> LastOrder | None:
    found = plant.last_order(name)
    if found is None:
        return None
    record, ticket = found
    stage = ticket.stage(name)
    text = ticket.refusals.get(name, "") or ticket.steps.get(name, "")
    result = "waiting in the plant's queue" if stage is None else stage.value
    at = datetime.fromisoformat(record.at).timestamp()
    note = f" ({record.note})" if record.note else ""
    return LastOrder(at, record.who, f"{record.what}{note}", f"{result}{text and f': {text}'}")
