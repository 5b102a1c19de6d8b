"""A campaign: a plan's stations flown and evaluated together, with what goes wrong on the way."""

import csv
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from heliotrope.airborne.evaluate import campaign, reading
from heliotrope.airborne.evaluate.campaign import Campaign
from heliotrope.airborne.evaluate.detection import decode
from heliotrope.airborne.evaluate.folder import FlightData, natural_key
from heliotrope.airborne.evaluate.reading import PhotoReading
from heliotrope.airborne.mirror import ideal
from heliotrope.airborne.photo import LedCamera, read_photos
from heliotrope.airborne.plan.stations import read_stations
from heliotrope.airborne.simulate.rendering import write_photo
from heliotrope.airborne.simulate.simulation import Errors, hover_grid, install, look_counts
from heliotrope.airborne.standing import MirrorPoses
from heliotrope.cli.drone.evaluate import evaluate as evaluate_command
from heliotrope.cli.drone.simulate import simulate as simulate_command
from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.field.formats import plant_file
from support.drone_case import ORIGIN, camera, field, plant

app = typer.Typer()
app.command("evaluate")(evaluate_command)
app.command("simulate")(simulate_command)
MIRRORS = field(2, 4)
SIDES = ((0.0, 0.0, 32.0), (20.0, 10.0, 30.0), (-20.0, 10.0, 30.0))


def run(*arguments: object):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def plan() -> dict:
    """What a flight plan has of three stations over eight mirrors; the first in two sorties."""
    middle = MIRRORS.position.mean(axis=0) + [0.0, 0.0, 1.2]
    patterns = [hover_grid(side, middle, 2, 2, 0.7).tolist() for side in SIDES]
    cuts = [(0, 0, 3), (1, 0, 4), (2, 0, 4), (0, 3, 4)]
    visits = [{"station": k, "first": a, "photographs_m": patterns[k][a:b]} for k, a, b in cuts]
    return {
        "format": "heliotrope flight plan 1",
        "clusters": [{"name": "C1", "center_m": middle.tolist(), "heliostats": [*MIRRORS.names]}],
        "stations": [
            {
                "cluster": "C1",
                "point": k + 1,
                "counts": look_counts(MIRRORS, side).tolist(),
                "unreachable": [5] if k == 1 else [],
            }
            for k, side in enumerate(SIDES)
        ],
        "sorties": [{"visits": visits[:3]}, {"visits": visits[3:]}],
    }


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> Path:
    """Folder with plant.toml, plan.json, and the photographs of two of the stations."""
    place = tmp_path_factory.mktemp("campaign")
    plant_file.write_plant(plant(MIRRORS), place / "plant.toml")
    (place / "plan.json").write_text(json.dumps(plan()))
    done = run(
        "simulate",
        place / "plant.toml",
        place / "shot",
        "--plan",
        place / "plan.json",
        "--stations",
        "C1-1,C1-2",
        "--size",
        "640x480",
        "--focal-px",
        620,
        "--survey-mm",
        2,
        "--kinematics-mm",
        2,
    )
    assert done.exit_code == 0, done.output
    assert "8 photographs in 2 flights" in done.stdout
    return place


def test_stations_of_a_plan(tmp_path) -> None:
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(plan()))
    stations = read_stations(path, MIRRORS.names)
    assert [s.name for s in stations] == ["C1-1", "C1-2", "C1-3"]
    # The pattern of two sorties is one, in its order; who cannot look there is left out.
    np.testing.assert_allclose(
        stations[0].pattern,
        hover_grid(SIDES[0], MIRRORS.position.mean(axis=0) + [0, 0, 1.2], 2, 2, 0.7),
    )
    assert stations[1].heliostats.tolist() == [0, 1, 2, 3, 4, 6, 7]
    np.testing.assert_allclose(stations[2].counts, look_counts(MIRRORS, SIDES[2]))
    with pytest.raises(UnknownNameError, match="heliostat"):
        read_stations(path, MIRRORS.names[:5])
    path.write_text(json.dumps({"format": "another"}))
    with pytest.raises(FormatError, match="'another' is unknown"):
        read_stations(path, MIRRORS.names)


def test_a_heliostat_is_the_same_in_all_flights() -> None:
    whole = install(MIRRORS, range(8), Errors(), seed=4)
    part = install(MIRRORS, [6, 2], Errors(), seed=4)
    np.testing.assert_array_equal(
        part.heliostats.mechanism.position, whole.heliostats.take([6, 2]).mechanism.position
    )
    np.testing.assert_array_equal(part.shapes[1].slope, whole.shapes[2].slope)
    assert not np.array_equal(whole.shapes[1].slope, whole.shapes[2].slope)


def test_campaign_gives_one_table(flown: Path, tmp_path) -> None:
    common = (
        "--field",
        flown / "plant.toml",
        "--survey-mm",
        2,
        "--kinematics-mm",
        2,
        "--processes",
        1,
        "--no-report",
        "--out",
        tmp_path,
    )
    done = run("evaluate", flown / "shot", *common)
    assert done.exit_code == 0, done.output
    assert done.stdout.startswith("2 of 2 flights, 8 of 8 photographs used")
    table = rows(tmp_path / "orientations.csv")
    assert {r["flight"] for r in table} == {"C1-1", "C1-2"}
    assert {r["heliostat"] for r in table if r["flight"] == "C1-2"} <= {*MIRRORS.names} - {"H11"}
    sightings = rows(tmp_path / "sightings.csv")
    assert len(sightings) == len(table)
    for flight in ("C1-1", "C1-2"):
        truth = {r["heliostat"]: r for r in rows(flown / f"shot/{flight}/truth/orientations.csv")}
        off = [
            float(r["elevation_deg"]) - float(truth[r["heliostat"]]["elevation_deg"])
            for r in table
            if r["flight"] == flight and int(r["points"]) >= 2
        ]
        # Slopes of 0.8 mrad and few points: what it shows is that each flight has its own pose.
        assert len(off) >= 4
        assert np.radians(np.sqrt(np.mean(np.square(off)))) < 1.5e-3
    # What is systematic is told by its causes: where mirrors stand is known from the images.
    for row in table:
        causes = [float(row[f"systematic_{c}_x_mrad"]) for c in ("place", "lamp")]
        assert np.hypot(*causes) == pytest.approx(float(row["systematic_x_mrad"]), rel=1e-6)
    # The report's table is the same, and the page has the causes.
    kept = (tmp_path / "orientations.csv").read_bytes()
    again = run("evaluate", flown / "shot", *[c for c in common if c != "--no-report"])
    assert again.exit_code == 0, again.output
    assert (tmp_path / "orientations.csv").read_bytes() == kept
    assert "σ of place" in (tmp_path / "index.html").read_text(encoding="utf-8")


def test_flights_stand_in_the_order_of_their_numbers() -> None:
    names = ["C10-1", "C1-10", "C1-2", "C1-1b", "C2-1", "C1-1", "dusk", "7"]
    wanted = ["7", "C1-1", "C1-1b", "C1-2", "C1-10", "C2-1", "C10-1", "dusk"]
    assert sorted(names, key=natural_key) == wanted


def spoil(shot: Path) -> None:
    """Make everything wrong that photographs and flights can be, but for flight C1-1."""
    photo = [shot / f"C1-2/DJI_000{k}.JPG" for k in range(1, 5)]
    told, _ = read_photos(shot / "C1-2", ORIGIN)
    picture = decode(photo[0])
    cv2.imwrite(str(photo[0]), picture)
    photo[1].write_bytes(photo[1].read_bytes()[:9000])
    noise = np.random.default_rng(1).integers(60, 110, picture.shape).astype(np.uint8)
    write_photo(photo[2], noise, told[2], ORIGIN)
    write_photo(photo[3], np.full_like(picture, 255), told[3], ORIGIN)
    write_photo(shot / "C1-1/DJI_0009.JPG", picture[:300], told[0], ORIGIN)
    # Nobody knows its commands; the mirrors look elsewhere; the lamp is off; another field.
    (shot / "C1-7").mkdir()
    shutil.copy(shot / "C1-1/DJI_0001.JPG", shot / "C1-7")
    for name in ("away", "dark"):
        shutil.copytree(shot / "C1-1", shot / name)
        (shot / name / "DJI_0009.JPG").unlink()
    lines = [f"{n},0,0" for n in MIRRORS.names]
    (shot / "away/commands.csv").write_text("\n".join(["heliostat,count_1,count_2", *lines]))
    for file in (shot / "dark").glob("*.JPG"):
        # What is brighter than the sky in the mirrors is the lamp.
        one = next(p for p in read_photos(shot / "dark", ORIGIN)[0] if p.name == file.name)
        write_photo(file, np.minimum(decode(file), 170), one, ORIGIN)
    shutil.copytree(shot / "C1-1", shot / "other")
    (shot / "other/commands.csv").write_text("heliostat,count_1,count_2\nZ9,0,0\n")


def test_what_is_wrong_with_a_flight_does_not_stop_the_others(flown: Path, tmp_path) -> None:
    shot = tmp_path / "shot"
    shutil.copytree(flown / "shot", shot)
    spoil(shot)
    common = ("--field", flown / "plant.toml", "--processes", 1, "--no-report")
    done = run("evaluate", shot, *common, "--json", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert {r["flight"] for r in told["orientations"]} == {"C1-1"}
    for words in (
        ("C1-2", "DJI_0001.JPG", "its XMP lacks GpsLatitude"),
        ("C1-2", "DJI_0002.JPG", "unreadable: ", "the file ends after 9000 bytes"),
        ("C1-2", "DJI_0003.JPG", "nothing: "),
        ("C1-2", "DJI_0004.JPG", "overexposed: 100 % of the photograph is clipped"),
        ("C1-1", "DJI_0009.JPG", "640 × 300 px, but most photographs have 640 × 480 px"),
        ("C1-7", "camera.toml", "no such file"),
        ("away", "DJI_0001.JPG", "wrong_field: no mirror of the field can be in view"),
        ("dark", "no reflection"),
        ("other", "there is no heliostat", "Z9"),
    ):
        line = [one for one in told["not_used"] if all(word in one for word in words)]
        assert len(line) == 1, (words, told["not_used"])
        # One line each; on the error output too.
        assert "\n" not in line[0]
        assert line[0] in done.stderr.splitlines() or f"heliotrope: {line[0]}" in done.stderr
    shutil.copytree(shot / "C1-7", tmp_path / "one/C1-7")
    bad = run("evaluate", tmp_path / "one", *common, "--out", tmp_path / "none")
    assert isinstance(bad.exception, InputError)
    assert "none of 1 flights can be used; C1-7: " in str(bad.exception)
    assert not (tmp_path / "none").exists()


def test_interrupted_evaluation_goes_on(flown: Path, tmp_path, monkeypatch) -> None:
    read, calls = reading.read_photo, []

    def counted(photo, *rest):
        calls.append(photo.name)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return read(photo, *rest)

    monkeypatch.setattr(reading, "read_photo", counted)
    common = (
        "evaluate",
        flown / "shot",
        "--field",
        flown / "plant.toml",
        "--processes",
        1,
        "--no-report",
        "--json",
        "--out",
        tmp_path,
    )
    stopped = run(*common)
    assert stopped.exit_code != 0
    assert not (tmp_path / "orientations.csv").exists()
    calls[:] = ["again"] * 10
    assert run(*common).exit_code == 0
    assert calls[10:] == ["DJI_0002.JPG", "DJI_0003.JPG", "DJI_0004.JPG"]


def test_an_offset_far_beyond_what_was_said_is_told() -> None:
    found = Campaign((), (), np.array([0.02, -0.4, 0.01]), np.eye(3) * 1e-6, 1)
    assert (
        "offset is 400 mm, but its specified standard deviation is 30 mm" in found.warnings(0.03)[0]
    )
    assert found.warnings(0.5) == []


def bare(name: str, heliostats: list[int], lens: LedCamera) -> FlightData:
    """A flight whose one photograph shows all corners of its heliostats."""
    count = len(heliostats)
    seen = PhotoReading(name, mirror=np.arange(count), corners=np.zeros((count, 4, 2)))
    stand = MirrorPoses(
        ("",) * count, np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros((count, 4, 3))
    )
    shapes = (ideal(MIRRORS, 0),) * count
    rows = np.array(heliostats)
    return FlightData(name, (), lens, stand, rows, np.zeros((count, 2)), shapes, seen=(seen,))


@pytest.mark.parametrize(
    ("lines", "text"),
    [
        (("", ":"), "its photographs show no reflection of the lamp"),
        (("a.jpg: blur: 3 px", "none of its 1 photographs can be used"), "a.jpg: blur: 3 px"),
        (
            ("a.jpg: outline: none", "b.jpg: blur: 3 px", "c.jpg: blur: 4 px"),
            "b.jpg: blur: 3 px (and 1 more for the same reason)",
        ),
    ],
)
def test_the_cause_of_a_failed_flight_is_named(lines: tuple[str, ...], text: str) -> None:
    assert campaign._cause(lines) == text


def test_no_flight_gives_a_reflection(monkeypatch) -> None:
    def fails(*_: object) -> None:
        raise InputError("no mirror was found")

    monkeypatch.setattr(campaign, "_together", fails)
    flights = [bare("", [0], camera()), bare("b", [1], camera())]
    with pytest.raises(
        InputError, match="none of 2 flights shows a reflection; the first: no mirror"
    ):
        campaign.evaluate_campaign(flights)


def test_flights_that_share_heliostats_go_together(monkeypatch) -> None:
    lens, other = camera(), camera(900, 700)
    poses = [
        bare("a", [0, 1], lens), bare("b", [5, 6], lens), bare("c", [1, 2], lens),
        bare("d", [2, 3], lens), bare("e", [0, 1], other), bare("f", [6], lens),
    ]  # fmt: skip
    # d shares none with a, but both do with c; another camera is adjusted by itself.
    assert campaign.flight_groups(poses, range(6)) == [[0, 2, 3], [1, 5], [4]]
    # Three flights of 8 corners each are too many for one adjustment of 20.
    monkeypatch.setattr(campaign, "MOST_CORNERS", 20)
    assert campaign.flight_groups(poses, [0, 2, 3]) == [[0, 3], [2]]


def test_offsets_of_groups_count_as_they_are_known() -> None:
    def one(offset: float, sigma: float) -> SimpleNamespace:
        # What a group would give with a prior of 1 m: nearly what its images say.
        known = 1.0 / (1.0 / sigma**2 + 1.0)
        state = SimpleNamespace(offset=np.full(3, offset * known / sigma**2))
        return SimpleNamespace(
            adjusted=SimpleNamespace(state=state, offset_covariance=known * np.eye(3))
        )

    offset, covariance = campaign.common_offset([one(0.030, 0.004), one(0.020, 0.008)], 1.0)
    np.testing.assert_allclose(offset, 0.8 * 0.030 + 0.2 * 0.020, rtol=1e-3)
    np.testing.assert_allclose(np.diag(covariance), 1.0 / (1 / 0.004**2 + 1 / 0.008**2), rtol=1e-3)
