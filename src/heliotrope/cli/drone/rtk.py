"""``heliotrope drone rtk``: the accuracy of the drone's RTK positions (HelioPoint, appendix A)."""

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from heliotrope.cli import _calibration as calibration
from heliotrope.cli._common import open_plant, print_json, print_table
from heliotrope.cli.drone import _shared as shared

if TYPE_CHECKING:
    from heliotrope.airborne.evaluate.rtk import RtkCheck

_AXES = ("east", "north", "up")


def rtk(
    folder: shared.FolderArgument,
    field: shared.FieldOption,
    camera: shared.CameraOption = None,
    commands: shared.CommandsOption = None,
    cluster: shared.ClusterOption = "",
    point: shared.PointOption = "",
    targets: Annotated[
        bool,
        typer.Option(
            "--targets",
            help="Use the coded targets of `drone dome` instead of mirrors; commands.csv is not "
            "needed.",
        ),
    ] = False,
    survey_mm: shared.SurveyOption = 10.0,
    out: shared.OutOption = Path("out/drone"),
    processes: shared.ProcessesOption = 0,
    scheduler: calibration.SchedulerOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Compare RTK positions with positions derived from the photographs alone."""
    from heliotrope.airborne.evaluate.bundle import Priors
    from heliotrope.airborne.evaluate.folder import designed_shape, open_flight
    from heliotrope.airborne.evaluate.reading import read_many
    from heliotrope.airborne.evaluate.rtk import check_rtk
    from heliotrope.airborne.evaluate.rtk_figure import rtk_drawing
    from heliotrope.files.text import write_text

    if targets:
        check, problems = _by_targets(folder, field, camera)
    else:
        plant = open_plant(field)
        flight = open_flight(folder, plant, designed_shape(plant), camera, commands, cluster, point)
        with (
            calibration.connected(scheduler) as client,
            calibration.progress("reading", as_json) as advance,
        ):
            readings = read_many(
                flight.photos,
                flight.camera,
                flight.stand,
                processes=shared.cores(processes),
                client=client,
                keep=out / "photographs",
                progress=advance,
            )
        priors = Priors(position=1e-3 * survey_mm)
        check, unusable = check_rtk(flight.photos, readings, flight.camera, flight.stand, priors)
        problems = (*flight.problems, *unusable)
    for line in problems:
        print(f"heliotrope: {line}", file=sys.stderr)
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "rtk.svg", rtk_drawing(check) + "\n")
    if as_json:
        print_json(_document(check))
        return
    _show(check)
    print(f"written to {out / 'rtk.svg'}: the differences along each axis")


def _by_targets(
    folder: Path, field: Path, camera: Path | None
) -> "tuple[RtkCheck, tuple[str, ...]]":
    from heliotrope.airborne.evaluate.coded import read_targets
    from heliotrope.airborne.evaluate.rtk import check_rtk_by_targets
    from heliotrope.airborne.photo import read_camera, read_photos

    site = open_plant(field).site
    photos, lines = read_photos(folder, (site.latitude_deg, site.longitude_deg, site.height))
    lens = read_camera(camera or folder / "camera.toml")
    check, _, problems = check_rtk_by_targets(photos, read_targets(photos, lens), lens)
    return check, (*lines, *problems)


def _document(check: "RtkCheck") -> dict[str, object]:
    return {
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


def _show(check: "RtkCheck") -> None:
    columns = (check.mean, check.mean_sigma, check.sigma, check.photogrammetry, check.rtk)
    low, high = 1e3 * check.rtk_range
    rows = [
        [
            axis,
            *(_mm(c[k]) for c in columns),
            f"{low[k]:.1f} to {high[k]:.1f}",
        ]
        for k, axis in enumerate(_AXES)
    ]
    print_table(
        [
            "axis",
            "common offset",
            "σ of the offset",
            "σ of one difference",
            "σ of photogrammetry",
            "σ of RTK",
            "95 %",
        ],
        rows,
        f"RTK minus photogrammetry, {len(check.names)} photographs, mm",
    )
    body = [
        [axis, *(f"{1e6 * v:.1f}" for v in row)]
        for axis, row in zip(_AXES, check.covariance, strict=True)
    ]
    print_table(["mm²", *_AXES], body, "Covariance of one difference")


def _mm(value: float) -> str:
    """Return metres as mm; a dash if the value is unknown."""
    return f"{1e3 * value:.1f}" if math.isfinite(value) else "–"
