"""``heliotrope drone rtk``: the accuracy of the drone's RTK positions (HelioPoint, appendix A)."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from heliotrope.cli import _calibration as calibration
from heliotrope.cli._common import open_plant, print_json, print_table
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
    """Compare RTK positions with those from the photographs alone."""
    from heliotrope.airborne.evaluate.bundle import Priors
    from heliotrope.airborne.evaluate.folder import designed_shape, open_flight
    from heliotrope.airborne.evaluate.reading import read_many
    from heliotrope.airborne.evaluate.rtk import check_rtk

    plant = open_plant(field)
    flight = open_flight(folder, plant, designed_shape(plant), camera, commands, cluster, point)
    with (
        calibration.connected(scheduler) as client,
        calibration.progress("reading", as_json) as advance,
    ):
        seen = read_many(
            flight.photos,
            flight.camera,
            flight.stand,
            processes=shared.cores(processes),
            client=client,
            keep=out / "photographs",
            progress=advance,
        )
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
                "rtk_sigma_m": check.rtk,
                "rtk_sigma_95_m": check.rtk_range,
                "covariance_m2": check.covariance,
                "photogrammetry_sigma_m": check.photogrammetry,
            }
        )
        return
    columns = (check.mean, check.mean_sigma, check.sigma, check.photogrammetry, check.rtk)
    low, high = 1e3 * check.rtk_range
    rows = [
        [axis, *(f"{1e3 * column[k]:.1f}" for column in columns), f"{low[k]:.1f} to {high[k]:.1f}"]
        for k, axis in enumerate(("east", "north", "up"))
    ]
    print_table(
        ["axis", "common offset", "± of it", "σ of both", "of photogrammetry", "of RTK", "95 %"],
        rows,
        f"RTK less photogrammetry, {len(check.names)} photographs, mm",
    )
    body = [
        [axis, *(f"{1e6 * v:.1f}" for v in row)]
        for axis, row in zip(("east", "north", "up"), check.covariance, strict=True)
    ]
    print_table(["mm²", "east", "north", "up"], body, "Covariance of one difference")
