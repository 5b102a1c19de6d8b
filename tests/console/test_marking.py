"""Corner markers clicked in a camera's picture: by the API, and in a browser."""

import base64
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from heliotrope.field.camera import Camera, project
from heliotrope.field.formats.plant_edit import versions
from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.field.layouts import malan_plant
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.targets.teaching import known_points, with_camera
from heliotrope.links.clock import VirtualClock
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.marking import Marking
from heliotrope.plant.orders.authority import Person, Role
from support.live_console import ROLES, LiveConsole
from support.pages import NEEDS_BROWSER, entering, orders_counted, said

Ask = Callable[..., httpx.Response]
TARGET = "left"
#: The answer to a POST of the command authority is withheld until `release` is called.
LATE = """() => {
  const { fetch } = window, released = new Promise((go) => { window.release = go; });
  window.fetch = async (place, options) => {
    const answer = await fetch(place, options);
    if (options?.method === "POST" && place.endsWith("/authority")) await released;
    return answer;
  };
}"""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """A small plant whose camera takes pictures, and a place for what is marked."""
    folder = tmp_path_factory.mktemp("marks")
    made = LiveConsole(folder, 8, rendered=True, marks=folder / "marks" / "plant.toml")
    marking = made.live.operations.marking
    assert marking is not None
    end = time.monotonic() + 120.0
    while TARGET not in made.call(lambda: list(made.live.cameras._frames)):
        assert time.monotonic() < end, "no picture of the empty target"
        time.sleep(0.1)
    yield made
    made.close()


@pytest.fixture
def asking(rendered: LiveConsole) -> Iterator[Ask]:
    """Send a request to the rendered plant as somebody of a role."""
    people, now = rendered.keeper.people, time.time()
    tokens = {role: people.add_token(role, "marks", role, now)[1] for role in ROLES}
    with httpx.Client(base_url=f"{rendered.address}api/v1/", trust_env=False, timeout=60.0) as one:

        def send(role: str, method: str, path: str, body: Any = None) -> httpx.Response:
            headers = {"Authorization": f"Bearer {tokens[role]}"}
            return one.request(method, path, json=body, headers=headers)

        yield send
        send("engineer", "DELETE", "authority")


@dataclass(frozen=True)
class Standing:
    """A controller that does nothing but have a design."""

    design: Plant


@dataclass(frozen=True)
class Held:
    """A camera with an empty frame, and the taught pictures that it was given."""

    camera: Camera
    pictures: list[set[str]] = field(default_factory=list)

    def eye(self, target: str) -> Camera:
        return self.camera

    def frame(self, target: str) -> SimpleNamespace:
        return SimpleNamespace(size=self.camera.size)

    def take_view(self, camera: Camera, target: Target, pictures: Mapping[str, FloatArray]) -> None:
        self.pictures.append(set(pictures))


def pixels(console: LiveConsole) -> dict[str, list[float]]:
    """True pixels of the points of the target."""
    design = console.live.design
    scene = console.live.cameras._scenes[TARGET]
    known = known_points(design.targets[0])
    return {name: project(scene.camera, point).tolist() for name, point in known.items()}


def test_marks_are_tried_saved_used_and_kept(rendered: LiveConsole, asking: Ask) -> None:
    name = TARGET
    cameras = rendered.live.cameras
    true = pixels(rendered)
    assert asking("operator", "POST", f"targets/{name}/marks/picture").status_code == 403
    opened = asking("engineer", "POST", f"targets/{name}/marks/picture").json()
    assert {p["name"] for p in opened["points"]} == set(true)
    jpeg = asking("engineer", "GET", f"pictures-to-mark/{opened['number']}").content
    shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert list(shown.shape[::-1]) == opened["size"]
    # Clicked within a pixel.
    noise = np.random.default_rng(5).normal(0.0, 0.5, (len(true), 2))
    points = {n: (np.array(p) + e).tolist() for (n, p), e in zip(true.items(), noise, strict=True)}
    order = {"number": opened["number"], "points": points}
    tried = asking("engineer", "POST", f"targets/{name}/marks", order).json()
    assert not tried["saved"]
    assert 0.0 < tried["residual"] < 1.5
    front = cv2.imdecode(
        np.frombuffer(base64.b64decode(tried["rectified"]), np.uint8), cv2.IMREAD_GRAYSCALE
    )
    # White paint all over, upright: what lies beyond the target is not in the picture.
    assert np.median(front[5:-5, 5:-5]) > 120
    assert rendered.call(lambda: cameras.eye(name)) is rendered.live.design.cameras[0]
    # Saving needs the command authority.
    refused = asking("engineer", "POST", f"targets/{name}/marks", {**order, "save": True})
    assert refused.status_code == 409
    assert "command authority" in refused.json()["detail"]
    assert asking("engineer", "POST", "authority").status_code == 200
    saved = asking("engineer", "POST", f"targets/{name}/marks", {**order, "save": True}).json()
    assert saved["saved"]
    eye = rendered.call(lambda: cameras.eye(name))
    scene = cameras._scenes[name]
    assert eye is not scene.camera
    far = np.linalg.norm(np.asarray(eye.position) - np.asarray(scene.camera.position))
    away = np.linalg.norm(
        np.asarray(scene.camera.position) - rendered.live.design.targets[0].center
    )
    assert 0.0 < far < 0.05 * away
    plant = rendered.live.design
    # A photograph by the new view finds the target.
    assert asking("engineer", "POST", f"targets/{name}/photograph").status_code == 200
    assert not any("target" in line for line in rendered.call(lambda: cameras.view(name)).reading)
    # Kept in the form of `camera teach`, and audited.
    file = rendered.folder / "marks" / "plant.toml"
    kept = read_plant(file)
    assert np.allclose(kept.camera(eye.name).position, eye.position)
    assert '"MARKS"' in (rendered.folder / "audit.jsonl").read_text()
    again = asking("engineer", "POST", f"targets/{name}/marks", {**order, "save": True})
    assert again.status_code == 200
    assert len(versions(file)) == 1
    assert "engineer" in versions(file)[0].note
    # A restart takes it again; one with another plant file does not.
    first, target = rendered.live.design.cameras[0], scene.targets[0]
    moved = replace(first, position=np.asarray(first.position) + [0.0, 0.1, 0.0])
    for design, resumed in ((rendered.live.design, True), (with_camera(plant, moved), False)):
        rendered.call(lambda: cameras.take_view(scene.camera, target, {}))
        again = Marking(cameras, Standing(design), rendered.live.assembly.logbook, file)  # type: ignore[arg-type]
        rendered.call(again.resume)
        position = rendered.call(lambda: cameras.eye(TARGET)).position
        assert np.allclose(position, eye.position) == resumed


def test_taught_pictures_beside_the_kept_file_are_taken_again(tmp_path: Path) -> None:
    """Those that were taught before lie beside the plant's own file, and are not missed."""
    design = malan_plant(1)
    left, others = design.targets[0], design.targets[1:]
    codes = {"upper_left": "plant-left-1.png", "upper_right": "own.png"}
    marks = tuple(
        replace(m, kind="picture", code=codes[m.name]) if m.name in codes else m for m in left.marks
    )
    assert {m.code for m in marks} >= set(codes.values())
    write_plant(design, tmp_path / "before.toml")
    taught = replace(design, targets=(replace(left, marks=marks), *others))
    write_plant(taught, tmp_path / "plant.toml")
    cv2.imwrite(str(tmp_path / "plant-left-1.png"), np.full((24, 24), 200, np.uint8))
    cameras = Held(design.cameras[0])
    Marking(
        cameras,  # type: ignore[arg-type]
        Standing(design),  # type: ignore[arg-type]
        Logbook(VirtualClock()),
        tmp_path / "plant.toml",
    ).resume()
    assert {"plant-left-1.png"} in cameras.pictures
    assert not any("own.png" in each for each in cameras.pictures)


@pytest.mark.parametrize(
    ("pixel", "shown"),
    [
        ((-0.4, 500.0), True),
        ((-0.6, 500.0), False),
        ((1599.4, 500.0), True),
        ((1599.6, 500.0), False),
        ((800.0, -0.4), True),
        ((800.0, -0.6), False),
        ((800.0, 1199.4), True),
        ((800.0, 1199.6), False),
    ],
)
def test_a_point_is_expected_only_on_the_pixels_of_a_picture(
    pixel: tuple[float, float], shown: bool
) -> None:
    design = malan_plant(1)
    name, point = next(iter(known_points(design.targets[0]).items()))
    camera = design.cameras[0]
    assert camera.size == (1600, 1200)
    matrix = camera.matrix.copy()
    matrix[:2, 2] += pixel - project(camera, point)
    cameras = Held(replace(camera, matrix=matrix))
    marking = Marking(cameras, Standing(design), Logbook(VirtualClock()))  # type: ignore[arg-type]
    opened = marking.begin(Person("Egon", Role.ENGINEER), TARGET)
    expected = {p.name: p.expected for p in opened.points}[name]
    assert expected == (pytest.approx(pixel, abs=1e-6) if shown else None)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda p: dict(list(p.items())[:3]), "four or more are needed"),
        (lambda p: {**p, "upper_left": [-20.0, 3.0]}, "is not in the picture"),
        (
            lambda p: {**p, "upper_left": p["upper_right"], "upper_right": p["upper_left"]},
            "swapped",
        ),
        (lambda p: {**p, "upper_left": p["upper_right"]}, "are in the same place"),
        (lambda p: {**p, "elsewhere": [5.0, 5.0]}, "elsewhere"),
        # A quadrilateral that is not convex.
        (
            lambda p: {**p, "upper_left": np.mean(list(p.values()), axis=0).tolist()},
            "not arranged as on the target",
        ),
    ],
)
def test_wrong_marks_are_refused_in_one_line(
    rendered: LiveConsole, asking: Ask, change: Callable[[dict[str, Any]], Any], text: str
) -> None:
    name = TARGET
    corners = ("upper_left", "upper_right", "lower_right", "lower_left")
    true = {n: p for n, p in pixels(rendered).items() if n in corners}
    number = asking("engineer", "POST", f"targets/{name}/marks/picture").json()["number"]
    order = {"number": number, "points": change(true)}
    answer = asking("engineer", "POST", f"targets/{name}/marks", order)
    assert answer.status_code in (404, 422)
    assert text in answer.json()["detail"]
    assert "\n" not in answer.json()["detail"]


@pytest.fixture
def enter(rendered: LiveConsole, browser: Any) -> Iterator[Callable[..., Any]]:
    """Sign in as somebody of a role."""
    yield from entering(rendered.address, browser)


@NEEDS_BROWSER
def test_an_engineer_marks_corners_on_the_page(
    rendered: LiveConsole, enter: Callable[..., Any]
) -> None:
    cameras, true = rendered.live.cameras, pixels(rendered)
    before = rendered.call(lambda: cameras.eye(TARGET))
    page = enter("engineer")
    page.evaluate(LATE)
    page.click("text=Take command")
    page.wait_for_selector("text=You have command")
    page.click(".hx-tabs >> text=Targets")
    page.click("text=Mark corners… >> nth=0")
    page.wait_for_selector(".hx-mark-ask:has-text('Click on upper_left')")
    box = page.locator(".hx-mark-picture").bounding_box()
    scale = min((box["width"] - 20) / 1600, (box["height"] - 20) / 1200)
    left = box["x"] + (box["width"] - 1600 * scale) / 2
    top = box["y"] + (box["height"] - 1200 * scale) / 2
    names = page.evaluate(
        "[...document.querySelectorAll('.hx-mark-list li')].map(e => e.firstChild.data)"
    )
    assert names == list(true)
    page.mouse.click(left + 30.0, top + 30.0)  # wrong
    page.click(".hx-mark button:text-is('Undo')")
    page.wait_for_selector(".hx-mark-ask:has-text('Click on upper_left')")
    for name in names[:3]:
        x, y = true[name]
        page.mouse.click(left + (x + 0.5) * scale, top + (y + 0.5) * scale)
    assert page.is_disabled(".hx-mark button:text-is('Preview')")
    # The fourth by the keyboard alone: where it is expected, then nudged.
    page.focus(".hx-mark-picture")
    page.keyboard.press("Space")
    page.keyboard.press("ArrowRight")
    page.wait_for_selector(".hx-mark-ask:has-text('5 of 8')")
    assert page.is_disabled(".hx-mark button:text-is('Save')")
    page.click(".hx-mark button:text-is('Preview')")
    page.wait_for_selector(".hx-mark-front[src]:not(.stale)")
    page.wait_for_selector(".hx-mark .hx-told:has-text('residuals')")
    page.click(".hx-mark button:text-is('Save')")
    page.wait_for_selector(".hx-mark", state="detached")
    # The answer to Take command comes late; it does not replace a later result.
    page.evaluate("release()")
    page.wait_for_timeout(200)
    said(page, "corners marked")
    assert rendered.call(lambda: cameras.eye(TARGET)) is not before
    # Escape leaves everything as it is.
    page.click("text=Mark corners… >> nth=0")
    page.wait_for_selector(".hx-mark-ask")
    page.keyboard.press("Escape")
    page.wait_for_selector(".hx-mark", state="detached")


@NEEDS_BROWSER
@pytest.mark.parametrize("width", [1600, 800])
def test_emergency_works_above_the_marking_of_corners(
    enter: Callable[..., Any], width: int
) -> None:
    page = enter("engineer", viewport={"width": width, "height": 700}, has_touch=True)
    calls = orders_counted(page)
    page.click(".hx-tabs >> text=Targets")
    page.click("text=Mark corners… >> nth=0")
    page.wait_for_selector(".hx-mark-ask")
    ways = (
        lambda: page.click("#emergency"),
        lambda: page.tap("#emergency"),
        lambda: page.keyboard.press("Alt+e"),
    )
    for count, give in enumerate(ways, start=1):
        give()
        page.wait_for_selector("#emergency-said:has-text('ordered')")
        page.evaluate("document.querySelector('#emergency-said').textContent = ''")
        assert len(calls) == count


@NEEDS_BROWSER
def test_an_operator_is_not_offered_to_mark(enter: Callable[..., Any]) -> None:
    page = enter("operator")
    page.click(".hx-tabs >> text=Targets")
    page.wait_for_selector("text=Photograph now")
    assert page.locator("text=Mark corners…").count() == 0
