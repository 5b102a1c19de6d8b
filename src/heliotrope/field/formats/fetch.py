"""Downloads heliostat and tower data from PAINT's public database.

The database is a tree of static files that follows the STAC convention. Each heliostat has a
catalogue, which links to collections (properties, calibration, deflectometry); these link to items,
and an item lists its files::

    WRI1030197-catalog-stac.json                     all heliostats
    AA39/AA39-heliostat-catalog-stac.json            one
    AA39/Calibration/AA39-calibration-collection-stac.json
    AA39/Calibration/123456-calibration-item-stac.json    an item: files by address

Files are stored as PAINT's own client stores them: ``AA39/Properties/…`` and ``AA39/Calibration/…``
below the given folder, with the tower's files beside the heliostats. An interrupted run resumes
where it stopped, and unchanged files are not downloaded again.

The data are published by DLR and KIT under CDLA-Permissive-2.0.
"""

import re
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar
from urllib.parse import unquote, urljoin, urlsplit

from heliotrope.errors import FetchError, InputError, UnknownNameError
from heliotrope.field.formats._download import (
    Channel,
    FetchJournal,
    NotFoundError,
    RemoteFile,
    download,
    get_document,
)

if TYPE_CHECKING:
    import httpx

#: The power plant of Jülich in the database.
DEFAULT_BASE_URL = "https://paint-database.org/WRI1030197"
#: Kinds of data of a heliostat; a collection has this word in its file name.
KINDS = ("properties", "calibration", "deflectometry")
#: Photographs of a calibration measurement, by asset name.
IMAGES = ("raw_image", "cropped_image", "flux_image", "flux_centered_image")

_HELIOSTAT = re.compile(r"[A-Za-z0-9_-]{1,64}")
_FILE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+ -]{0,199}")
_CATALOGUE = re.compile(r"([^/]+)-heliostat-catalog-stac\.json$")
_SHA256 = re.compile(r"1220([0-9a-f]{64})")  # as a multihash

Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclass(frozen=True)
class FetchState:
    """Progress of a run.

    Attributes
    ----------
    stage
        "looking" through the catalogue or "fetching" files.
    done, total
        While looking: documents read, and documents known so far. While fetching: files fetched,
        and files requested.
    received
        Bytes of files received.
    name
        Document or file just completed; "" at first.
    """

    stage: str
    done: int
    total: int
    received: int
    name: str = ""


class FetchProgress(Protocol):
    """Receives the progress of a run, from one thread at a time."""

    def __call__(self, state: FetchState, /) -> None:
        """Receive the state."""


@dataclass(frozen=True)
class FetchSettings:
    """Settings of a run.

    Attributes
    ----------
    workers
        Number of files downloaded at a time, 1 to 32.
    timeout
        Limit for connecting and for the next bytes, s.
    retries
        Consecutive failures without a new byte before a file is given up.
    backoff
        Pause after the first failure, s; doubles with each further failure.

    Raises
    ------
    InputError
        If a number is out of its range.
    """

    workers: int = 8
    timeout: float = 30.0
    retries: int = 5
    backoff: float = 0.5

    def __post_init__(self) -> None:
        if not 1 <= self.workers <= 32:
            raise InputError(f"workers must be between 1 and 32, not {self.workers}")
        if not self.timeout > 0.0 or not self.backoff >= 0.0 or self.retries < 0:
            raise InputError(
                f"timeout must be above 0 s, and backoff and retries 0 or more, not {self.timeout} "
                f"s, {self.backoff} s and {self.retries}"
            )


@dataclass(frozen=True)
class Fetched:
    """Result of a run.

    Attributes
    ----------
    files
        All requested files, in the order of the catalogue.
    new
        Files downloaded in this run; all others existed already.
    received
        Bytes downloaded.
    missing
        Data that are missing from the catalogue, in words.
    """

    files: tuple[Path, ...]
    new: tuple[Path, ...]
    received: int
    missing: tuple[str, ...]


def fetch_heliostats(
    ids: str | Sequence[str],
    into: str | Path,
    *,
    base_url: str = DEFAULT_BASE_URL,
    kinds: Sequence[str] = ("properties", "calibration"),
    images: Sequence[str] = (),
    progress: FetchProgress | None = None,
    client: "httpx.Client | None" = None,
    settings: FetchSettings | None = None,
) -> Fetched:
    """Fetch the database's files of one or several heliostats.

    Parameters
    ----------
    ids
        Names, such as "AA39".
    into
        Folder; created if needed.
    base_url
        Address of the plant in the database or in a copy of it.
    kinds
        Some of ``KINDS``.
    images
        Some of ``IMAGES``, to be fetched with the calibration measurements; they are large.
    progress
        Called for each document, file and chunk of a file.
    client
        HTTP client with its own timeout; the caller closes it. Default: a new client for this run.
    settings
        Default ``FetchSettings()``.

    Raises
    ------
    InputError
        If a name is malformed, or a kind or image is not known.
    FetchError
        If a heliostat is not in the database, the network or the server fails, the
        catalogue cannot be read, or a file is wrong or cannot be stored. Completed parts
        are kept, and the next run resumes.
    """
    names = [ids] if isinstance(ids, str) else list(dict.fromkeys(ids))
    for name in names:
        if not _HELIOSTAT.fullmatch(name):
            raise InputError(f"heliostat {name!r}: use a name of letters and digits, such as AA39")
    for what, chosen, known in (("kind", kinds, KINDS), ("image", images, IMAGES)):
        for choice in chosen:
            if choice not in known:
                raise UnknownNameError(what, choice, known)
    return _run(
        lambda run: run.heliostats(names, kinds, images),
        into,
        base_url,
        progress,
        client,
        settings,
    )


def fetch_tower(
    into: str | Path,
    *,
    base_url: str = DEFAULT_BASE_URL,
    progress: FetchProgress | None = None,
    client: "httpx.Client | None" = None,
    settings: FetchSettings | None = None,
) -> Fetched:
    """Fetch the measurements of the tower: its targets and its receiver.

    Parameters and errors are those of `fetch_heliostats`.
    """
    return _run(lambda run: run.tower(), into, base_url, progress, client, settings)


@dataclass(frozen=True)
class _Link:
    """A document of the catalogue, for a heliostat or for the tower ("")."""

    heliostat: str
    kind: str
    url: str


@dataclass(frozen=True)
class _Document:
    """A document with its final address, to which relative addresses refer."""

    link: _Link
    url: str
    content: dict[str, Any]

    def hrefs(self, *relations: str) -> list[str]:
        """Return the addresses of the links with some relations.

        Raises
        ------
        FetchError
            If the document has no list of links.
        """
        links = self.content.get("links")
        if not isinstance(links, list) or not all(isinstance(link, dict) for link in links):
            raise FetchError(f"{self.url}: not a STAC catalogue: it has no list of links")
        addresses = [link.get("href") for link in links if link.get("rel") in relations]
        if not all(isinstance(href, str) for href in addresses):
            raise FetchError(f"{self.url}: not a STAC catalogue: a link has no address")
        return [self.address(str(href)) for href in addresses]

    def address(self, href: str) -> str:
        """Return an address that may be relative to the document.

        Raises
        ------
        FetchError
            If the address is not valid.
        """
        try:
            return urljoin(self.url, href)
        except ValueError as error:
            raise FetchError(f"{self.url}: {href!r} is not a valid address ({error})") from None

    def assets(self) -> dict[str, dict[str, Any]]:
        """Return the files listed by an item.

        Raises
        ------
        FetchError
            If the item lists no files, or a file without an address.
        """
        assets = self.content.get("assets")
        if not isinstance(assets, dict) or not all(
            isinstance(asset, dict) and isinstance(asset.get("href"), str)
            for asset in assets.values()
        ):
            raise FetchError(f"{self.url}: not a STAC item: it names no files with addresses")
        return assets


def _run(
    find: "Callable[[_Run], list[RemoteFile]]",
    into: str | Path,
    base_url: str,
    progress: FetchProgress | None,
    client: "httpx.Client | None",
    settings: FetchSettings | None,
) -> Fetched:
    """Find the files and fetch them."""
    import httpx

    how, folder = settings or FetchSettings(), Path(into)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        journal = FetchJournal(folder)
    except OSError as error:
        raise FetchError(f"{folder}: cannot be used ({error.strerror})") from None
    opened = httpx.Client(timeout=how.timeout) if client is None else nullcontext(client)
    with opened as http:
        run = _Run(folder, base_url.rstrip("/"), progress, how, http, journal)
        jobs = _distinct(find(run))
        new = run.fetch(jobs)
    came = tuple(job.path for job, is_new in zip(jobs, new, strict=True) if is_new)
    return Fetched(tuple(job.path for job in jobs), came, run.bytes, tuple(run.missing))


class _Run:
    """One run of the fetcher."""

    def __init__(
        self,
        folder: Path,
        base: str,
        progress: FetchProgress | None,
        settings: FetchSettings,
        client: "httpx.Client",
        journal: FetchJournal,
    ) -> None:
        self.folder, self.base = folder, base
        self.missing: list[str] = []
        self.bytes = self._done = self._total = 0
        self._progress, self._workers = progress, settings.workers
        self._lock = threading.Lock()
        self._channel = Channel(client, journal, settings.retries, settings.backoff, self._received)

    def fetch(self, jobs: list[RemoteFile]) -> list[bool]:
        """Fetch the files; return, for each file, whether it was downloaded in this run."""
        self._done = self._total = 0
        return self._map("fetching", self._download, jobs)

    def heliostats(
        self, names: Sequence[str], kinds: Sequence[str], images: Sequence[str]
    ) -> list[RemoteFile]:
        """Return the files of heliostats."""
        catalogues = [
            _Link(name, "", f"{self.base}/{name}/{name}-heliostat-catalog-stac.json")
            for name in names
        ]
        collections = []
        for catalogue in self._map("looking", self._catalogue, catalogues):
            children, name = catalogue.hrefs("child"), catalogue.link.heliostat
            for kind in kinds:
                urls = [url for url in children if f"{kind}-collection" in url.split("/")[-1]]
                collections += [_Link(name, kind, url) for url in urls]
                if not urls:
                    self.missing.append(f"heliostat {name}: the database has no {kind} data")
        items = [
            _Link(collection.link.heliostat, collection.link.kind, url)
            for collection in self._map("looking", self._document, collections)
            for url in collection.hrefs("item")
        ]
        return [
            job
            for item in self._map("looking", self._document, items)
            for asset, entry in item.assets().items()
            if asset in images or not _is_image(asset, entry)
            for job in [self._job(item, entry)]
        ]

    def tower(self) -> list[RemoteFile]:
        """Return the files of the tower."""
        plant = DEFAULT_BASE_URL.rsplit("/", 1)[-1]
        link = _Link("", "", f"{self.base}/{plant}-tower-measurements-item-stac.json")
        (item,) = self._map("looking", self._document, [link])
        return [self._job(item, entry) for entry in item.assets().values()]

    def _catalogue(self, link: _Link) -> _Document:
        try:
            return self._document(link)
        except NotFoundError:
            raise FetchError(
                f"heliostat {link.heliostat}: {self.base} has no heliostat with this name"
                + self._suggestion(link.heliostat)
            ) from None

    def _suggestion(self, name: str) -> str:
        """Return a hint that lists names similar to an unknown name."""
        plant = DEFAULT_BASE_URL.rsplit("/", 1)[-1]
        try:
            root = self._document(_Link("", "", f"{self.base}/{plant}-catalog-stac.json"))
            matches = [_CATALOGUE.search(url) for url in root.hrefs("child")]
        except FetchError:
            return "; see its catalogue"
        close = get_close_matches(name, [match[1] for match in matches if match])
        return f"; did you mean {', '.join(close)}?" if close else "; see its catalogue"

    def _document(self, link: _Link) -> _Document:
        url = self._address(link.url)
        try:
            content, source = get_document(url, self._channel)
        except NotFoundError as error:
            raise NotFoundError(_of(link.heliostat, error)) from None
        except FetchError as error:
            raise FetchError(_of(link.heliostat, error)) from None
        if not isinstance(content, dict):
            raise FetchError(_of(link.heliostat, f"{url}: not a STAC document but a list or value"))
        return _Document(link, source, content)

    def _address(self, url: str) -> str:
        """Return an address in the database, or in the requested copy of it."""
        if url.startswith(DEFAULT_BASE_URL + "/"):
            url = self.base + url[len(DEFAULT_BASE_URL) :]
        if not re.match(r"https?://", url):
            raise FetchError(f"{url}: the address is neither http nor https; refused")
        return url

    def _job(self, item: _Document, asset: dict[str, Any]) -> RemoteFile:
        url = self._address(item.address(asset["href"]))
        name = unquote(urlsplit(url).path.rsplit("/", 1)[-1])
        if not _FILE.fullmatch(name) or name.endswith(".part"):
            raise FetchError(
                _of(
                    item.link.heliostat,
                    f"{item.url}: the file's name {name!r} is not a plain file name; refused",
                )
            )
        place = [item.link.heliostat, item.link.kind.capitalize(), name]
        parts = [part for part in place if part]
        size, checksum = asset.get("file:size"), str(asset.get("file:checksum", ""))
        match = _SHA256.fullmatch(checksum)
        return RemoteFile(
            url,
            self.folder.joinpath(*parts),
            "/".join(parts),
            size if isinstance(size, int) else None,
            match[1] if match else None,
        )

    def _download(self, job: RemoteFile) -> bool:
        try:
            job.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FetchError(f"{job.path.parent}: cannot be created ({error.strerror})") from None
        try:
            return download(job, self._channel)
        except FetchError as error:
            heliostat = job.name.split("/")[0] if "/" in job.name else ""
            raise FetchError(_of(heliostat, error)) from None

    def _map(
        self, stage: str, work: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> list[Result]:
        """Return the result of ``work`` for each task, in order; a failure ends all tasks."""

        def run_task(task: Task) -> Result:
            result = work(task)
            self._tell(stage, getattr(task, "url", "").split("/")[-1])
            return result

        self._total += len(tasks)
        with ThreadPoolExecutor(self._workers, thread_name_prefix="fetch") as pool:
            futures = [pool.submit(run_task, task) for task in tasks]
            try:
                for future in as_completed(futures):
                    future.result()
            except BaseException:
                self._channel.stop.set()
                pool.shutdown(cancel_futures=True)
                raise
        return [future.result() for future in futures]

    def _tell(self, stage: str, name: str) -> None:
        with self._lock:
            self._done += 1
            if self._progress is not None:
                self._progress(FetchState(stage, self._done, self._total, self.bytes, name))

    def _received(self, count: int) -> None:
        with self._lock:
            self.bytes += count
            if self._progress is not None:
                self._progress(FetchState("fetching", self._done, self._total, self.bytes))


def _is_image(asset: str, entry: dict[str, Any]) -> bool:
    return asset in IMAGES or str(entry.get("type", "")).startswith("image/")


def _of(heliostat: str, problem: object) -> str:
    return f"heliostat {heliostat}: {problem}" if heliostat else str(problem)


def _distinct(jobs: Iterable[RemoteFile]) -> list[RemoteFile]:
    """Return the jobs without duplicates.

    Raises
    ------
    FetchError
        If two different files would have the same destination.
    """
    distinct: dict[Path, RemoteFile] = {}
    for job in jobs:
        first = distinct.setdefault(job.path, job)
        if first.url != job.url:
            raise FetchError(f"{job.url}: would overwrite the file from {first.url}; refused")
    return list(distinct.values())
