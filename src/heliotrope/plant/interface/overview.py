"""The state of the plant at one moment, which the live stream sends with the field's rows."""

from typing import Any

from heliotrope.errors import HeliotropeError
from heliotrope.plant.interface.encoding import plain
from heliotrope.plant.operations.operations import Operations
from heliotrope.plant.operations.views import ClusterRow

#: Health of a cluster, which determines its colour on the page.
WELL, TROUBLED, SILENT = 0, 1, 2


def overview(operations: Operations) -> dict[str, Any]:
    """Return the overview: views and numbers, not yet converted to JSON values."""
    summary, light = operations.summary(), operations.sun()
    calibration = operations.automatic.view()
    cameras = {}
    for target in operations.targets:
        try:
            cameras[target] = operations.camera(target).version
        except HeliotropeError:
            continue
    found: dict[str, Any] = plain(summary)
    return found | {
        "utc": summary.at.timestamp(),
        "sun": {"azimuth": light.azimuth, "elevation": light.elevation},
        "surfaces": operations.viewer.aim_names,
        "clusters": [_health(row) for row in operations.logbook.cluster_rows(operations.plant)],
        "measuring": calibration.running,
        "calibration": {
            "on": calibration.on,
            "reason": calibration.reason,
            "done": calibration.done,
            "waiting": calibration.waiting,
            "failed": calibration.failed,
            "quality": calibration.quality[-1] if calibration.quality else None,
        },
        "cameras": cameras,
        "changes": len(operations.approvals.waiting),
        "order": operations.viewer.emergency(),
        "events": _newest(operations),
    }


def _newest(operations: Operations) -> float:
    """Return the time of the last event, POSIX s; 0 if there is none yet."""
    events = operations.logbook.events(1)
    return events[0].at if events else 0.0


def _health(row: ClusterRow) -> int:
    if not row.alive:
        return SILENT
    # NaN means not yet known, and is not a problem.
    return TROUBLED if row.live < row.heliostats or row.answered < 0.95 or row.acts else WELL
