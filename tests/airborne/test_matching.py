"""Photographs in which a person has named mirrors, because the program could not identify them."""

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from heliotrope.airborne.evaluate.flight import evaluate_flight
from heliotrope.airborne.evaluate.identification import expected_feet, rotation_angle
from heliotrope.airborne.evaluate.matching import Matches, read_matches, turn_by_hand
from heliotrope.airborne.evaluate.orientation import rotation_between
from heliotrope.airborne.evaluate.reading import look
from heliotrope.airborne.photo import Photo, read_photos, rotation_of_gimbal
from heliotrope.airborne.simulate import rendering
from heliotrope.airborne.simulate.rendered import paper_field, paper_flight
from heliotrope.airborne.simulate.simulation import Errors, Flight, exact_reflections
from heliotrope.airborne.standing import MirrorPoses, standing
from heliotrope.cli.drone.evaluate import evaluate as evaluate_command
from heliotrope.cli.drone.match import match as match_command
from heliotrope.errors import FormatError, InputError
from heliotrope.field.formats import plant_file
from support.drone_case import ORIGIN, SITE, camera, flight, plant

MRAD = 1e-3
HEAD = "photo,heliostat,corner,x_px,y_px\n"


@dataclass(frozen=True)
class Case:
    folder: Path
    flown: Flight
    photos: tuple[Photo, ...]
    stand: MirrorPoses

    @property
    def plant(self) -> Path:
        return self.folder / "plant.toml"

    def table(self, path: Path, rows: list[tuple[str, str, float, float]]) -> Path:
        """Write a table that names mirrors in all photographs, clicked 3 px beside their places."""
        rng, lines = np.random.default_rng(4), []
        for taken in self.flown.taken:
            for name, corner, _, _ in rows:
                row = self.stand.names.index(name)
                order = {"upper left": 0, "upper right": 1, "lower right": 2, "lower left": 3}
                points = self.flown.truth.corners[row]
                point = points[order[corner]] if corner else points.mean(axis=0)
                x, y = taken.pixels(self.flown.camera, point) + rng.uniform(-3.0, 3.0, 2)
                lines.append(f"{taken.name},{name},{corner},{x:.1f},{y:.1f}\n")
        path.write_text(HEAD + "".join(lines))
        return path


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """Return three photographs whose gimbal is wrong by 14°, far more than is searched."""
    flown = flight(Errors(survey=0.001), columns=3, rows=1, lens=camera(1000, 750))
    lean = rotation_of_gimbal(0.0, 0.0, 0.0).T @ rotation_of_gimbal(np.radians(14.0), 0.0, 0.0)
    wrong = tuple(replace(p, rotation=p.rotation @ lean) for p in flown.recorded)
    flown = replace(flown, recorded=wrong)
    folder = tmp_path_factory.mktemp("lost")
    rendering.render_flight(flown, folder, ORIGIN, seed=2)
    plant_file.write_plant(plant(flown.heliostats), folder / "plant.toml")
    photos, problems = read_photos(folder, ORIGIN)
    assert problems == ()
    return Case(folder, flown, photos, standing(flown.heliostats, flown.counts))


NAMED = [("H00", "", 0, 0), ("H04", "upper left", 0, 0), ("H32", "lower right", 0, 0)]


def test_a_flight_without_identification_says_how_a_person_can_help(case: Case) -> None:
    with pytest.raises(InputError, match=r"name mirrors in it by hand \(heliotrope drone match"):
        evaluate_flight(case.folder, plant(case.flown.heliostats))


def test_places_named_by_a_person_replace_the_identification(case: Case, tmp_path: Path) -> None:
    table = case.table(tmp_path / "matches.csv", NAMED)
    found = evaluate_flight(case.folder, plant(case.flown.heliostats), matches=table)
    evaluated = found.flights[0].evaluation
    assert len(evaluated.photos) == 3
    for photo, taken in zip(evaluated.photos, case.flown.taken, strict=True):
        assert rotation_angle(photo.rotation, taken.rotation) < 1.0 * MRAD
    right = 0
    exact = exact_reflections(case.flown)
    for k, row in zip(evaluated.reflections.photo, evaluated.reflections.heliostat, strict=True):
        right += bool(((exact.photo == k) & (exact.heliostat == row)).any())
    assert len(evaluated.reflections) > 20
    assert right > 0.97 * len(evaluated.reflections)
    measured = found.flights[0].measured.found.found
    error = [
        rotation_between(o.rotation, case.flown.truth.rotation[o.heliostat])[:2]
        for o in measured
        if o.count >= 2
    ]
    assert np.sqrt(np.mean(np.square(error))) < 0.6 * MRAD


def test_a_wrong_name_is_noticed(case: Case, tmp_path: Path) -> None:
    table = case.table(tmp_path / "matches.csv", NAMED)
    table.write_text(table.read_text().replace("H04,", "H14,", 1))
    matches, lines = read_matches(table, case.stand.names)
    assert lines == []
    photos, problems = turn_by_hand(case.photos, case.flown.camera, case.stand, matches)
    assert [p.by_hand for p in photos] == [False, *[True] * 2]
    assert len(problems) == 1
    assert "DJI_0001.JPG: H" in problems[0]
    assert "px from the position that the other mirrors imply" in problems[0]


def places(rows: list[tuple[str, str, str, float, float]]) -> Matches:
    photo, heliostat, corner, x, y = zip(*rows, strict=True)
    return Matches(Path("m.csv"), photo, heliostat, corner, np.stack([x, y], axis=-1))


def test_places_that_give_no_attitude_are_refused(case: Case) -> None:
    def problem(rows: list[tuple[str, str, str, float, float]]) -> str:
        photos, lines = turn_by_hand(case.photos[:1], case.flown.camera, case.stand, places(rows))
        assert not photos[0].by_hand
        return lines[0]

    one = ("DJI_0001.JPG", "H00", "middle", 100.0, 100.0)
    assert "1 place is named; 2 are needed" in problem([one])
    assert "all its places coincide" in problem([one, one])
    assert "heliostat X was not commanded" in problem([one, ("DJI_0001.JPG", "X", "middle", 1, 1)])


def test_places_of_a_campaign_belong_to_one_flight() -> None:
    named = places([("C1-2/a.jpg", "H", "middle", 1, 1), ("b.jpg", "H", "middle", 1, 1)])
    assert named.of("a.jpg", "C1-2").tolist() == [0]
    assert named.of("a.jpg", "C1-3").tolist() == []
    assert named.of("b.jpg", "C1-3").tolist() == [1]


def test_tables_are_read_row_by_row(case: Case, tmp_path: Path) -> None:
    path = tmp_path / "matches.csv"
    path.write_text(
        HEAD + "a,H00,,1,2\nb,,middle,3,4\nc,H01,Lower_Left,5,6\nd,H99,,7,8\ne,H02,top,9,9\n"
        "f,H03,light,x,1\n"
    )
    found, lines = read_matches(path, case.stand.names)
    assert found.photo == ("a", "c")
    assert found.corner == ("middle", "lower left")
    np.testing.assert_array_equal(found.pixel, [[1, 2], [5, 6]])
    assert len(lines) == 3
    assert "line 5" in lines[0]
    assert "'top' is not one of upper left" in lines[1]
    assert "is not a finite number; enter pixels" in lines[2]
    path.write_text(HEAD + "b,,middle,3,4\n")
    with pytest.raises(FormatError, match="no row names a heliostat"):
        read_matches(path, case.stand.names)


def test_mirrors_that_overlap_can_be_named_too() -> None:
    flown, _ = paper_flight(camera(900, 500), SITE, mirrors=paper_field(rows=4, columns=4))
    matrix = np.array([[3000.0, 0, 450.0], [0, 3000.0, 250.0], [0, 0, 1.0]])
    lens = replace(flown.camera, matrix=matrix)
    stand = standing(flown.heliostats, flown.counts)
    taken = flown.taken[17]
    exact = exact_reflections(flown)
    lamp = exact.take(np.flatnonzero(exact.photo == 17))
    scene = rendering.FlightScene(flown.truth, flown.shapes, 0.0, rendering.Conditions())
    picture = rendering.render(scene, lens, taken, lamp, 1)
    # An attitude that a person's clicks give: right to some pixels.
    near = taken.moved(taken.position, taken.rotation @ rotation_of_gimbal(0, 0, 0).T)
    near = taken.moved(
        taken.position, near.rotation @ rotation_of_gimbal(0.9 * MRAD, 0.7 * MRAD, 2.0 * MRAD)
    )
    seen = look(picture, replace(near, by_hand=True), lens, stand)
    assert seen.problem == ""
    assert np.linalg.norm((seen.rotation - taken.rotation)[:, 2]) < 0.2 * MRAD
    assert set(seen.spot_mirror.tolist()) <= set(lamp.heliostat.tolist())
    assert len(seen.spot) > 3


def test_lights_of_a_dark_night_can_be_named(case: Case) -> None:
    flown = case.flown
    exact = exact_reflections(flown)
    lamp = exact.take(np.flatnonzero(exact.photo == 0))
    scene = rendering.FlightScene(flown.truth, flown.shapes, 0.0, rendering.dark())
    picture = rendering.render(scene, flown.camera, flown.taken[0], lamp, 1)
    told, taken = flown.recorded[0], flown.taken[0]
    assert look(picture, told, flown.camera, case.stand).problem
    rows = [k for k in np.unique(lamp.heliostat).tolist() if len(lamp.of(k)) == 1]
    seen = []
    for k in rows:
        one = lamp.of(k)
        point = (
            flown.truth.vertex[k]
            + flown.truth.rotation[k] @ flown.shapes[k].point_at(one.facet, one.xy)[0]
        )
        feet, _ = expected_feet(told, flown.camera, case.stand.take([k]))
        if len(feet):
            seen.append(
                (told.name, case.stand.names[k], "light", *taken.pixels(flown.camera, point))
            )
    (photo,), problems = turn_by_hand((told,), flown.camera, case.stand, places(seen))
    assert problems == ()
    found = look(picture, photo, flown.camera, case.stand)
    assert found.problem == ""
    assert set(found.spot_mirror.tolist()) <= set(lamp.heliostat.tolist())
    assert len(found.spot) >= 4


# -- commands --------------------------------------------------------------------------

app = typer.Typer()
app.command("match")(match_command)
app.command("evaluate")(evaluate_command)


def run(*arguments: object):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_a_person_fills_in_the_table_of_the_command(case: Case, tmp_path: Path) -> None:
    common = ("--field", case.plant, "--out", tmp_path, "--processes", 1)
    done = run("match", case.folder, *common)
    assert done.exit_code == 0, done.output
    assert len(list(tmp_path.glob("match-DJI_*.jpg"))) == 3
    with (tmp_path / "matches.csv").open() as file:
        rows = list(csv.DictReader(file))
    # The person sees which mirror each number is.
    named = 0
    for row in rows:
        taken = next(t for t in case.flown.taken if t.name == row["photo"])
        middle = taken.pixels(case.flown.camera, case.flown.truth.corners.mean(axis=1))
        gap = np.linalg.norm(middle - [float(row["x_px"]), float(row["y_px"])], axis=-1)
        if gap.min() < 4.0 and int(row["number"]) % 3 == 0:
            row["heliostat"] = case.stand.names[int(np.argmin(gap))]
            named += 1
    assert named >= 3 * 3
    filled = tmp_path / "filled.csv"
    with filled.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    done = run("evaluate", case.folder, *common, "--no-report", "--matches", filled)
    assert done.exit_code == 0, done.output
    assert "3 of 3 photographs used" in done.output
    again = run("match", case.folder, *common)
    assert "this file already exists" in str(again.exception)
    unknown = run("match", case.folder, *common[:2], "--out", tmp_path / "b", "--photo", "z.jpg")
    assert "there is no photograph z.jpg" in str(unknown.exception)
