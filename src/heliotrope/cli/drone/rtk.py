"""``heliotrope drone rtk``: how well the drone's RTK positions are known (HelioPoint, A)."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from heliotrope.cli import _calibration as calibration
from heliotrope.cli._common import print_json, print_table
from heliotrope.cli.drone import _shared as shared


def rtk(
    folder: shared.FolderArgument,
    field: shared.FieldOption,
    camera: shared.CameraOption = None,
    commands: shared.CommandsOption = None,
    cluster: shared.ClusterOption = "",
    point: shared.PointOption = "",
    survey_mm: shared.SurveyOption = 10.0,
    out: shared.OutOption = Path("out/drone"),
    processes: shared.ProcessesOption = 0,
    scheduler: calibration.SchedulerOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Compare RTK's positions with those that the photographs themselves give."""
    import numpy as np

    from heliotrope.airborne.evaluate.bundle import Priors
    from heliotrope.airborne.evaluate.evaluation import check_rtk

    flight = shared.open_flight(folder, field, camera, commands, cluster, point, None)
    seen = shared.read_flight(flight, out / "photographs", processes, scheduler, as_json)
    check, problems = check_rtk(
        flight.photos, seen, flight.camera, flight.stand, Priors(position=1e-3 * survey_mm)
    )
    for line in (*flight.problems, *problems):
        print(f"heliotrope: {line}", file=sys.stderr)
    if as_json:
        print_json(
            {
                "photographs": check.names,
                "told_less_photogrammetry_m": check.difference,
                "common_offset_m": check.mean,
                "common_offset_sigma_m": check.mean_sigma,
                "sigma_m": check.sigma,
                "covariance_m2": check.covariance,
                "photogrammetry_sigma_m": check.photogrammetry,
            }
        )
        return
    scale = np.array([1e3, 1e3, 1e3])
    columns = (check.mean, check.mean_sigma, check.sigma, check.photogrammetry)
    rows = [
        [axis, *(f"{column[k] * scale[k]:.1f}" for column in columns)]
        for k, axis in enumerate(("east", "north", "up"))
    ]
    print_table(
        ["axis", "common offset", "± of it", "σ of one", "of that photogrammetry"],
        rows,
        f"RTK less photogrammetry, {len(check.names)} photographs, mm",
    )
    body = [
        [axis, *(f"{1e6 * v:.1f}" for v in row)]
        for axis, row in zip(("east", "north", "up"), check.covariance, strict=True)
    ]
    print_table(["mm²", "east", "north", "up"], body, "Covariance of one position")
