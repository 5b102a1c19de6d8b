"""``heliotrope drone simulate``: photographs of a simulated flight, with the true values."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from heliotrope.cli import _calibration as calibration
from heliotrope.cli._common import open_plant, parse_point
from heliotrope.cli.drone import _shared as shared

if TYPE_CHECKING:
    from heliotrope.airborne.photo import LedCamera
    from heliotrope.airborne.simulate.rendering import Conditions
    from heliotrope.airborne.simulate.simulation import Errors, Flight, Installed
    from heliotrope.field.heliostats import Heliostats
    from heliotrope.geometry import FloatArray
    from heliotrope.sun import Site


def simulate(
    field: Annotated[Path, typer.Argument(help="Plant file or folder.")],
    folder: Annotated[Path, typer.Argument(help="Folder for the photographs.")],
    group: Annotated[str, typer.Option(help="Group of heliostats; default: the first.")] = "",
    heliostats: Annotated[
        int,
        typer.Option(
            min=1, max=1_000_000, help="Number of heliostats, nearest to the centre first."
        ),
    ] = 80,
    hover: Annotated[
        str,
        typer.Option(
            help="Centre of the hover pattern, E,N,U in m; default: on the side towards the tower."
        ),
    ] = "",
    distance: Annotated[
        float, typer.Option(min=5, max=10_000, help="Distance from the mirrors, m.")
    ] = 100.0,
    columns: Annotated[
        int, typer.Option(min=1, max=1000, help="Number of columns in the pattern.")
    ] = 6,
    rows: Annotated[int, typer.Option(min=1, max=1000, help="Number of rows in the pattern.")] = 6,
    step: Annotated[
        float, typer.Option(min=0.01, max=1000, help="Distance between hover positions, m.")
    ] = 0.5,
    size: Annotated[
        str, typer.Option(help="Size of a photograph, WIDTHxHEIGHT, pixels.")
    ] = "4000x3000",
    focal_px: Annotated[
        float,
        typer.Option(
            min=0,
            max=1e6,
            help="Focal length of the camera, pixels; 0: three quarters of the width.",
        ),
    ] = 0.0,
    slope_mrad: Annotated[
        float, typer.Option(min=0, max=100, help="RMS slope deviation of the mirrors.")
    ] = 0.8,
    rtk_mm: Annotated[
        float, typer.Option(min=0, max=100_000, help="Random RTK error of each position.")
    ] = 8.0,
    offset_mm: Annotated[
        str, typer.Option(help="RTK offset common to all positions, E,N,U.")
    ] = "0,0,0",
    survey_mm: Annotated[
        float, typer.Option(min=0, max=100_000, help="Survey error of the heliostats' positions.")
    ] = 10.0,
    kinematics_mm: Annotated[
        float, typer.Option(min=0, max=100_000, help="Error of vertices from the kinematic model.")
    ] = 30.0,
    canting_mrad: Annotated[
        float, typer.Option(min=0, max=100, help="Canting error of facets, per direction.")
    ] = 0.3,
    map_mrad: Annotated[
        float, typer.Option(min=0, max=100, help="Error of the slope maps that are written (RMS).")
    ] = 0.1,
    lens_px: Annotated[
        float,
        typer.Option(
            min=-1000,
            max=1000,
            help="Effect of errors in the camera file at the corner of the frame, pixels.",
        ),
    ] = 0.5,
    gimbal_deg: Annotated[
        float, typer.Option(min=0, max=90, help="Error of the gimbal angles, including wobble.")
    ] = 0.5,
    hover_mm: Annotated[
        float, typer.Option(min=0, max=100_000, help="Deviation of the drone from its pattern.")
    ] = 100.0,
    speed: Annotated[
        float, typer.Option(min=0, max=100, help="Speed while photographing, m/s; 0: hover.")
    ] = 1.0,
    exposure_ms: Annotated[
        float, typer.Option(min=0, max=10_000, help="Exposure time of a photograph.")
    ] = 1.0,
    clouds: Annotated[
        float,
        typer.Option(min=0, max=1, help="Relative variation of the sky's light due to clouds."),
    ] = 0.1,
    plan: Annotated[
        Path | None,
        typer.Option(
            help=(
                "plan.json of a campaign: each pattern is written to a separate folder; --hover, "
                "--distance, --columns, --rows, --step, --heliostats are ignored."
            )
        ),
    ] = None,
    stations: Annotated[
        str, typer.Option(help="Stations of the plan to fly, such as C1-1,C1-4; default: all.")
    ] = "",
    focal: Annotated[
        float | None,
        typer.Option(min=1, max=100_000, help="Focal length of the facets, m; default: flat."),
    ] = None,
    night: Annotated[bool, typer.Option("--night", help="By moonlight.")] = False,
    dark: Annotated[
        bool,
        typer.Option("--dark", help="Moonless night: only the lamp is visible in the mirrors."),
    ] = False,
    seed: Annotated[
        int, typer.Option(min=0, max=2**63 - 1, help="Seed of all random numbers.")
    ] = 0,
) -> None:
    """Render a flight: photographs as written by a DJI drone, commands, camera, true values."""
    import numpy as np

    from heliotrope.airborne.simulate import rendering
    from heliotrope.airborne.simulate.simulation import Errors, hover_grid, look_counts

    plant = open_plant(field)
    mirrors = plant.groups[_group(group, tuple(plant.groups))]
    errors = Errors(
        rtk=(1e-3 * rtk_mm,) * 3,
        rtk_offset=tuple(1e-3 * v for v in parse_point(offset_mm, "--offset-mm")),  # type: ignore[arg-type]  # three
        survey=1e-3 * survey_mm,
        slope=1e-3 * slope_mrad,
        gimbal=float(np.radians(gimbal_deg)),
        kinematics=1e-3 * kinematics_mm,
        canting=1e-3 * canting_mrad,
        map_error=1e-3 * map_mrad,
        lens=lens_px,
        hover=1e-3 * hover_mm,
    )
    light = rendering.night() if night else rendering.Conditions()
    light = rendering.dark() if dark else light
    light = replace(light, clouds=clouds, speed=speed, exposure=1e-3 * exposure_ms)
    facets = np.inf if focal is None else focal
    drawing = _Drawing(
        plant.site, shared.rendered_camera(size, focal_px), errors, light, facets, seed
    )
    if plan is not None:
        _campaign(drawing, plan, stations, mirrors, folder)
        return
    chosen = _nearest(mirrors, heliostats)
    middle = chosen.position.mean(axis=0)
    # By default on the side of the tower, halfway up to the zenith.
    level = -middle[:2] / max(float(np.linalg.norm(middle[:2])), 1e-9)
    place = middle + distance * np.sqrt(0.5) * np.array([*level, 1.0])
    place = np.array(parse_point(hover, "--hover")) if hover else place
    counts, pattern = look_counts(chosen, place), hover_grid(place, middle, columns, rows, step)
    photographs = drawing.draw(chosen, counts, pattern, middle, folder)
    print(f"{photographs} photographs of {len(chosen)} heliostats: {folder}")
    print(f"truth (orientations.csv, photographs.csv, slopes): {folder / 'truth'}")


@dataclass(frozen=True)
class _Drawing:
    """Settings shared by all flights of a simulation."""

    site: "Site"
    camera: "LedCamera"
    errors: "Errors"
    light: "Conditions"
    focal: float
    seed: int

    def draw(
        self,
        mirrors: "Heliostats",
        counts: "FloatArray",
        pattern: "FloatArray",
        middle: "FloatArray",
        folder: Path,
        installed: "Installed | None" = None,
        flight: int = 0,
    ) -> int:
        """Render one flight into a folder; return the number of photographs."""
        from datetime import UTC, datetime, timedelta

        from heliotrope.airborne.simulate.rendering import render_flight
        from heliotrope.airborne.simulate.simulation import fly

        flown = fly(
            mirrors,
            self.camera,
            counts,
            pattern,
            middle,
            errors=self.errors,
            focal=self.focal,
            start=datetime(2026, 6, 21, 10, tzinfo=UTC) + timedelta(minutes=20 * flight),
            seed=self.seed,
            installed=installed,
            flight=flight,
        )
        origin = (self.site.latitude_deg, self.site.longitude_deg, self.site.height)
        with calibration.progress(f"rendering {folder.name}", False) as advance:
            render_flight(
                flown,
                folder,
                origin,
                conditions=self.light,
                seed=self.seed + 1000 * flight,
                progress=advance,
            )
        _write_truth(folder / "truth", flown)
        return len(flown.taken)


def _campaign(
    drawing: _Drawing, plan: Path, selection: str, mirrors: "Heliostats", folder: Path
) -> None:
    """Render the stations of a plan, each station into its folder CLUSTER-POINT."""
    from heliotrope.airborne.plan.stations import read_stations
    from heliotrope.airborne.simulate.simulation import install
    from heliotrope.errors import UnknownNameError

    stations = read_stations(plan, mirrors.names)
    names = [s.name for s in stations]
    chosen = [name.strip() for name in selection.split(",") if name.strip()] or names
    for name in chosen:
        if name not in names:
            raise UnknownNameError("station", name, names)
    photographs = 0
    for k, station in enumerate(stations):
        if station.name not in chosen:
            continue
        installed = install(
            mirrors, station.heliostats, drawing.errors, drawing.focal, drawing.seed
        )
        photographs += drawing.draw(
            mirrors.take(station.heliostats),
            station.counts,
            station.pattern,
            station.middle,
            folder / station.name,
            installed,
            k,
        )
    print(f"{photographs} photographs in {len(chosen)} flights: {folder}")
    print(f"truth of each (orientations.csv, photographs.csv, slopes): {folder}/*/truth")


def _group(name: str, known: tuple[str, ...]) -> str:
    from heliotrope.errors import InputError, UnknownNameError

    if not known:
        raise InputError("the plant has no heliostats; add a group to the plant file")
    if name and name not in known:
        raise UnknownNameError("group", name, known)
    return name or known[0]


def _nearest(heliostats: "Heliostats", count: int) -> "Heliostats":
    import numpy as np

    position = heliostats.position
    away = np.linalg.norm(position - position.mean(axis=0), axis=-1)
    return heliostats.take(np.sort(np.argsort(away, kind="stable")[:count]))


def _write_truth(folder: Path, flight: "Flight") -> None:
    import numpy as np

    from heliotrope.field.formats.slopes import write_slopes
    from heliotrope.files.text import write_text
    from heliotrope.geometry import azimuth_elevation

    (folder / "slopes").mkdir(parents=True, exist_ok=True)
    stand = flight.truth
    azimuth, elevation = azimuth_elevation(stand.rotation[:, :, 2])
    lines = ["heliostat,azimuth_deg,elevation_deg,east_m,north_m,up_m"]
    for k, name in enumerate(stand.names):
        numbers = (np.degrees(azimuth[k]), np.degrees(elevation[k]), *stand.vertex[k])
        lines.append(",".join([name, *(f"{v:.7f}" for v in numbers)]))
        slope = flight.maps[k]
        if slope is not None:
            write_slopes(folder / "slopes" / f"{name}.npz", slope)
    write_text(folder / "orientations.csv", "\n".join(lines) + "\n")
    lines = ["name,east_m,north_m,up_m"]
    lines += [f"{p.name},{','.join(f'{v:.6f}' for v in p.position)}" for p in flight.taken]
    write_text(folder / "photographs.csv", "\n".join(lines) + "\n")
