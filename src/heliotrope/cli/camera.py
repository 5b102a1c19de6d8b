"""``heliotrope camera``: calibrate target cameras, and mark the targets in their pictures."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from heliotrope.cli._common import open_plant, parse_numbers, print_json, print_table
from heliotrope.errors import FormatError, InputError

if TYPE_CHECKING:
    from heliotrope.field.camera import Camera
    from heliotrope.field.plant import Plant
    from heliotrope.field.target import Receiver
    from heliotrope.imaging.frame import Frame
    from heliotrope.imaging.lens import Lens
    from heliotrope.imaging.pose import CameraFit
    from heliotrope.imaging.targets.teaching import Taught, Wish

app = typer.Typer(help="Calibrate and teach target cameras.", no_args_is_help=True)

PlantArgument = Annotated[Path, typer.Argument(help="Plant file (TOML).")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
OutOption = Annotated[
    Path | None, typer.Option("--out", help="Plant file to write; default: PLANT itself.")
]
Value = TypeVar("Value")


@app.callback()
def _root() -> None:
    """Calibrate and teach target cameras."""


@app.command()
def calibrate(
    plant: PlantArgument,
    images: Annotated[list[Path], typer.Argument(help="Pictures of the board or the targets.")],
    camera: Annotated[str, typer.Option("--camera", help="Name of the camera.")],
    chessboard: Annotated[
        str | None, typer.Option(help="Inner corners of a chessboard, COLUMNSxROWS, e.g. 9x6.")
    ] = None,
    square: Annotated[
        float | None,
        typer.Option(min=0.001, max=100, help="Side length of the chessboard's squares, m."),
    ] = None,
    anew: Annotated[
        bool,
        typer.Option(
            "--anew", help="With marks: estimate the lens parameters again even if they are known."
        ),
    ] = False,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Calibrate a lens with a chessboard, or the lens and pose with the marks of targets."""
    if (chessboard is None) != (square is None):
        raise InputError(
            "use --chessboard and --square together, for example --chessboard 9x6 --square 0.03"
        )
    board = None if chessboard is None or square is None else (_pattern(chessboard), square)
    place = _place_to_write(plant, out)
    loaded = open_plant(plant)
    frames = [_read(image) for image in images]
    if board is not None:
        _from_chessboard(loaded, (plant, place), frames, camera, board, as_json)
    else:
        _from_marks(loaded, (plant, place), frames, camera, anew, as_json)


def _pattern(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,3})\s*[x×X]\s*(\d{1,3})", text)
    if not match:
        raise InputError(
            f"--chessboard {text!r}: write the number of inner corners as COLUMNSxROWS, such as 9x6"
        )
    return int(match[1]), int(match[2])


def _from_chessboard(
    plant: "Plant",
    places: tuple[Path, Path],
    frames: "Sequence[Frame]",
    name: str,
    board: tuple[tuple[int, int], float],
    as_json: bool,
) -> None:
    from dataclasses import replace

    from heliotrope.imaging.lens import calibrate_chessboard
    from heliotrope.imaging.targets.teaching import with_camera, write_with_pictures

    lens = calibrate_chessboard([f.grey for f in frames], *board, [f.name for f in frames])
    old = next((c for c in plant.cameras if c.name == name), None)
    camera = lens.camera(name)
    if old is not None:
        # The camera's pose was determined with the old lens.
        camera = replace(camera, targets=old.targets, source=old.source)
    write_with_pictures(with_camera(plant, camera), places[1], places[0].parent)
    forgotten = old is not None and old.position is not None
    _show_lens(lens, camera, places[1], as_json, forgotten)


def _show_lens(lens: "Lens", camera: "Camera", place: Path, as_json: bool, forgotten: bool) -> None:
    notes = list(lens.notes)
    if forgotten:
        notes.append(
            "the camera's pose was found with the old lens parameters and has been removed; "
            "find it again with heliotrope camera calibrate without --chessboard, or with teach"
        )
    if as_json:
        boards = [
            {
                "name": b.name,
                "used": b.used,
                "reason": b.reason,
                "deviation_px": b.deviation,
                "tilt_rad": b.tilt,
            }
            for b in lens.boards
        ]
        sigma = {
            "focal_px": lens.sigma[:2],
            "center_px": lens.sigma[2:4],
            "distortion": lens.sigma[4:],
        }
        print_json(
            {
                **_document(camera),
                "sigma": sigma,
                "terms": lens.model,
                "coverage": lens.coverage,
                "pictures": boards,
                "notes": notes,
                "written": str(place),
            }
        )
        return
    for board in lens.boards:
        print(
            f"{board.name}: "
            + (f"{board.deviation:.2f} px" if board.used else f"left out: {board.reason}")
        )
    (fx, fy), (cx, cy) = lens.matrix.diagonal()[:2], lens.matrix[:2, 2]
    s = lens.sigma
    print(
        f"focal length {fx:.1f} ± {s[0]:.1f}, {fy:.1f} ± {s[1]:.1f} px; principal point "
        f"{cx:.1f} ± {s[2]:.1f}, {cy:.1f} ± {s[3]:.1f} px"
    )
    terms = [
        f"{term} {value:.4f} ± {sigma:.4f}"
        for term, value, sigma in zip(
            ("k1", "k2", "p1", "p2", "k3"), lens.distortion, s[4:], strict=True
        )
        if sigma > 0.0
    ]
    print("distortion: " + (", ".join(terms) or "none visible in the pictures"))
    print(
        f"deviation {lens.deviation:.2f} px; boards cover {100 * lens.coverage:.0f} % of the frame"
    )
    _print_notes(notes)
    print(f"camera {camera.name} written to {place}")


def _from_marks(
    plant: "Plant",
    places: tuple[Path, Path],
    frames: "Sequence[Frame]",
    name: str,
    anew: bool,
    as_json: bool,
) -> None:
    from dataclasses import replace

    from heliotrope.imaging.targets import teaching

    old = next((c for c in plant.cameras if c.name == name), None)
    sizes = {frame.size for frame in frames} | ({old.size} if old else set())
    if len(sizes) > 1:
        listed = ", ".join(f"{w} × {h}" for w, h in sorted(sizes))
        raise InputError(
            f"camera {name}: the pictures have different sizes ({listed} px); use pictures of "
            "one size"
        )
    marks = teaching.see_marks(plant, places[0].parent, frames, old)
    fit = teaching.fit_marks(frames[0].size, marks, old, name, anew)
    camera = replace(
        fit.camera, targets=old.targets if old else marks.targets, source=old.source if old else ""
    )
    teaching.write_with_pictures(teaching.with_camera(plant, camera), places[1], places[0].parent)
    if as_json:
        print_json(
            {
                **_document(camera),
                **_fit_document(fit),
                "marks": len(fit.residuals),
                "not_found": list(marks.reasons),
                "written": str(places[1]),
            }
        )
        return
    for reason in marks.reasons:
        print(reason)
    _print_fit(fit, len(fit.residuals), "marks")
    print(f"camera {name} written to {places[1]}")


@app.command()
def teach(
    plant: Annotated[Path, typer.Argument(help="Plant file, or a folder in PAINT's format.")],
    image: Annotated[Path, typer.Argument(help="A picture of the target.")],
    target: Annotated[str, typer.Option("--target", help="Name of the target.")],
    at: Annotated[
        list[str] | None,
        typer.Option(help="Position of a point, NAME=X,Y in pixels; at least four points."),
    ] = None,
    click: Annotated[bool, typer.Option("--click", help="Click the points in a browser.")] = False,
    kind: Annotated[
        list[str] | None,
        typer.Option(
            help="Kind of mark at the points: corner, tee, square, disc or picture; "
            "NAME=KIND for one point."
        ),
    ] = None,
    size: Annotated[
        list[str] | None, typer.Option(help="Size of the marks, m; NAME=SIZE for one point.")
    ] = None,
    stroke: Annotated[
        list[str] | None,
        typer.Option(help="Stroke width of corners and tees, m; NAME=WIDTH for one."),
    ] = None,
    camera: Annotated[str, typer.Option("--camera", help="Name of the camera.")] = "camera",
    sigma_px: Annotated[
        float,
        typer.Option(min=0.001, max=1000, help="Standard deviation of the specified points, px."),
    ] = 1.0,
    anew: Annotated[
        bool,
        typer.Option("--anew", help="Estimate the lens parameters again even if they are known."),
    ] = False,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Mark a target's points in a picture, which yields the target's marks and the camera pose."""
    from heliotrope.imaging.targets import teaching

    place = _place_to_write(plant, out)
    loaded = open_plant(plant)
    surface = loaded.target(target)
    frame = _read(image)
    points = dict(_at(text) for text in at or [])
    wishes, wish = _wishes(kind or [], size or [], stroke or [])
    if click:
        from heliotrope.imaging.targets.click_page import click_points

        points |= click_points(surface, frame, points, image.name, _announcer(as_json))
    taught = teaching.teach(
        loaded,
        target,
        frame,
        points,
        camera=camera,
        wishes=wishes,
        wish=wish,
        sigma=sigma_px,
        anew=anew,
        prefix=f"{place.stem}-{target}",
    )
    teaching.write_taught(taught, place, plant.parent)
    _show_taught(taught, place, as_json)


def _announcer(quiet: bool) -> Callable[[str], None]:
    """Return a function that prints the page's address, on stderr if ``quiet``."""

    def announce(address: str) -> None:
        typer.echo(f"click the points at {address}", err=quiet)

    return announce


def _at(text: str) -> tuple[str, tuple[float, float]]:
    name, sign, pair = text.rpartition("=")
    refusal = f"--at {text!r}: write NAME=X,Y in pixels, such as upper_left=812.5,304"
    if not sign or not name:
        raise InputError(refusal)
    x, y = parse_numbers(pair, refusal, count=2)
    return name, (x, y)


def _wishes(
    kinds: Sequence[str], sizes: Sequence[str], strokes: Sequence[str]
) -> "tuple[dict[str, Wish], Wish]":
    from heliotrope.imaging.targets.teaching import Wish

    def metres(text: str) -> float:
        return parse_numbers(text, f"{text!r} is not a number of metres")[0]

    kind = _split(kinds, str)
    size, stroke = _split(sizes, metres), _split(strokes, metres)

    def of(name: str) -> Wish:
        try:
            return Wish(
                kind.get(name, kind.get("")),
                size.get(name, size.get("")),
                stroke.get(name, stroke.get("")),
            )
        except InputError as error:
            raise InputError(f"point {name}: {error}" if name else str(error)) from None

    names = sorted((set(kind) | set(size) | set(stroke)) - {""})
    return {name: of(name) for name in names}, of("")


def _split(texts: Sequence[str], read: Callable[[str], Value]) -> dict[str, Value]:
    """Return values by the name before "="; a value without a name is stored under ""."""
    values: dict[str, Value] = {}
    for text in texts:
        name, _, value = text.rpartition("=")
        if name in values:
            raise InputError(f"{text!r}: specified twice" + (f" for point {name}" if name else ""))
        values[name] = read(value)
    return values


def _show_taught(taught: "Taught", place: Path, as_json: bool) -> None:
    if as_json:
        points = [
            {
                "name": p.name,
                "pixel": p.pixel,
                "sigma_px": _sigma(p.covariance),
                "mark": p.mark.kind if p.mark else None,
                "refined": p.refined,
                "note": p.note,
            }
            for p in taught.points
        ]
        print_json(
            {
                **_document(taught.plant.camera(taught.camera)),
                **_fit_document(taught.fit),
                "target": taught.target,
                "points": points,
                "pictures": sorted(taught.pictures),
                "written": str(place),
            }
        )
        return
    import numpy as np

    rows = []
    for point, residual in zip(taught.points, taught.fit.residuals, strict=True):
        x, y = point.pixel
        kind = "–" if point.mark is None else point.mark.kind
        how = "refined" if point.refined else "as given"
        rows.append(
            [
                point.name,
                f"{x:.2f}",
                f"{y:.2f}",
                f"{_sigma(point.covariance):.2f}",
                f"{np.hypot(*residual):.2f}",
                kind,
                how,
            ]
        )
    print_table(
        ["point", "x px", "y px", "± px", "off px", "mark", ""],
        rows,
        title=f"target {taught.target}",
    )
    for point in taught.points:
        if point.note:
            print(f"{point.name}: {point.note}")
    _print_fit(taught.fit, len(taught.points), "points")
    print(
        f"camera {taught.camera} and {sum(p.mark is not None for p in taught.points)} marks "
        f"written to {place}"
    )


@app.command()
def receiver(
    plant: PlantArgument,
    camera: Annotated[str, typer.Option("--camera", help="Name of the camera.")],
    capped: Annotated[list[Path], typer.Option(help="Pictures with the lens capped.")],
    dark: Annotated[
        list[Path], typer.Option(help="Pictures in daylight without a beam on the receiver.")
    ],
    lit: Annotated[
        list[str],
        typer.Option(
            help="Picture with beams and its flux as a fraction of nominal: FILE=FRACTION, "
            "such as a.png=0.1."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="File to write (TOML), with a PNG beside it.")],
    outline: Annotated[
        list[str] | None,
        typer.Option(
            help="Corner of the receiver in the picture, X,Y in pixels; give all corners in "
            "order around the receiver. Default: from the camera position."
        ),
    ] = None,
    gamma: Annotated[
        float, typer.Option(min=0.1, max=10, help="Gamma of the camera response; 1: linear.")
    ] = 1.0,
    as_json: JsonOption = False,
) -> None:
    """Create the reference picture for a camera that measures the flux on the receiver."""
    from heliotrope.imaging.receiver_file import write_reference
    from heliotrope.imaging.receiver_light import ReceiverSight, take_reference
    from heliotrope.imaging.sources import average

    if out.suffix.lower() != ".toml":
        raise InputError(f"{out}: a reference is written as TOML; name it receiver.toml")
    loaded = open_plant(plant)
    if len(loaded.receivers) != 1:
        raise InputError(
            f"{plant}: {len(loaded.receivers)} receivers; the flux camera needs a plant with "
            "exactly one"
        )
    eye, surface = loaded.camera(camera), loaded.receivers[0]
    corners = _outline(outline or [], eye, surface)
    sight = ReceiverSight(eye.name, surface.name, eye.size, corners, gamma)
    plain = [_read(path) for path in dark]
    reference = take_reference(
        sight,
        average(_read(path) for path in capped),
        average(plain),
        [_lit_frame(text) for text in lit],
        8 * plain[0].pixels.dtype.itemsize,
    )
    write_reference(reference, out)
    if as_json:
        print_json(
            {
                "camera": eye.name,
                "receiver": surface.name,
                "outline_px": sight.outline,
                "black": reference.black,
                "daylight_share": reference.daylight,
                "rise": reference.rise,
                "written": str(out),
            }
        )
        return
    print(
        f"receiver {surface.name} in camera {eye.name}: nominal flux uses "
        f"{100 * reference.rise:.0f} % of the pixel range; daylight on the receiver reads as "
        f"{100 * reference.daylight:.1f} % of nominal and is subtracted"
    )
    print(f"reference written to {out}")


def _outline(texts: Sequence[str], camera: "Camera", receiver: "Receiver") -> Any:
    """Return the corners of a receiver in a camera's frame, px, (N, 2)."""
    from heliotrope.field.camera import project

    if texts:
        return [_at(f"corner={text}")[1] for text in texts]
    if camera.position is None or receiver.kind != "planar":
        raise InputError(
            f"camera {camera.name}: receiver {receiver.name} is not planar, or the camera's "
            "position is unknown; specify --outline X,Y for at least three corners"
        )
    return project(camera, receiver.face.corners)


def _lit_frame(text: str) -> "tuple[Frame, float]":
    name, sign, share = text.rpartition("=")
    refusal = f"--lit {text!r}: write FILE=FRACTION, such as lit.png=0.1"
    if not sign or not name:
        raise InputError(refusal)
    (value,) = parse_numbers(share, refusal)
    return _read(Path(name)), value


@app.command()
def show(
    plant: Annotated[Path, typer.Argument(help="Plant file, or a folder in PAINT's format.")],
    as_json: JsonOption = False,
) -> None:
    """Print the cameras of a plant and their views of its targets."""
    import numpy as np

    from heliotrope.imaging.targets.sights import sights

    loaded = open_plant(plant)
    if not loaded.cameras and not as_json:
        print(f"{plant}: no cameras; add one with heliotrope camera teach")
        return
    views = {camera.name: sights(camera, loaded.targets) for camera in loaded.cameras}
    if as_json:
        print_json(
            [
                {**_document(camera), "targets": {s.target: vars(s) for s in views[camera.name]}}
                for camera in loaded.cameras
            ]
        )
        return
    _print_cameras(loaded.cameras)
    table = [
        [
            name,
            s.target,
            f"{s.distance:.1f}",
            f"{1e3 * s.metres_per_pixel:.1f}",
            f"{np.degrees(s.obliquity):.0f}",
            f"{100 * s.share:.0f}",
            str(s.marks),
        ]
        for name, listed in views.items()
        for s in listed
    ]
    if table:
        print_table(
            ["camera", "target", "distance m", "mm/px", "obliquity °", "in frame %", "marks"],
            table,
        )
    for camera in loaded.cameras:
        if camera.position is None:
            print(
                f"camera {camera.name}: its position is unknown; find it with heliotrope camera "
                "calibrate (or teach)"
            )


def _print_cameras(cameras: "Sequence[Camera]") -> None:
    import numpy as np

    rows = []
    for camera in cameras:
        wide, high = np.degrees(_field(camera))
        where = "–" if camera.position is None else ", ".join(f"{v:.2f}" for v in camera.position)
        bent = " ".join(f"{v:.3g}" for v in np.trim_zeros(camera.distortion, "b")) or "0"
        rows.append(
            [
                camera.name,
                "{} × {}".format(*camera.size),
                f"{camera.matrix[0, 0]:.1f}",
                f"{wide:.2f} × {high:.2f}",
                where,
                bent,
                f"{camera.deviation:.2f}" if camera.deviation > 0.0 else "–",
            ]
        )
    print_table(
        [
            "camera",
            "frame px",
            "focal px",
            "field °",
            "east, north, up m",
            "distortion k1 k2 p1 p2 k3",
            "deviation px",
        ],
        rows,
    )


# -- shared ----------------------------------------------------------------------------


def _place_to_write(plant: Path, out: Path | None) -> Path:
    """Return the plant file to write, which is checked before any computation."""
    if plant.suffix.lower() == ".json":
        raise FormatError(
            plant,
            "a tower file alone is not a plant; specify the folder that also has heliostat "
            "properties (properties/ID.json), and --out plant.toml",
        )
    place = plant if out is None else out
    if place.suffix.lower() != ".toml":
        raise InputError(f"{place}: only plant files (TOML) can be written; add --out plant.toml")
    if not place.parent.is_dir():
        raise InputError(f"{place}: folder {place.parent} does not exist; create it first")
    return place


def _read(image: Path) -> "Frame":
    from heliotrope.imaging.files import read_image

    return read_image(image)


def _field(camera: "Camera") -> Any:
    """Return the horizontal and vertical angles of view, rad, (2,)."""
    import numpy as np

    from heliotrope.field.camera import undistort

    width, height = camera.size
    cx, cy = camera.matrix[:2, 2]
    ends = undistort(camera, [[-0.5, cy], [width - 0.5, cy], [cx, -0.5], [cx, height - 0.5]])
    angles = np.arctan(np.diagonal(ends.reshape(2, 2, 2), axis1=0, axis2=2))
    return np.abs(np.diff(angles, axis=0))[0]


def _document(camera: "Camera") -> dict[str, Any]:
    import numpy as np

    place: dict[str, Any] = {}
    if camera.R_enu_camera is not None:
        # As in plant files: rows right, down, forward in ENU.
        place = {"position_m": camera.position, "rotation": camera.R_enu_camera.T}
    return {
        "camera": camera.name,
        "size_px": camera.size,
        "focal_px": np.diagonal(camera.matrix)[:2],
        "center_px": camera.matrix[:2, 2],
        "field_deg": np.degrees(_field(camera)),
        "distortion": camera.distortion,
        "deviation_px": camera.deviation,
        **place,
    }


def _fit_document(fit: "CameraFit") -> dict[str, Any]:
    return {
        "sigma": {name: fit.sigma(name) for name in fit.names},
        "residuals_px": fit.residuals,
        "plane_sigma_m": fit.plane_sigma,
        "notes": list(fit.notes),
    }


def _sigma(covariance: Any) -> float:
    """Return one standard deviation for two coordinates."""
    return float((0.5 * (covariance[0, 0] + covariance[1, 1])) ** 0.5)


def _print_fit(fit: "CameraFit", count: int, what: str) -> None:
    import numpy as np

    position = np.asarray(fit.camera.position)
    names = zip(position, ("east", "north", "up"), strict=True)
    place = ", ".join(f"{v:.2f} ± {fit.sigma(name):.2f}" for v, name in names)
    rms = float(np.sqrt(np.mean(np.sum(fit.residuals**2, axis=1))))
    print(
        f"{count} {what}, residuals {rms:.2f} px; pixel positions on the target plane are "
        f"accurate to {1e3 * fit.plane_sigma:.1f} mm"
    )
    print(f"camera at ({place}) m; focal length {fit.camera.matrix[0, 0]:.1f} px")
    _print_notes(fit.notes)


def _print_notes(notes: Sequence[str]) -> None:
    for note in notes:
        print(f"note: {note}")
