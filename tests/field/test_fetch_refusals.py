"""What the fetcher refuses, and the one line that says so."""

import gzip
import hashlib
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from heliotrope.errors import FetchError, InputError, UnknownNameError
from heliotrope.field.formats.fetch import FetchSettings, fetch_heliostats
from support.paint_server import (
    BIG,
    FAST,
    PLANT,
    Answer,
    Database,
    big,
    get,
    refused,
    serve,
    slow,
    status,
)


@pytest.fixture(scope="module")
def client() -> Iterator[httpx.Client]:
    """One client for most tests: to make one takes longer than what it is used for."""
    with httpx.Client(timeout=5.0) as made:
        yield made


@pytest.fixture
def database(client: httpx.Client) -> Iterator[Database]:
    with serve(client) as made:
        yield made


def test_an_unknown_heliostat_is_named_with_its_neighbours(
    database: Database, tmp_path: Path
) -> None:
    with pytest.raises(
        FetchError, match=r"heliostat AA93: .* has no heliostat with this name; did you mean AA39\?"
    ):
        fetch_heliostats("AA93", tmp_path, base_url=database.base, settings=FAST)
    del database.files[f"/{PLANT}/{PLANT}-catalog-stac.json"]
    with pytest.raises(FetchError, match="has no heliostat with this name; see its catalogue"):
        fetch_heliostats("AA93", tmp_path, base_url=database.base, settings=FAST)


def test_nothing_like_it_gets_no_suggestion(database: Database, tmp_path: Path) -> None:
    with pytest.raises(FetchError, match=r"heliostat zzz: .*; see its catalogue"):
        fetch_heliostats("zzz", tmp_path, base_url=database.base, settings=FAST)


@pytest.mark.parametrize(
    "gone",
    [
        BIG,
        "AA39/Calibration/101-stac.json",
        "AA39/Calibration/AA39-calibration-collection-stac.json",
    ],
)
def test_a_missing_file_names_the_heliostat(database: Database, tmp_path: Path, gone: str) -> None:
    del database.files[f"/{PLANT}/{gone}"]
    text = refused(database, tmp_path)
    assert text.startswith("heliostat AA39: http://")
    assert gone in text
    assert "no such file (the server replied 404 Not Found)" in text


def test_forbidden_is_not_tried_again(database: Database, tmp_path: Path) -> None:
    database.fail(BIG, status(403))
    assert "the server replied 403 Forbidden" in refused(database, tmp_path)
    assert len(database.requests(BIG)) == 1


CATALOGUE = "AA39/AA39-heliostat-catalog-stac.json"
ITEM = "AA39/Properties/AA39-item-stac.json"


@pytest.mark.parametrize(
    ("path", "content", "problem"),
    [
        (
            CATALOGUE,
            b"<html>busy</html>",
            "the reply is not JSON; it begins with '<html>busy</html>'",
        ),
        (CATALOGUE, b"", "the reply is not JSON; it begins with ''"),
        (CATALOGUE, b'{"links": [', "the reply is not JSON"),
        (CATALOGUE, b"\xff\xfe\x00", "the reply is not JSON"),
        (CATALOGUE, b"[1, 2]", "not a STAC document but a list or value"),
        (CATALOGUE, b"{}", "not a STAC catalogue: it has no list of links"),
        (CATALOGUE, b'{"links": [3]}', "not a STAC catalogue: it has no list of links"),
        (
            CATALOGUE,
            b'{"links": [{"rel": "child"}]}',
            "not a STAC catalogue: a link has no address",
        ),
        (ITEM, b'{"links": []}', "not a STAC item: it names no files with addresses"),
        (ITEM, b'{"assets": {"a": {"href": 7}}}', "not a STAC item: it names no files"),
        (BIG, b"<html>moved</html>", "the reply is not JSON; it begins with '<html>moved</html>'"),
    ],
)
def test_garbage_is_refused(
    database: Database, tmp_path: Path, path: str, content: bytes, problem: str
) -> None:
    database.put(path, content)
    assert problem in refused(database, tmp_path)
    assert not (tmp_path / BIG).exists()
    assert not (tmp_path / (BIG + ".part")).exists()


def test_an_endless_catalogue_is_refused(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("heliotrope.field.formats._download.DOCUMENT_LIMIT", 2**20)
    database.put(CATALOGUE, b"[" * (2**20 + 1))
    assert "more than 1 MiB; this is not a catalogue" in refused(database, tmp_path)


@pytest.mark.parametrize(
    "name",
    [
        "..%2F..%2F..%2Fevil.json",
        "..",
        ".bashrc",
        "a%00b.json",
        "a%5Cb.json",
        "",
        "x" * 300,
        "trick.part",
        "%2Fetc%2Fpasswd",
    ],
)
def test_names_that_lead_elsewhere_are_refused(
    database: Database, tmp_path: Path, name: str
) -> None:
    href = f"{database.base}/AA39/Properties/{name}"
    database.put(ITEM, {"assets": {"a": {"href": href}}})
    inside = tmp_path / "inside"
    assert "is not a plain file name; refused" in refused(database, inside)
    assert list(tmp_path.iterdir()) == [inside]


@pytest.mark.parametrize("href", ["file:///etc/passwd", "ftp://127.0.0.1/x.json", "data:,x.json"])
def test_other_kinds_of_addresses_are_refused(
    database: Database, tmp_path: Path, href: str
) -> None:
    database.put(ITEM, {"assets": {"a": {"href": href}}})
    assert "the address is neither http nor https; refused" in refused(database, tmp_path)


def test_what_is_no_address_is_refused(database: Database, tmp_path: Path) -> None:
    database.put(ITEM, {"assets": {"a": {"href": "http://[x"}}})
    assert "'http://[x' is not a valid address (Invalid IPv6 URL)" in refused(database, tmp_path)


def test_two_files_in_one_place_are_refused(database: Database, tmp_path: Path) -> None:
    hrefs = [f"{database.base}/{BIG}", f"{database.base}/elsewhere/{Path(BIG).name}"]
    database.put(ITEM, {"assets": {str(k): {"href": h} for k, h in enumerate(hrefs)}})
    assert "would overwrite the file from" in refused(database, tmp_path)


def checked(database: Database, **said: Any) -> None:
    href = f"{database.base}/{BIG}"
    database.put(
        ITEM, {"assets": {"a": {"href": href, **{f"file:{k}": v for k, v in said.items()}}}}
    )


def test_size_and_checksum_of_the_catalogue_are_checked(database: Database, tmp_path: Path) -> None:
    content = big(database)
    right = "1220" + hashlib.sha256(content).hexdigest()
    checked(database, size=len(content) + 1)
    text = refused(database, tmp_path)
    assert f"{len(content)} bytes arrived, but the catalogue says {len(content) + 1}" in text
    checked(database, checksum="1220" + "0" * 64)
    assert "its checksum is not the one in the catalogue" in refused(database, tmp_path)
    assert not list(tmp_path.rglob("AA39-heliostat-properties*"))
    checked(database, checksum=right, size=len(content))
    get(database, tmp_path)
    database.asked.clear()
    assert get(database, tmp_path).new == ()
    assert database.requests(BIG) == []
    (tmp_path / BIG).write_bytes(b"x" * len(content))
    assert len(get(database, tmp_path).new) == 1
    assert (tmp_path / BIG).read_bytes() == content


def test_other_checksums_are_left_alone(database: Database, tmp_path: Path) -> None:
    checked(database, checksum="1114" + "0" * 40)
    assert len(get(database, tmp_path, kinds=("properties",)).new) == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_a_full_disk_is_said(database: Database, tmp_path: Path) -> None:
    part = tmp_path / (BIG + ".part")
    part.parent.mkdir(parents=True)
    part.symlink_to("/dev/full")
    text = refused(database, tmp_path)
    assert f"{tmp_path / BIG}: the disk is full; free some space and run it again" in text
    assert not (tmp_path / BIG).exists()


def test_places_that_cannot_be_written_to(database: Database, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    assert "cannot be used (File exists)" in refused(database, tmp_path / "file")
    (tmp_path / "AA39").write_text("x")
    assert "cannot be created (" in refused(database, tmp_path)
    (tmp_path / "AA39").unlink()
    (tmp_path / (BIG + ".part")).mkdir(parents=True)
    assert "cannot be written (Is a directory)" in refused(database, tmp_path)


def test_no_network_is_said(tmp_path: Path) -> None:
    # Bound but not listening: nobody else can take the port meanwhile.
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        base = f"http://127.0.0.1:{held.getsockname()[1]}/x"
        with pytest.raises(FetchError) as error:
            fetch_heliostats("AA39", tmp_path, base_url=base, settings=FAST)
    assert "no connection; check the network and the address" in str(error.value)
    assert "gave up after 4 attempts" in str(error.value)


def test_a_silent_server_is_said(database: Database, tmp_path: Path) -> None:
    database.fail(CATALOGUE, *[slow(0.5)] * 2)
    text = refused(
        database, tmp_path, settings=FetchSettings(timeout=0.1, retries=1, backoff=0.0), client=None
    )
    assert "the server did not reply in time" in text


def test_compressed_answers(database: Database, tmp_path: Path) -> None:
    packed = {"Content-Encoding": "gzip"}
    for path in (CATALOGUE, BIG):
        whole = gzip.compress(database.files[f"/{PLANT}/{path}"])
        database.fail(path, lambda _, whole=whole: Answer(200, packed, whole))  # type: ignore[misc]
    get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == database.files[f"/{PLANT}/{BIG}"]
    database.fail(CATALOGUE, *[lambda _: Answer(200, packed, b"no gzip")] * 9)
    assert "the server's reply cannot be decompressed" in refused(database, tmp_path)


def test_endless_redirects_are_said(database: Database, tmp_path: Path) -> None:
    database.fail(CATALOGUE, *[status(302, Location=f"{database.base}/{CATALOGUE}")] * 40)
    assert "Exceeded maximum allowed redirects" in refused(database, tmp_path)


def test_a_bad_address_is_said(tmp_path: Path) -> None:
    with pytest.raises(FetchError, match="neither http nor https"):
        fetch_heliostats("AA39", tmp_path, base_url="paint-database.org", settings=FAST)
    with pytest.raises(FetchError, match=r"http://\[x/AA39.*: "):
        fetch_heliostats("AA39", tmp_path, base_url="http://[x", settings=FAST)


@pytest.mark.parametrize("name", ["", "../AA39", "AA 39", "AA39/x", "x" * 65])
def test_names_of_heliostats_are_checked(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="use a name of letters and digits, such as AA39"):
        fetch_heliostats(name, tmp_path)


def test_kinds_and_images_are_checked(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="there is no kind 'calibrations'; did you mean cal"):
        fetch_heliostats("AA39", tmp_path, kinds=("calibrations",))
    with pytest.raises(UnknownNameError, match="there is no image 'raw'"):
        fetch_heliostats("AA39", tmp_path, images=("raw",))


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        ({"workers": 0}, "workers must be between 1 and 32, not 0"),
        ({"workers": 33}, "between 1 and 32, not 33"),
        ({"timeout": 0.0}, "timeout must be above 0 s"),
        ({"timeout": float("nan")}, "not nan s"),
        ({"retries": -1}, "s and -1"),
        ({"backoff": -0.1}, "-0.1 s and 5"),
    ],
)
def test_settings_are_checked(wrong: dict[str, Any], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        FetchSettings(**wrong)


def test_importing_is_light() -> None:
    """Neither reading files nor fetching loads a heavy library before it is needed."""
    heavy = {"httpx", "lxml", "pandas", "pvlib", "matplotlib", "pydantic"}
    script = (
        "import sys, heliotrope.field.formats.fetch\n"
        "from heliotrope.field.formats import heliok, opencsp, solarpilot\n"
        f"print(sorted({heavy!r} & sys.modules.keys()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=os.environ
    )
    assert done.stdout.strip() == "[]"
