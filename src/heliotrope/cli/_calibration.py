"""What the commands of calibration share: sightings in, learning behind a progress bar."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from heliotrope.cli._common import open_plant

if TYPE_CHECKING:
    from distributed import Client

    from heliotrope.calibration.learn.learning import Learned, Progress
    from heliotrope.calibration.learn.models import ScoredModel
    from heliotrope.calibration.sightings import Sightings
    from heliotrope.field.heliostats import Heliostats
    from heliotrope.field.plant import Plant

Centroid = Literal["utis", "helios"]

# Options that mean the same in every command of calibration.
Place = Annotated[
    Path, typer.Argument(help="Folder with measurements, properties, tower; or a plant file.")
]
ModelOption = Annotated[
    str, typer.Option(help="auto; jacks, full, malan8, guo6, khalsa8; or parameters: a,b,c.")
]
TableOption = Annotated[
    Path | None, typer.Option(help="Table of sightings (CSV, Parquet) for a plant file.")
]
CentroidOption = Annotated[Centroid, typer.Option(help="Which published centroid to believe.")]
PriorOption = Annotated[
    list[str] | None, typer.Option(help="NAME=SIGMA in rad, m or 1; may be repeated.")
]
SplitOption = Annotated[
    Literal["random", "chronological", "neighbour"],
    typer.Option(help="What is held out: any, the latest, or neighbourhoods of the sun."),
]
SeedOption = Annotated[int, typer.Option(help="Of the random choice.")]
SchedulerOption = Annotated[
    str | None, typer.Option(help="Address of a dask scheduler, or local:N.")
]


@dataclass(frozen=True)
class Loaded:
    """Sightings with the heliostats that they are of.

    Attributes
    ----------
    plant, group
        The plant and the name of the group with the heliostats.
    seen
        The sightings.
    ids
        A name for each.
    left_out
        A line for each that could not be used.
    """

    plant: "Plant"
    group: str
    seen: "Sightings"
    ids: tuple[str, ...]
    left_out: tuple[str, ...]

    @property
    def heliostats(self) -> "Heliostats":
        """Those of the group."""
        return self.plant.groups[self.group]


def load(place: Path, centroid: Centroid, table: Path | None) -> Loaded:
    """Return the sightings of a folder in PAINT's form, or of a table beside a plant."""
    from heliotrope.errors import FormatError, InputError

    plant = open_plant(place)
    if table is not None:
        from heliotrope.calibration.sighting_table import read_sightings

        if len(plant.groups) != 1:
            raise InputError(
                f"{place}: {len(plant.groups)} groups of heliostats; calibrate them one by one: "
                "give a plant with one group"
            )
        ((group, heliostats),) = plant.groups.items()
        seen, _, left = read_sightings(table, heliostats.names)
        ids = tuple(f"{heliostats.names[h]} {k}" for k, h in enumerate(seen.heliostat))
        loaded = Loaded(plant, group, seen, ids, tuple(left))
    elif place.is_dir():
        loaded = _load_folder(plant, place, centroid)
    else:
        raise InputError(
            f"{place}: a plant without measurements; give --sightings TABLE, or a folder with both"
        )
    if not len(loaded.seen):
        reason = f"; the first: {loaded.left_out[0]}" if loaded.left_out else ""
        raise FormatError(table or place, f"no measurement can be used{reason}")
    return loaded


def _load_folder(plant: "Plant", place: Path, centroid: Centroid) -> Loaded:
    from heliotrope.calibration.sightings import of_measurements
    from heliotrope.field.formats import measurements

    ((group, heliostats),) = plant.groups.items()
    found = measurements.read_measurements(place, centroid=centroid)
    seen, left = of_measurements(found, heliostats)
    known = set(heliostats.names)
    pairs = zip(found.heliostat, found.ids, strict=True)
    ids = tuple(f"{name} {number}" for name, number in pairs if name in known)
    return Loaded(plant, group, seen, ids, (*found.left_out, *left))


def parse_priors(given: list[str]) -> dict[str, float]:
    """Return standard deviations by parameter from texts NAME=VALUE (rad, m or 1)."""
    import math

    from heliotrope.errors import InputError

    found = {}
    for text in given:
        name, _, value = text.partition("=")
        try:
            found[name.strip()] = float(value)
        except ValueError:
            found[name.strip()] = math.nan
        if not (math.isfinite(found[name.strip()]) and found[name.strip()] > 0):
            raise InputError(
                f"--prior {text!r}: write NAME=VALUE with a value above 0 in rad, m or 1, for "
                "example tilt_north=0.005"
            )
    return found


@contextmanager
def progress(label: str, quiet: bool) -> "Iterator[Progress]":
    """Give a function (done, all) that draws a bar on the terminal's error stream."""
    from rich.console import Console
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    with Bar(console=console, transient=True, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task(label, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@contextmanager
def connected(scheduler: str | None) -> "Iterator[Client | None]":
    """Give a client of a dask cluster beside a block; None if there is no scheduler."""
    if scheduler is None:
        yield None
        return
    from heliotrope.calibration.learn import on_dask as cluster

    client = cluster.connect(scheduler)
    try:
        yield client
    finally:
        cluster.disconnect(client)


def parse_model(text: str) -> str | tuple[str, ...]:
    """Return a model's name, or the parameters of a list "tilt_north,canting,…"."""
    return tuple(p.strip() for p in text.split(",") if p.strip()) if "," in text else text


def choose_model(
    loaded: Loaded, model: str, quiet: bool, used: "object" = None
) -> "tuple[str | tuple[str, ...], tuple[ScoredModel, ...]]":
    """Return the model to use; for "auto" the simplest that explains the sightings."""
    if model != "auto":
        return parse_model(model), ()
    import numpy as np

    from heliotrope.calibration.learn import learning, models

    keep = np.ones(len(loaded.seen), np.bool_) if used is None else np.asarray(used, np.bool_)
    counts = np.bincount(loaded.seen.heliostat[keep], minlength=len(loaded.heliostats))
    if counts.max(initial=0) < learning.FEWEST:
        # Too little to compare anything: the smallest model of this kind of mechanism.
        return next(iter(models.candidate_models(loaded.heliostats.mechanism).values())), ()
    with progress("comparing models", quiet) as advance:
        trials = models.candidate_models(loaded.heliostats.mechanism)
        tried: list[str] = []

        def next_model(name: str) -> None:
            advance(len(tried), len(trials))
            tried.append(name)

        scored = models.compare_models(
            loaded.heliostats.mechanism, loaded.seen, trials, used=keep, progress=next_model
        )
    return models.choose_model(scored).parameters, scored


def describe(scored: "tuple[ScoredModel, ...]") -> tuple[str, ...]:
    """Return a line on the comparison of models."""
    if not scored:
        return ()
    from heliotrope.calibration.learn.models import choose_model as choose

    best = choose(scored)
    listed = ", ".join(f"{c.name} {c.behind:.3f}±{c.behind_error:.3f}" for c in scored)
    line = f"Model {best.name}, the simplest that explains the data. Log predictive density "
    return (f"{line}behind the best, a sighting: {listed}.",)


@contextmanager
def workers(scheduler: str | None) -> "Iterator[Callable[..., object] | None]":
    """Give a runner on a dask scheduler, or None for this process."""
    from heliotrope.calibration.learn import on_dask as cluster

    with connected(scheduler) as client:
        yield None if client is None else cluster.runner(client)


def learn(
    loaded: Loaded,
    model: str | tuple[str, ...],
    *,
    used: "object" = None,
    priors: dict[str, float] | None = None,
    scheduler: str | None = None,
    quiet: bool = False,
) -> "Learned":
    """Learn the heliostats behind a progress bar."""
    from heliotrope.calibration.learn import learning

    with workers(scheduler) as run, progress("learning", quiet) as advance:
        return learning.learn(
            loaded.heliostats.mechanism,
            loaded.seen,
            model,
            used=used,  # type: ignore[arg-type]
            priors=priors,
            runner=run,  # type: ignore[arg-type]
            progress=advance,
        )
