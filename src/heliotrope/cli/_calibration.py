"""Options and progress bars shared by the calibration commands."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from heliotrope.cli._common import parse_numbers
from heliotrope.errors import shown

if TYPE_CHECKING:
    from distributed import Client

    from heliotrope.calibration.learn.learning import Progress, Runner

# Options with the same meaning in every calibration command.
Place = Annotated[
    Path,
    typer.Argument(
        help="Folder with measurements, heliostat properties and tower file, or a plant file."
    ),
]
ModelOption = Annotated[
    str,
    typer.Option(
        help="Parameters to fit: auto, jacks, full, malan8, guo6, khalsa8, or names such as a,b,c."
    ),
]
TableOption = Annotated[
    Path | None, typer.Option(help="Table of sightings (CSV or Parquet); needed with a plant file.")
]
CentroidOption = Annotated[
    Literal["utis", "helios"], typer.Option(help="Published centroid to use.")
]
PriorOption = Annotated[
    list[str] | None,
    typer.Option(
        help="Prior standard deviation of a parameter, NAME=SIGMA, in the parameter's unit (rad, m "
        "or none); may be repeated."
    ),
]
SplitOption = Annotated[
    Literal[
        "random",
        "chronological",
        "neighbour",
        "sequential",
        "azimuth",
        "solstice",
        "balanced",
        "high-variance",
    ],
    typer.Option(
        help="How to choose the held-out sightings: random; chronological (the latest); "
        "neighbour (whole neighbourhoods of sun positions); sequential (the latest, "
        "each predicted from all earlier ones); or one of PAINT's four splits."
    ),
]
SeedOption = Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of the random split.")]
SchedulerOption = Annotated[
    str | None,
    typer.Option(help="Address of a Dask scheduler, or local:N for N processes on this computer."),
]


def parse_priors(texts: list[str]) -> dict[str, float]:
    """Return standard deviations by parameter from texts "NAME=VALUE" (rad, m or 1)."""
    priors = {}
    for text in texts:
        name, _, value = text.partition("=")
        refusal = (
            f"--prior {shown(text)}: write NAME=SIGMA with a value above 0 in the parameter's "
            "unit (rad, m or none), for example tilt_north=0.005"
        )
        (priors[name.strip()],) = parse_numbers(value, refusal, least=1e-9)
    return priors


def parse_model(text: str) -> str | tuple[str, ...]:
    """Return the name of a model, or the parameters in a list such as "tilt_north,canting"."""
    return tuple(p.strip() for p in text.split(",") if p.strip()) if "," in text else text


@contextmanager
def progress_of_steps(quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """Yield a function (step, done, total) that draws a progress bar on standard error."""
    from rich.console import Console
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    with Bar(console=console, transient=True, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task("", total=None)
        yield lambda step, done, total: bar.update(
            task, description=step, completed=done, total=total
        )


@contextmanager
def progress(label: str, quiet: bool) -> "Iterator[Progress]":
    """Yield a function (done, total) that draws a progress bar on standard error."""
    with progress_of_steps(quiet) as steps:
        yield lambda done, total: steps(label, done, total)


@contextmanager
def connected(scheduler: str | None) -> "Iterator[Client | None]":
    """Yield a client of a dask scheduler; None if no scheduler is specified."""
    if scheduler is None:
        yield None
        return
    from heliotrope.calibration.learn import on_dask

    client = on_dask.connect(scheduler)
    try:
        yield client
    finally:
        on_dask.disconnect(client)


@contextmanager
def workers(scheduler: str | None) -> "Iterator[Runner | None]":
    """Yield a runner on a dask scheduler; None to compute in this process."""
    with connected(scheduler) as client:
        if client is None:
            yield None
            return
        from heliotrope.calibration.learn import on_dask

        yield on_dask.runner(client)


def print_left_out(left_out: Sequence[str], listing: Path | None = None) -> None:
    """Print how many measurements were omitted for each reason, and the first one of each."""
    texts = [line.split(": ", 1)[-1] for line in left_out]
    alike = [re.sub(r"[\d.]+", "0", text) for text in texts]
    named = "" if listing is None else f" (all are listed in {listing})"
    for reason, count in Counter(alike).most_common():
        first = texts[alike.index(reason)]
        print(f"left out: {count} measurements, the first: {first}{named}")
