"""``heliotrope surface``: learn the surface of a mirror from photographs of its beam."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from heliotrope.cli._common import open_plant, print_json

if TYPE_CHECKING:
    from heliotrope.field.heliostats import Facets
    from heliotrope.field.plant import Plant


def surface(
    place: Annotated[Path, typer.Argument(help="Plant file or folder.")],
    photographs: Annotated[
        Path,
        typer.Argument(
            help="Folder with pictures that show exactly one target, and PAINT's calibration "
            "properties of each."
        ),
    ],
    heliostat: Annotated[str, typer.Option(help="Heliostat whose beam the pictures show.")],
    learn: Annotated[
        int,
        typer.Option(
            min=1,
            max=64,
            help="Number of photographs to learn from; the others are used as a test.",
        ),
    ] = 8,
    out: Annotated[
        Path | None, typer.Option(help="Write the slope map here, .npz or .csv.")
    ] = None,
    pictures: Annotated[
        Path | None, typer.Option(help="Draw measured and predicted beams into this PNG.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Learn the slopes of a mirror's facets, and predict its beams at suns that were not used.

    The accuracy of a predicted beam is 1 − ½ Σ|difference| / power, at the measured centroid.
    """
    import numpy as np

    from heliotrope.field.formats.slopes import write_slopes
    from heliotrope.imaging.beam_photographs import draw_beams, read_beams
    from heliotrope.optics import beam_accuracy, learn_surface
    from heliotrope.optics.learnt_surface import spread_over_suns

    plant = open_plant(place)
    result = read_beams(plant, photographs, heliostat)
    facets, focal = _design(plant, heliostat)
    used = spread_over_suns(result.photographs, learn) if result.photographs else []
    learnt = learn_surface([result.photographs[k] for k in used], facets, focal)
    rest = [k for k in range(len(result.names)) if k not in used]
    beams = [learnt.predict(photograph) for photograph in result.photographs]
    right = [beam_accuracy(p.beam, b) for p, b in zip(result.photographs, beams, strict=True)]
    slopes = learnt.slopes()
    if out is not None:
        write_slopes(out, slopes)
    if pictures is not None:
        shown = rest or used
        draw_beams(pictures, [(result.photographs[k].beam, beams[k]) for k in shown])
    tested = [right[k] for k in rest]
    document = {
        "heliostat": heliostat,
        "focal_m": focal if np.isfinite(focal) else None,
        "slope_rms_mrad": 1e3 * float(np.sqrt((slopes**2).mean())),
        "slope_error_mrad": 1e3 * learnt.slope_error,
        "learnt_from": {result.names[k]: right[k] for k in used},
        "tested_on": {result.names[k]: right[k] for k in rest},
        "median_accuracy": float(np.median(tested)) if tested else None,
        "left_out": list(result.left_out),
    }
    if as_json:
        print_json(document)
        return
    shape = (
        "flat facets" if not np.isfinite(focal) else f"facets with a focal length of {focal:g} m"
    )
    print(
        f"{heliostat}: slopes differ from those of {shape} by {document['slope_rms_mrad']:.2f} "
        f"mrad RMS; slope error {document['slope_error_mrad']:.2f} mrad"
    )
    print(
        f"learned from {len(used)} photographs: accuracy {np.median(learnt.accuracy):.3f} (median)"
    )
    if tested:
        low = np.quantile(tested, 0.1)
        print(
            f"tested on {len(rest)} others: accuracy {np.median(tested):.3f} (median), 90 % "
            f"above {low:.3f}"
        )
    for line in result.left_out:
        print(f"left out: {line}")


def _design(plant: "Plant", heliostat: str) -> "tuple[Facets, float]":
    """Return the designed facets of a heliostat and the focal length of each, m."""
    import numpy as np

    from heliotrope.optics import equal_facets

    group, row = plant.find(heliostat)
    known = None if group.surface is None else group.surface.focal
    focal = float("inf") if known is None else float(np.median(known[row]))
    if group.facets is None:
        return equal_facets(
            float(group.width[row]), float(group.height[row]), (1, 1), np.inf
        ), focal
    return group.facets.take(np.array([row])), focal
