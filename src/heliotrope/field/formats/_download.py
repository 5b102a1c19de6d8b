"""Downloads one file, resumes after an interruption, and stores only complete files.

A download is written to the file name with the suffix ``.part`` and renamed when it is complete and
verified. ETag, date and size are kept in a journal, one line of JSON per file, so that a later run
only asks the server whether the file has changed, and an interrupted download resumes only if the
file is unchanged. `docs/decisions` explains why pooch is not used.
"""

import errno
import hashlib
import json
import os
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from heliotrope.errors import FetchError

if TYPE_CHECKING:
    import httpx

Result = TypeVar("Result")

JOURNAL = ".fetch.jsonl"
#: A catalogue is read into memory; the largest known has 2,000 links and 0.6 MB.
DOCUMENT_LIMIT = 64 * 2**20

_LONGEST_PAUSE = 60.0
_LATER = {HTTPStatus.REQUEST_TIMEOUT, HTTPStatus.TOO_EARLY, HTTPStatus.TOO_MANY_REQUESTS}


class NotFoundError(FetchError):
    """The server has no such file."""


class StoppedError(FetchError):
    """The download stopped because another one failed or the user interrupted it.

    Completed parts are kept.
    """


class _LaterError(Exception):
    """A temporary failure; the server may request a pause, s, before the next attempt."""

    def __init__(self, problem: str, pause: float = 0.0) -> None:
        super().__init__(problem)
        self.pause = pause


@dataclass(frozen=True)
class FileRecord:
    """The server's description of a file.

    Attributes
    ----------
    etag, modified
        ETag and Last-Modified headers; empty if missing.
    size
        Size of the whole file, bytes; −1 if unknown.
    done
        Whether the file is complete.
    """

    etag: str
    modified: str
    size: int
    done: bool


class FetchJournal:
    """Entries by file name, appended to a file in the folder.

    Parameters
    ----------
    folder
        Folder of the files; names are relative to it.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / JOURNAL
        self._lock = threading.Lock()
        self._entries: dict[str, FileRecord] = {}
        try:
            lines = self._path.read_bytes().splitlines()
        except FileNotFoundError:
            return
        for line in lines:
            try:
                record = json.loads(line)
                name = str(record.pop("file"))
                self._entries[name] = FileRecord(**record)
            except (ValueError, KeyError, TypeError, AttributeError):
                # A line truncated by a power failure; its file is requested again.
                continue

    def get(self, name: str) -> FileRecord | None:
        """Return the last entry of a file."""
        return self._entries.get(name)

    def put(self, name: str, entry: FileRecord) -> None:
        """Store an entry."""
        # The line end is written first, so that it also terminates a truncated line.
        line = "\n" + json.dumps({"file": name, **asdict(entry)})
        with self._lock:
            self._entries[name] = entry
            with self._path.open("a", encoding="utf-8") as stream:
                stream.write(line)


@dataclass(frozen=True)
class RemoteFile:
    """A file to fetch.

    Attributes
    ----------
    url
        Address.
    path, name
        Destination, and name in the journal.
    size, sha256
        Size in bytes and hexadecimal digest, if the catalogue specifies them.
    """

    url: str
    path: Path
    name: str
    size: int | None = None
    sha256: str | None = None

    @property
    def part(self) -> Path:
        """The incomplete file."""
        return self.path.with_name(self.path.name + ".part")


@dataclass(frozen=True)
class Channel:
    """State shared by all downloads of a run.

    Attributes
    ----------
    client
        HTTP client.
    journal
        Journal of the folder.
    retries
        Consecutive failures without a new byte before a download is given up.
    backoff
        Pause after the first failure, s; doubles with each further failure.
    received
        Called with the number of bytes received.
    stop
        Ends all downloads when set.
    """

    client: "httpx.Client"
    journal: FetchJournal
    retries: int
    backoff: float
    received: Callable[[int], None]
    stop: threading.Event = field(default_factory=threading.Event)


def download(job: RemoteFile, channel: Channel) -> bool:
    """Fetch a file; return False if it exists already and has not changed.

    Raises
    ------
    FetchError
        If the file cannot be downloaded, differs from the catalogue, or cannot be stored.
    """
    if job.sha256 is not None and job.path.is_file() and _sha256(job.path) == job.sha256:
        return False
    try:
        return _repeated(job.url, channel, lambda: _attempt(job, channel), job.part)
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise FetchError(
                f"{job.path}: the disk is full; free some space and run it again, completed "
                "parts are kept"
            ) from None
        raise FetchError(f"{job.path}: cannot be written ({error.strerror})") from None


def get_document(url: str, channel: Channel) -> tuple[Any, str]:
    """Return a JSON document and its final address after redirects.

    Raises
    ------
    FetchError
        If the document cannot be downloaded, is larger than 64 MiB or is not JSON.
    """

    def attempt() -> tuple[Any, str]:
        content = bytearray()
        with channel.client.stream("GET", url, follow_redirects=True) as response:
            _check_status(response, url)
            for chunk in response.iter_bytes():
                _check_stop(channel)
                content += chunk
                if len(content) > DOCUMENT_LIMIT:
                    raise FetchError(
                        f"{url}: more than {DOCUMENT_LIMIT / 2**20:.0f} MiB; this is not a "
                        "catalogue"
                    )
            return _json(url, bytes(content)), str(response.url)

    return _repeated(url, channel, attempt)


def _repeated(
    url: str, channel: Channel, attempt: Callable[[], Result], part: Path | None = None
) -> Result:
    """Return the result of ``attempt``, repeated after pauses while it fails."""
    import httpx

    failures = 0
    while True:
        _check_stop(channel)
        before = _size(part)
        try:
            return attempt()
        except (httpx.InvalidURL, httpx.UnsupportedProtocol, httpx.TooManyRedirects) as error:
            raise FetchError(f"{url}: {error}") from None
        except (httpx.TransportError, httpx.DecodingError) as error:
            problem = _LaterError(f"{_cause(error)} ({str(error) or type(error).__name__})")
        except _LaterError as error:
            problem = error
        # A connection that breaks often but makes progress is not given up.
        failures = 1 if _size(part) > before else failures + 1
        if failures > channel.retries:
            raise FetchError(
                f"{url}: {problem}; gave up after {failures} attempts; run it again later, "
                "completed parts are kept"
            )
        pause = max(problem.pause, channel.backoff * 2.0 ** (failures - 1))
        channel.stop.wait(min(pause, _LONGEST_PAUSE))


def _cause(error: Exception) -> str:
    import httpx

    if isinstance(error, httpx.ConnectError | httpx.ConnectTimeout):
        return "no connection; check the network and the address"
    if isinstance(error, httpx.TimeoutException):
        return "the server did not reply in time"
    if isinstance(error, httpx.DecodingError):
        return "the server's reply cannot be decompressed"
    return "the connection was lost"


def _check_stop(channel: Channel) -> None:
    if channel.stop.is_set():
        raise StoppedError("stopped; completed parts are kept, run it again to resume")


def _check_status(response: "httpx.Response", url: str, *also: HTTPStatus) -> None:
    status = response.status_code
    if status == HTTPStatus.OK or status in also:
        return
    answer = f"the server replied {status} {response.reason_phrase}".rstrip()
    if status in {HTTPStatus.NOT_FOUND, HTTPStatus.GONE}:
        raise NotFoundError(f"{url}: no such file ({answer})")
    if status >= HTTPStatus.INTERNAL_SERVER_ERROR or status in _LATER:
        after = response.headers.get("retry-after", "")
        raise _LaterError(answer, float(after) if after.isdigit() else 0.0)
    raise FetchError(f"{url}: {answer}")


def _attempt(job: RemoteFile, channel: Channel) -> bool:
    have, entry = _size(job.path), channel.journal.get(job.name)
    if job.sha256 is not None or (job.size is not None and job.size != have):
        have = -1  # the catalogue describes another file
    # Compressed bytes could be neither counted nor resumed.
    headers, start = {"Accept-Encoding": "identity"}, 0
    if entry is not None and entry.done and entry.size == have:
        headers |= _if_changed(entry)
    elif entry is not None and not entry.done and _unchanged_mark(entry):
        start = max(_size(job.part), 0)
        if start:
            headers |= {"Range": f"bytes={start}-", "If-Range": _unchanged_mark(entry)}
    with channel.client.stream("GET", job.url, headers=headers, follow_redirects=True) as response:
        status = response.status_code
        if status == HTTPStatus.NOT_MODIFIED and have >= 0:
            return False
        if start and not _fits(response, start):
            job.part.unlink(missing_ok=True)
            raise _LaterError("the incomplete file does not match the one on the server")
        _check_status(response, job.url, *([HTTPStatus.PARTIAL_CONTENT] if start else []))
        start = start if status == HTTPStatus.PARTIAL_CONTENT else 0
        said = FileRecord(
            response.headers.get("etag", ""),
            response.headers.get("last-modified", ""),
            _whole(response),
            done=False,
        )
        # An incomplete file would mean that the complete one is older than the entry.
        same = entry is None or (entry.etag, entry.modified) == (said.etag, said.modified)
        if have == said.size >= 0 and same and not job.part.exists():
            channel.journal.put(job.name, replace(said, done=True))
            return False
        _store(job, channel, response, start, said)
    _finish(job, channel, said)
    return True


def _if_changed(entry: FileRecord) -> dict[str, str]:
    if entry.etag:
        return {"If-None-Match": entry.etag}
    return {"If-Modified-Since": entry.modified} if entry.modified else {}


def _unchanged_mark(entry: FileRecord) -> str:
    """Return the value for If-Range, which is never a weak ETag.

    A weak ETag does not guarantee the same bytes.
    """
    return entry.modified if entry.etag.startswith("W/") or not entry.etag else entry.etag


def _fits(response: "httpx.Response", start: int) -> bool:
    """Return whether the reply fits a range request: it is that range, or the whole file."""
    if response.status_code == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
        return False
    span = response.headers.get("content-range", "")
    return response.status_code != HTTPStatus.PARTIAL_CONTENT or span.startswith(f"bytes {start}-")


def _whole(response: "httpx.Response") -> int:
    """Return the size of the whole file; −1 if the reply does not state it."""
    if response.headers.get("content-encoding", "identity") != "identity":
        return -1
    if response.status_code == HTTPStatus.PARTIAL_CONTENT:
        size = response.headers.get("content-range", "").rpartition("/")[2]
    else:
        size = response.headers.get("content-length", "")
    return int(size) if size.isdigit() else -1


def _store(
    job: RemoteFile, channel: Channel, response: "httpx.Response", start: int, said: FileRecord
) -> None:
    with job.part.open("ab" if start else "wb") as stream:
        if not start:
            channel.journal.put(job.name, said)
        # Chunks are stored as they arrive, since larger ones would be lost if the connection
        # breaks.
        for chunk in response.iter_bytes():
            _check_stop(channel)
            stream.write(chunk)
            channel.received(len(chunk))
        stream.flush()
        os.fsync(stream.fileno())


def _finish(job: RemoteFile, channel: Channel, said: FileRecord) -> None:
    """Rename a complete file to its final name."""
    size = _size(job.part)
    if said.size >= 0 and size != said.size:
        raise _LaterError(f"{size} of {said.size} bytes arrived")
    try:
        if job.size is not None and size != job.size:
            raise FetchError(f"{job.url}: {size} bytes arrived, but the catalogue says {job.size}")
        if job.sha256 is not None and _sha256(job.part) != job.sha256:
            raise FetchError(f"{job.url}: its checksum is not the one in the catalogue")
        if job.path.suffix == ".json":
            _json(job.url, job.part.read_bytes())
    except FetchError:
        job.part.unlink()
        raise
    job.part.replace(job.path)
    channel.journal.put(job.name, replace(said, size=size, done=True))


def _json(url: str, content: bytes) -> Any:
    try:
        return json.loads(content)
    except ValueError:
        start = content[:40].decode("utf-8", "replace")
        raise FetchError(f"{url}: the reply is not JSON; it begins with {start!r}") from None


def _size(path: Path | None) -> int:
    """Return the size of a file; −1 if there is no file."""
    return path.stat().st_size if path is not None and path.is_file() else -1


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
