"""Orientations beside a reference: HelioPoint's printed tables, and a flight with its truth."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import typer
from typer.testing import CliRunner

from heliotrope.airborne.evaluate.flight import evaluate_flight
from heliotrope.airborne.evaluate.orientation import measure
from heliotrope.airborne.evaluate.reference import (
    Compared,
    compare,
    offset_from,
    offsets,
    read_reference,
    reference_document,
    reference_rows,
)
from heliotrope.airborne.evaluate.reference_figures import sampling_figure
from heliotrope.airborne.evaluate.reference_page import offset_table, write_reference
from heliotrope.airborne.mirror import ideal
from heliotrope.airborne.simulate.rendering import render_flight
from heliotrope.airborne.simulate.simulation import Errors
from heliotrope.airborne.simulate.trial import TrialConditions, four_facets, trial_mirror
from heliotrope.cli.drone import simulate
from heliotrope.cli.drone.evaluate import evaluate as evaluate_command
from heliotrope.errors import FormatError, InputError
from heliotrope.field.formats import plant_file
from heliotrope.field.formats.slopes import read_slopes
from heliotrope.geometry import direction, normalize
from support.deflectometry_files import write_deflectometry
from support.drone_case import ORIGIN, camera, field, flight, plant

MIRRORS = field(2, 4)
MRAD = 1e-3
# HelioPoint, tables 4 and 5: azimuth and elevation, ° (ideal, measured, reference); table 3:
# rotX and rotY, mrad (ideal, measured).
PRINTED = {
    "894": (213.080, 213.080, 213.081, 13.609, 13.611, 13.616, -0.14, 0.00, -0.10, 0.01),
    "895": (214.057, 214.051, 214.054, 13.547, 13.550, 13.547, 0.01, -0.05, 0.05, 0.07),
    "913": (214.738, 214.736, 214.768, 14.948, 14.940, 14.934, 0.18, 0.54, 0.04, 0.55),
    "917": (215.060, 215.055, 215.067, 13.460, 13.450, 13.448, 0.19, 0.15, 0.00, 0.20),
    "1089": (213.318, 213.312, 213.311, 12.363, 12.362, 12.345, 0.34, -0.07, 0.31, 0.04),
}


def standing(azimuth_deg: float, elevation_deg: float) -> SimpleNamespace:
    """Return what is needed of an orientation: its normal and rotation."""
    out = direction(*np.radians([azimuth_deg, elevation_deg]))
    right = normalize(np.cross((0.0, 0.0, 1.0), out))
    return SimpleNamespace(normal=out, rotation=np.stack([right, np.cross(out, right), out], -1))


@pytest.mark.parametrize("name", PRINTED)
def test_table_3_follows_from_tables_4_and_5(name: str) -> None:
    """The paper's rotX raises the normal; ours, about the axis to the right, lowers it."""
    azimuth, elevation, turns = np.split(np.array(PRINTED[name]), [3, 6])
    reference = standing(azimuth[2], elevation[2]).normal
    for k in range(2):
        x, y = offset_from(reference, standing(azimuth[k], elevation[k]))
        # Angles are printed to 0.001° (0.017 mrad), and the mirror's axes are not quite level.
        np.testing.assert_allclose([-x, y], turns[2 * k : 2 * k + 2] * MRAD, atol=0.075 * MRAD)


def compared(count: int) -> list[Compared]:
    """Return mirrors with slopes, evaluated with and without their maps beside the truth."""
    found = []
    for seed in range(count):
        s = trial_mirror(four_facets(), TrialConditions(columns=9, rows=7), seed)
        start = (s.expected_rotation, s.vertex)
        ideal, measured = (
            measure(s.reflections, s.shape, *start, slopes=slopes) for slopes in (False, True)
        )
        found.append(Compared(f"M{seed}", s.rotation[:, 2], s.shape, ideal, measured))
    return found


def test_the_measured_surface_comes_closer_to_the_reference(tmp_path: Path) -> None:
    found = compared(6)
    ideal, measured = (offsets(found, surface) for surface in ("ideal", "measured"))
    assert ideal is not None
    assert measured is not None
    assert (measured.rms < 0.08 * MRAD).all()
    assert np.linalg.norm(ideal.rms) > 1.5 * np.linalg.norm(measured.rms)
    write_reference(found, tmp_path, page=False)
    table = pd.read_csv(tmp_path / "reference.csv", dtype={"heliostat": str})
    assert table["heliostat"].tolist() == [one.label for one in found]
    np.testing.assert_allclose(
        table["rot_x_measured_mrad"].mean(), measured.mean[0] / MRAD, atol=1e-9
    )
    # Elevation falls by rotX; azimuth falls by rotY over the cosine of the elevation.
    low = np.cos(np.radians(table["elevation_reference_deg"]))
    np.testing.assert_allclose(
        table["elevation_ideal_off_mrad"], -table["rot_x_ideal_mrad"], atol=0.01
    )
    np.testing.assert_allclose(
        table["azimuth_ideal_off_mrad"] * low, -table["rot_y_ideal_mrad"], atol=0.01
    )
    write_reference(found[:1], tmp_path)
    text = (tmp_path / "reference.html").read_text(encoding="utf-8")
    assert text.count("<img") == text.count("<section") == 1
    rows = offset_table(found)["rows"]
    assert [row[0] for row in rows[-3:]] == ["mean", "spread", "rms"]
    assert rows[-3][3] == f"{measured.mean[0] / MRAD:+.2f}"


def test_the_figure_shows_both_surfaces_and_the_slopes_at_their_place() -> None:
    shape = four_facets()
    slope = np.zeros((4, 6, 8, 2))
    # Facet 1 (lower right) rises to the right by 1 mrad; facet 2 (upper left) upwards.
    slope[1, ..., 0], slope[2, ..., 1] = 1.0 * MRAD, 1.0 * MRAD
    one = compared(1)[0]
    real = Compared("A", one.reference, shape.with_slopes(slope), one.ideal, one.measured)
    figure = sampling_figure(real)
    titles = [ax.get_title() for ax in figure.axes]
    assert titles[0::2][:2] == ["rotX, ideal surface", "rotX, measured surface"]
    assert titles[1::2][:2] == ["rotY, ideal surface", "rotY, measured surface"]
    for ax, facet in ((figure.axes[4], 2), (figure.axes[5], 1)):
        for k, mesh in enumerate(ax.collections):
            assert np.ma.max(mesh.get_array()) == pytest.approx(1.0 if k == facet else 0.0)
            middle = mesh.get_coordinates()[..., :2].mean(axis=(0, 1))
            np.testing.assert_allclose(middle, shape.center[k, :2], atol=1e-9)
        assert len(ax.collections) == 4
    assert "SDy" in titles[4]
    assert "SDx" in titles[5]
    # Without a map the sampling points are still there.
    alone = sampling_figure(Compared("A", one.reference, shape, one.ideal, None))
    assert [text.get_text() for text in alone.axes[2].texts] == ["no slope map"]
    assert sum(len(line.get_xdata()) for line in alone.axes[4].lines) == len(one.ideal.outlier)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("reference")
    flown = flight(Errors(), 2, 2, heliostats=MIRRORS, lens=camera(640, 480))
    render_flight(flown, place, ORIGIN, seed=1)
    simulate._write_truth(place / "truth", flown)
    plant_file.write_plant(plant(MIRRORS), place / "plant.toml")
    return place


def test_a_flight_is_compared_with_its_truth(folder: Path, tmp_path: Path) -> None:
    truth = folder / "truth/orientations.csv"
    result = evaluate_flight(folder, plant(MIRRORS), slopes=folder / "truth/slopes")
    found = compare(result.flights, read_reference(truth))
    assert [one.label for one in found] == [r["heliostat"] for r in result.orientation_rows()]
    assert all(one.measured is not None for one in found)
    # The ideal surface is what a flight without slope maps is evaluated with.
    plain = evaluate_flight(folder, plant(MIRRORS))
    for one, row in zip(found, plain.orientation_rows(), strict=True):
        assert one.ideal is not None
        assert np.degrees(one.ideal.elevation) == pytest.approx(row["elevation_deg"], abs=1e-9)
    rows = reference_rows(compare(plain.flights, read_reference(truth)))
    assert np.isnan([row["rot_x_measured_mrad"] for row in rows]).all()
    assert "measured" not in reference_document(compare(plain.flights, read_reference(truth)))
    other = tmp_path / "other.csv"
    other.write_text("heliostat,azimuth_deg,elevation_deg\nZ9,180,40\n")
    with pytest.raises(InputError, match="none of its heliostats was measured"):
        compare(plain.flights, read_reference(other))


def test_the_optical_axis_is_chosen(folder: Path, tmp_path: Path) -> None:
    """The mean reaches every orientation, and the comparison uses the same.

    With the few reflections of this flight both means are alike; what they do with many is tested
    beside `measure`.
    """
    app = typer.Typer()
    app.command()(evaluate_command)
    options = ["--field", folder / "plant.toml", "--processes", 1, "--no-report"]
    for axis in ("area", "plain"):
        done = CliRunner().invoke(
            app, [str(a) for a in (folder, *options, "--out", tmp_path, "--axis", axis)]
        )
        assert done.exit_code == 0, done.output
        assert set(pd.read_csv(tmp_path / "orientations.csv")["mean"]) == {axis}
    result = evaluate_flight(folder, plant(MIRRORS), axis="plain")
    found = compare(result.flights, read_reference(folder / "truth/orientations.csv"))
    assert {one.ideal.mean for one in found if one.ideal is not None} == {"plain"}


def test_the_maps_of_a_flight_may_be_deflectometry(folder: Path, tmp_path: Path) -> None:
    real = MIRRORS.names[2]
    shape = ideal(MIRRORS, 2)
    slope = read_slopes(folder / f"truth/slopes/{real}.npz", len(shape))
    write_deflectometry(tmp_path / f"{real}.h5", shape.with_slopes(slope))
    result = evaluate_flight(folder, plant(MIRRORS), slopes=tmp_path)
    assert not [line for line in result.warnings if real in line]
    assert len([line for line in result.warnings if "assumed ideal" in line]) == 7
    found = result.flights[0].measured.shape(2).slope
    assert found is not None
    np.testing.assert_allclose(found.mean(axis=(1, 2)), slope.mean(axis=(1, 2)), atol=0.02 * MRAD)


def test_the_command_compares(folder: Path, tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(evaluate_command)
    options = ["--field", folder / "plant.toml", "--processes", 1, "--no-report"]
    options += [
        "--reference",
        folder / "truth/orientations.csv",
        "--slopes",
        folder / "truth/slopes",
    ]
    done = CliRunner().invoke(app, [str(a) for a in (folder, *options, "--out", tmp_path)])
    assert done.exit_code == 0, done.output
    assert "Orientation minus reference, mrad" in done.stdout
    assert (tmp_path / "reference.csv").exists()
    assert not (tmp_path / "reference.html").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("heliostat,azimuth_deg\nA,1\n", "there is no column elevation_deg"),
        ("heliostat,azimuth_deg,elevation_deg\nA,1,95\n", "95° is beyond ±90°"),
        ("heliostat,azimuth_deg,elevation_deg\nA,x,5\n", "is not a finite number; enter degrees"),
        ("heliostat,azimuth_deg,elevation_deg\n", "no rows"),
        ("heliostat,azimuth_deg,elevation_deg\nA,1,5\nA,2,5\n", "heliostat A is listed twice"),
    ],
)
def test_a_table_that_is_no_reference_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "reference.csv"
    path.write_text(text)
    with pytest.raises(FormatError, match=said):
        read_reference(path)
