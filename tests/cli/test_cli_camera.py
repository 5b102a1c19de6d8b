"""``heliotrope camera``: what it prints and writes, and that bad input changes nothing."""

import json
import re
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from heliotrope.cli import main
from heliotrope.field.camera import project
from heliotrope.field.example import example_plant
from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.imaging.files import write_image
from heliotrope.imaging.receiver_file import read_reference
from heliotrope.imaging.receiver_light import receiver_light
from imaging.test_lens import HELD, MATRIX, drawn, held
from imaging.test_teaching import (
    ALL,
    BARE,
    BLOTS,
    CAMERA,
    LEAVES,
    MARKS,
    PLAIN,
    TRUE,
    at,
    photograph,
)
from support import receiver_scene

TAUGHT = (
    "--kind",
    "corner",
    "--size",
    "0.4",
    "--stroke",
    "0.09",
    "--kind",
    "middle=tee",
    "--kind",
    "dot=disc",
    "--size",
    "dot=0.3",
)


@pytest.fixture
def call(capsys: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run a command; what it prints, or its one line if it refuses."""

    def run(*arguments: object, code: int = 0) -> str:
        capsys.readouterr()
        monkeypatch.setattr(sys, "argv", ["heliotrope", "camera", *map(str, arguments)])
        with pytest.raises(SystemExit) as leaving:
            main()
        captured = capsys.readouterr()
        assert (leaving.value.code or 0) == code, captured.err
        if code:
            assert captured.out == ""
            assert captured.err.startswith("heliotrope: ")
            assert captured.err.count("\n") == 1
            return str(captured.err)
        return str(captured.out)

    return run


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures and plants that no test changes."""
    folder = tmp_path_factory.mktemp("shelf")
    write_plant(BARE, folder / "bare.toml")
    write_plant(PLAIN, folder / "plain.toml")
    target = replace(BARE.targets[0], marks=MARKS)
    write_plant(replace(BARE, targets=(target,)), folder / "marked.toml")
    write_plant(replace(BARE, targets=(target,), cameras=(CAMERA,)), folder / "seen.toml")
    cv2.imwrite(str(folder / "south.png"), photograph().pixels)
    cv2.imwrite(str(folder / "blots.png"), photograph((), leaves=LEAVES).pixels)
    cv2.imwrite(str(folder / "grey.png"), np.full((480, 640), 128, np.uint8))
    cv2.imwrite(str(folder / "small.png"), np.full((240, 320), 128, np.uint8))
    (folder / "text.png").write_text("no picture")
    for k in range(4):
        cv2.imwrite(str(folder / f"board{k}.png"), drawn(*held(*HELD[k]), k))
    (folder / "tower-measurements.json").write_text("{}")
    return folder


@pytest.fixture
def place(shelf: Path, tmp_path: Path) -> Path:
    """A folder with plants that a test may change."""
    for file in (*shelf.glob("*.toml"), *shelf.glob("*.csv")):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


def points(names: Any = ALL) -> list[str]:
    return [
        word for n in names for word in ("--at", f"{n}={TRUE[n][0] + 3:.1f},{TRUE[n][1] - 2:.1f}")
    ]


# -- teach -----------------------------------------------------------------------------


def test_teach_writes_marks_and_camera(call: Any, shelf: Path, place: Path) -> None:
    plant = place / "bare.toml"
    text = call(
        "teach",
        plant,
        shelf / "south.png",
        "--target",
        "target",
        *points(),
        *TAUGHT,
        "--camera",
        "south",
    )
    assert text.count("refined") == 6
    assert re.search(r"^camera at \(-?\d+\.\d\d ± \d+\.\d\d, ", text, re.MULTILINE)
    assert re.search(r"pixel positions on the target plane are accurate to \d+\.\d mm", text)
    assert text.rstrip().endswith(f"camera south and 6 marks written to {plant}")
    again = read_plant(plant)
    assert [mark.kind for mark in again.target("target").marks] == ["corner"] * 4 + ["tee", "disc"]
    assert again.camera("south").position is not None
    assert again.names == BARE.names


def test_teach_as_json(call: Any, shelf: Path, place: Path) -> None:
    found = json.loads(
        call(
            "teach",
            place / "plain.toml",
            shelf / "blots.png",
            "--target",
            "target",
            *[w for n, (x, y) in at(BLOTS).items() for w in ("--at", f"{n}={x},{y}")],
            "--out",
            place / "new.toml",
            "--json",
        )
    )
    assert [p["mark"] for p in found["points"]] == ["picture"] * 5
    assert [p["sigma_px"] for p in found["points"]] == [1.0] * 5
    assert found["sigma"].keys() >= {"east", "north", "up", "log_focal", "k1"}
    assert found["written"] == str(place / "new.toml")
    assert len(found["pictures"]) == 5
    assert all((place / name).is_file() for name in found["pictures"])
    # The plant that was read is as it was.
    assert (place / "plain.toml").read_bytes() == (shelf / "plain.toml").read_bytes()
    # And the plant that was written, with its pictures, is good for the next command.
    placed = json.loads(
        call("calibrate", place / "new.toml", shelf / "blots.png", "--camera", "camera", "--json")
    )
    assert placed["marks"] == 5


def test_teach_by_clicks(call: Any, shelf: Path, place: Path, monkeypatch: Any) -> None:
    told: list[str] = []

    def answer(address: str) -> None:
        told.append(address)
        clicked = {name: list(TRUE[name]) for name in ALL[1:]}
        threading.Thread(
            target=httpx.post, args=(address + "points",), kwargs={"json": {"points": clicked}}
        ).start()

    from heliotrope.cli import camera

    # The person and the browser stand behind the printed address.
    printed = camera._announcer
    monkeypatch.setattr(
        camera, "_announcer", lambda quiet: lambda a: (printed(quiet)(a), answer(a))
    )
    text = call(
        "teach",
        place / "bare.toml",
        shelf / "south.png",
        "--target",
        "target",
        "--click",
        *points(ALL[:1]),
        *TAUGHT,
    )
    assert f"click the points at {told[0]}\n" in text
    assert len(read_plant(place / "bare.toml").target("target").marks) == 6


# -- calibrate -------------------------------------------------------------------------


def test_calibrate_with_a_chessboard(call: Any, shelf: Path, place: Path) -> None:
    plant = place / "seen.toml"
    boards = [shelf / f"board{k}.png" for k in range(4)]
    arguments = (
        "calibrate",
        plant,
        *boards,
        shelf / "board0.png",
        "--camera",
        "south",
        "--chessboard",
        "9x6",
        "--square",
        "0.03",
    )
    text = call(*arguments)
    assert re.search(r"^focal length 5\d\d\.\d ± \d+\.\d, 5\d\d\.\d ± ", text, re.MULTILINE)
    assert re.search(r"board3\.png: 0\.\d\d px", text)
    assert (
        "note: the camera's pose was found with the old lens parameters and has been removed"
        in text
    )
    camera = read_plant(plant).camera("south")
    assert camera.size == (480, 360)
    assert camera.matrix[0, 0] == pytest.approx(MATRIX[0, 0], rel=0.02)
    assert camera.position is None
    assert (camera.targets, camera.source) == (CAMERA.targets, CAMERA.source)
    found = json.loads(call(*arguments, "--json"))
    assert found["focal_px"] == pytest.approx(np.diagonal(camera.matrix)[:2])
    assert found["pictures"][0]["used"]
    assert found["coverage"] > 0.3
    assert "forgotten" not in "".join(found["notes"])


def test_calibrate_with_marks(call: Any, shelf: Path, place: Path) -> None:
    plant = place / "marked.toml"
    text = call("calibrate", plant, shelf / "south.png", shelf / "grey.png", "--camera", "south")
    assert re.search(r"grey\.png: target target: ", text)
    assert re.search(r"^6 marks, residuals 0\.\d\d px; pixel positions on the target", text, re.M)
    camera = read_plant(plant).camera("south")
    assert camera.targets == ("target",)
    assert camera.position is not None
    for point in BARE.targets[0].corners:
        assert np.linalg.norm(project(camera, point) - project(CAMERA, point)) < 3.0
    # Known now: the same command finds its place again and leaves the lens alone.
    found = json.loads(call("calibrate", plant, shelf / "south.png", "--camera", "south", "--json"))
    assert "log_focal" not in found["sigma"]
    assert read_plant(plant).camera("south").matrix.tolist() == camera.matrix.tolist()
    free = json.loads(
        call("calibrate", plant, shelf / "south.png", "--camera", "south", "--anew", "--json")
    )
    assert "log_focal" in free["sigma"]


# -- show ------------------------------------------------------------------------------


def test_show(call: Any, place: Path) -> None:
    text = call("show", place / "seen.toml")
    lines = [line.split() for line in text.splitlines() if "south" in line]
    # 2 arctan(320/2600), distance |(9, −22, −10)|; −0.08 bends by less than the digits shown.
    assert " ".join(lines[0]).startswith("south 640 × 480 2600.0 14.")
    assert lines[1][:3] == ["south", "target", "25.8"]
    found = json.loads(call("show", place / "seen.toml", "--json"))
    assert found[0]["field_deg"][0] == pytest.approx(
        2 * np.degrees(np.arctan(320 / 2600)), rel=2e-3
    )
    assert found[0]["targets"]["target"]["marks"] == 6
    assert found[0]["targets"]["target"]["distance"] == pytest.approx(np.sqrt(665.0))
    assert "no cameras; add one with heliotrope camera teach" in call("show", place / "bare.toml")
    assert json.loads(call("show", place / "bare.toml", "--json")) == []
    bare = replace(example_plant(), cameras=(replace(CAMERA, position=None, R_enu_camera=None),))
    write_plant(bare, place / "lens.toml")
    assert "camera south: its position is unknown" in call("show", place / "lens.toml")


# -- bad input -------------------------------------------------------------------------

TEACH = ("teach", "bare.toml", "south.png", "--target", "target")
BOARDS = ("board0.png", "board1.png", "board2.png")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("teach", "none.toml", *TEACH[2:]), "none.toml: no such file"),
        ((*TEACH[:2], "none.png", *TEACH[3:]), "none.png"),
        ((*TEACH[:2], "text.png", *TEACH[3:]), "text.png"),
        ((*TEACH[:3], "--target", "targte"), "there is no target 'targte'; did you mean target?"),
        (TEACH, "target target: 0 points given; four or more"),
        ((*TEACH, "--at", "upper_left"), "--at 'upper_left': write NAME=X,Y"),
        ((*TEACH, "--at", "upper_left=1"), "--at 'upper_left=1': write NAME=X,Y"),
        ((*TEACH, "--at", "upper_left=1,b"), "write NAME=X,Y"),
        ((*TEACH, "--at", "=1,2"), "write NAME=X,Y"),
        ((*TEACH, "--at", "nose=1,2"), "there is no point of target target 'nose'"),
        ((*TEACH, "--at", "dot=1,-2"), "point dot: 1.0, -2.0 is not in the picture of 640 × 480"),
        ((*TEACH, *points(), "--kind", "star"), "kind 'star' cannot be taught; known: corner, tee"),
        ((*TEACH, *points(), "--kind", "corner"), "a corner needs its size in metres (--size)"),
        ((*TEACH, *points(), "--kind", "dot=disc"), "point dot: a disc needs its size in metres"),
        ((*TEACH, *points(), "--kind", "nose=disc", "--size", "1"), "among those given: 'nose'"),
        ((*TEACH, *points(), "--size", "big"), "'big' is not a number of metres"),
        ((*TEACH, *points(), "--size", "0"), "size must be above 0, not 0.0 m"),
        ((*TEACH, *points(), "--size", "1", "--size", "2"), "'2': specified twice"),
        (
            (*TEACH, *points(), "--size", "dot=1", "--size", "dot=2"),
            "specified twice for point dot",
        ),
        (
            (*TEACH, *points(), "--sigma-px", "0"),
            "--sigma-px must be a number from 0.001 to 1,000",
        ),
        ((*TEACH, *points(), "--out", "plant.xml"), "plant.xml: only plant files (TOML)"),
        (
            (*TEACH, *points(), "--out", "no/plant.toml"),
            "folder no does not exist; create it first",
        ),
        (
            ("teach", "tower-measurements.json", "south.png", "--target", "t"),
            "tower-measurements.json: a tower file alone is not a plant; specify the",
        ),
        (("teach", ".", "south.png", "--target", "t"), "add --out plant.toml"),
        (
            (
                "teach",
                "seen.toml",
                "small.png",
                "--target",
                "target",
                "--camera",
                "south",
                "--at",
                "dot=1,2",
                "--at",
                "middle=9,2",
                "--at",
                "upper_left=1,20",
                "--at",
                "upper_right=100,120",
            ),
            "south: its frames have 640 × 480 px, the picture 320 × 240",
        ),
        (
            ("calibrate", "bare.toml", *BOARDS, "--camera", "c", "--chessboard", "9x6"),
            "use --chessboard and --square together",
        ),
        (
            ("calibrate", "bare.toml", *BOARDS, "--camera", "c", "--square", "0.1"),
            "use --chessboard and --square together",
        ),
        (
            (
                "calibrate",
                "bare.toml",
                *BOARDS,
                "--camera",
                "c",
                "--chessboard",
                "9-6",
                "--square",
                "0.1",
            ),
            "--chessboard '9-6': write the number of inner corners as COLUMNSxROWS, such as 9x6",
        ),
        (
            (
                "calibrate",
                "bare.toml",
                *BOARDS,
                "--camera",
                "c",
                "--chessboard",
                "9x6",
                "--square",
                "-1",
            ),
            "--square must be a number from 0.001 to 100",
        ),
        (
            (
                "calibrate",
                "bare.toml",
                *BOARDS[:2],
                "--camera",
                "c",
                "--chessboard",
                "9x6",
                "--square",
                "0.03",
            ),
            "2 pictures of a chessboard; pass three or more",
        ),
        (
            (
                "calibrate",
                "bare.toml",
                *["grey.png"] * 3,
                "--camera",
                "c",
                "--chessboard",
                "7x6",
                "--square",
                "0.03",
            ),
            "the pattern of 7 × 6 inner corners is found in none of 3 pictures",
        ),
        (
            (
                "calibrate",
                "bare.toml",
                *BOARDS[:2],
                "small.png",
                "--camera",
                "c",
                "--chessboard",
                "9x6",
                "--square",
                "0.03",
            ),
            "small.png: 320 × 240 px, but ",
        ),
        (("calibrate", "bare.toml", "south.png", "--camera", "c"), "has marks; teach them first"),
        (
            ("calibrate", "marked.toml", "south.png", "small.png", "--camera", "c"),
            "camera c: the pictures have different sizes (320 × 240, 640 × 480 px); use pictures",
        ),
        (
            ("calibrate", "seen.toml", "small.png", "--camera", "south"),
            "camera south: the pictures have different sizes (320 × 240, 640 × 480 px)",
        ),
        (("calibrate", "marked.toml", "grey.png", "--camera", "c"), "no target was found: "),
        (("show", "none.toml"), "none.toml: no such file"),
    ],
)
def test_bad_input_is_one_line_and_changes_nothing(
    call: Any, shelf: Path, place: Path, monkeypatch: Any, arguments: tuple[str, ...], text: str
) -> None:
    for file in shelf.iterdir():
        if not (place / file.name).exists():
            (place / file.name).symlink_to(file)
    before = {file.name: file.read_bytes() for file in place.iterdir()}
    monkeypatch.chdir(place)
    said = call(*arguments, code=2)
    assert text in said
    assert {file.name: file.read_bytes() for file in place.iterdir()} == before


# -- receiver --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plant whose camera sees its receiver, and photographs of it."""
    folder = tmp_path_factory.mktemp("receiver")
    plain = replace(
        example_plant(), receivers=(receiver_scene.RECEIVER,), cameras=(receiver_scene.CAMERA,)
    )
    write_plant(plain, folder / "plant.toml")
    write_plant(replace(plain, receivers=()), folder / "none.toml")
    far = replace(receiver_scene.CAMERA, position=None, R_enu_camera=None)
    write_plant(replace(plain, cameras=(far,)), folder / "far.toml")
    for name, frame in {
        "capped": receiver_scene.capped(),
        "dark0": receiver_scene.frame(seed=1),
        "dark1": receiver_scene.frame(seed=2),
        "four": receiver_scene.frame(4, seed=3),
        "eight": receiver_scene.frame(8, seed=4),
    }.items():
        write_image(frame, folder / f"{name}.png")
    return folder


def pictures_of(folder: Path) -> list[object]:
    shares = {n: receiver_scene.true_share(receiver_scene.mirrors(n)) for n in (4, 8)}
    return [
        *("--camera", "eye", "--capped", folder / "capped.png"),
        *("--dark", folder / "dark0.png", "--dark", folder / "dark1.png"),
        *("--lit", f"{folder / 'four.png'}={shares[4]}"),
        *("--lit", f"{folder / 'eight.png'}={shares[8]}"),
    ]


def test_receiver_takes_a_reference_that_measures(call: Any, lit: Path, tmp_path: Path) -> None:
    out = tmp_path / "receiver.toml"
    text = call("receiver", lit / "plant.toml", *pictures_of(lit), "--out", out)
    assert re.search(
        r"nominal flux uses \d+ % of the pixel range; daylight on the receiver reads as \d", text
    )
    assert text.endswith(f"reference written to {out}\n")
    shown = receiver_scene.frame(12, seed=5)
    share = receiver_scene.true_share(receiver_scene.mirrors(12))
    assert receiver_light(shown, read_reference(out)).share == pytest.approx(share, abs=0.01)
    # The outline by hand, for a camera whose position nobody knows.
    corners = project(receiver_scene.CAMERA, receiver_scene.FACE.corners)
    by_hand = [word for x, y in corners for word in ("--outline", f"{x:.1f},{y:.1f}")]
    found = json.loads(
        call("receiver", lit / "far.toml", *pictures_of(lit), *by_hand, "--out", out, "--json")
    )
    assert found["receiver"] == "receiver"
    assert np.array(found["outline_px"]) == pytest.approx(corners, abs=0.1)
    assert receiver_light(shown, read_reference(out)).share == pytest.approx(share, abs=0.01)


def test_receiver_writes_nothing_where_it_refuses(call: Any, lit: Path, tmp_path: Path) -> None:
    out, given = tmp_path / "receiver.toml", pictures_of(lit)
    for words, text in (
        (("none.toml", *given, "--out", out), "0 receivers; the flux camera needs a plant"),
        (("far.toml", *given, "--out", out), "position is unknown; specify --outline X,Y"),
        (("plant.toml", *given, "--out", tmp_path / "a.json"), "a reference is written as TOML"),
        (("plant.toml", *given, "--lit", "four.png", "--out", out), "write FILE=FRACTION"),
        (
            ("plant.toml", *given, "--lit", f"{lit / 'four.png'}=0.9", "--out", out),
            "check the fractions",
        ),
    ):
        assert text in call("receiver", lit / words[0], *words[1:], code=2)
    assert not list(tmp_path.iterdir())
