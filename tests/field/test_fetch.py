"""The fetcher against a real server on this machine: what comes, and broken lines."""

import json
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from heliotrope.errors import FetchError
from heliotrope.field.formats import fetch, paint
from heliotrope.field.formats._download import JOURNAL
from heliotrope.field.formats.fetch import FetchSettings, FetchState, fetch_heliostats, fetch_tower
from support.paint_server import (
    BIG,
    FAST,
    PLANT,
    Answer,
    Database,
    big,
    cut,
    get,
    refused,
    serve,
    slow,
    status,
    stored,
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


# -- what comes ------------------------------------------------------------------------


def test_properties_and_measurements_come(database: Database, tmp_path: Path) -> None:
    fetched = get(database, tmp_path / "new" / "folder")
    wanted = [
        "AA39/Properties/AA39-heliostat-properties.json",
        "AA39/Calibration/100-calibration-properties.json",
        "AA39/Calibration/101-calibration-properties.json",
    ]
    assert [str(f.relative_to(tmp_path / "new" / "folder")) for f in fetched.files] == wanted
    assert fetched.new == fetched.files
    assert fetched.missing == ()
    assert stored(tmp_path / "new" / "folder") == {
        name: database.files[f"/{PLANT}/{name}"] for name in wanted
    }
    assert fetched.received == sum(map(len, stored(tmp_path / "new" / "folder").values()))


def test_what_came_is_found_by_the_reader(database: Database, tmp_path: Path) -> None:
    get(database, tmp_path)
    assert paint.find_properties(tmp_path) == [tmp_path / BIG]


def test_older_names_are_known_too(database: Database, tmp_path: Path) -> None:
    old = {
        path.replace("heliostat-properties", "heliostat_properties"): content.replace(
            b"heliostat-properties", b"heliostat_properties"
        )
        for path, content in database.files.items()
    }
    database.files = old
    fetched = get(database, tmp_path, kinds=("properties",))
    assert [path.name for path in fetched.new] == ["AA39-heliostat_properties.json"]


def test_an_image_is_known_by_its_type_too(database: Database, tmp_path: Path) -> None:
    database.edit(
        "AA39/Calibration/100-stac.json",
        lambda item: item["assets"].__setitem__(
            "new_image", {"href": "n.png", "type": "image/png"}
        ),
    )
    assert not [path for path in get(database, tmp_path).files if path.suffix == ".png"]


def test_images_come_when_they_are_asked_for(database: Database, tmp_path: Path) -> None:
    get(database, tmp_path, kinds=("calibration",), images=("flux_image",))
    names = Counter(Path(name).suffix for name in stored(tmp_path))
    assert names == {".json": 2, ".png": 2}
    assert (tmp_path / "AA39/Calibration/100_flux.png").read_bytes() == bytes([100]) * 300


def test_several_heliostats_come_once_each(database: Database, tmp_path: Path) -> None:
    database.add("AB40", measurements=1)
    fetched = fetch_heliostats(
        ["AA39", "AB40", "AA39"], tmp_path, base_url=database.base + "/", settings=FAST
    )
    assert Counter(path.relative_to(tmp_path).parts[0] for path in fetched.files) == {
        "AA39": 3,
        "AB40": 2,
    }


def test_the_tower_comes(database: Database, tmp_path: Path) -> None:
    name = f"{PLANT}-tower-measurements"
    database.put(f"{name}-item-stac.json", {"assets": {"tower": {"href": f"{name}.json"}}})
    database.put(f"{name}.json", {"towers": 2})
    fetched = fetch_tower(tmp_path, base_url=database.base, settings=FAST)
    assert stored(tmp_path) == {f"{name}.json": b'{"towers": 2}'}
    assert fetched.files == (tmp_path / f"{name}.json",)


def test_what_the_database_lacks_is_said(database: Database, tmp_path: Path) -> None:
    fetched = get(database, tmp_path, kinds=("properties", "deflectometry"))
    assert fetched.missing == ("heliostat AA39: the database has no deflectometry data",)
    assert len(fetched.files) == 1


def test_a_copy_of_the_database_is_used_whatever_its_links_say(
    database: Database, tmp_path: Path
) -> None:
    database.add("AC41", root=fetch.DEFAULT_BASE_URL)
    fetched = fetch_heliostats("AC41", tmp_path, base_url=database.base, settings=FAST)
    assert len(fetched.new) == 3


def test_relative_links_and_redirects_are_followed(database: Database, tmp_path: Path) -> None:
    database.edit(
        "AA39/AA39-heliostat-catalog-stac.json",
        lambda c: c["links"].__setitem__(
            2, {"rel": "child", "href": "./old/AA39-heliostat-properties-collection-stac.json"}
        ),
    )
    place = "AA39/Properties/AA39-heliostat-properties-collection-stac.json"
    old = "AA39/old/AA39-heliostat-properties-collection-stac.json"
    database.put(old, {})
    database.fail(old, status(302, Location=f"{database.base}/{place}"))
    # Relative to where the document really is, not to where it was asked for.
    database.edit(place, lambda c: c["links"][1].__setitem__("href", "AA39-item-stac.json"))
    assert len(get(database, tmp_path, kinds=("properties",)).new) == 1


def test_own_client_stays_open(database: Database, tmp_path: Path) -> None:
    other = f"AA39/Properties/{PLANT}.json"
    database.put(other, {"moved": "here"})
    database.fail(BIG, status(301, Location=f"{database.base}/{other}"))
    with httpx.Client(headers={"User-Agent": "mine"}) as client:
        get(database, tmp_path, client=client)
        assert not client.is_closed
    assert (tmp_path / BIG).read_bytes() == b'{"moved": "here"}'
    assert {headers["user-agent"] for _, headers in database.asked} == {"mine"}


def test_files_come_side_by_side_but_not_too_many(database: Database, tmp_path: Path) -> None:
    database.add("AA39", measurements=24)
    for path in database.files:
        database.faults[path] = [slow(0.02)]
    get(database, tmp_path, settings=FetchSettings(workers=3, timeout=5.0))
    assert database.busiest == 3


# -- a second run ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("etags", "dates"), [(True, True), (True, False), (False, True), (False, False)]
)
def test_what_is_there_is_not_fetched_again(
    database: Database, tmp_path: Path, etags: bool, dates: bool
) -> None:
    database.etags, database.dates = etags, dates
    first = get(database, tmp_path)
    again = get(database, tmp_path)
    assert len(first.new) == 3
    assert again.files == first.files
    assert again.new == ()
    assert again.received == 0


@pytest.mark.parametrize("etags", [True, False])
def test_what_has_changed_comes_again(database: Database, tmp_path: Path, etags: bool) -> None:
    database.etags = etags
    get(database, tmp_path)
    database.put(BIG, {"heliostat": "moved since"})
    again = get(database, tmp_path)
    assert [path.name for path in again.new] == ["AA39-heliostat-properties.json"]
    assert json.loads((tmp_path / BIG).read_bytes()) == {"heliostat": "moved since"}


def test_a_file_that_was_damaged_comes_again(database: Database, tmp_path: Path) -> None:
    get(database, tmp_path)
    (tmp_path / BIG).write_bytes(b"{")
    assert [path.name for path in get(database, tmp_path).new] == ["AA39-heliostat-properties.json"]
    assert (tmp_path / BIG).read_bytes() == database.files[f"/{PLANT}/{BIG}"]


def test_files_copied_from_elsewhere_are_taken_over(database: Database, tmp_path: Path) -> None:
    get(database, tmp_path)
    (tmp_path / JOURNAL).unlink()
    assert get(database, tmp_path).new == ()
    assert get(database, tmp_path).new == ()
    assert "if-none-match" in database.requests(BIG)[-1]


def test_a_broken_line_of_the_journal_costs_one_question(
    database: Database, tmp_path: Path
) -> None:
    get(database, tmp_path)
    journal = (tmp_path / JOURNAL).read_bytes()
    (tmp_path / JOURNAL).write_bytes(b'7\n"x"\n[1]\n' + journal[:-20])
    assert get(database, tmp_path).new == ()
    assert get(database, tmp_path).received == 0


# -- broken lines ----------------------------------------------------------------------


@pytest.mark.parametrize("code", [500, 502, 503, 429, 408])
def test_a_server_that_stumbles_is_asked_again(
    database: Database, tmp_path: Path, code: int
) -> None:
    for path in ("AA39/AA39-heliostat-catalog-stac.json", BIG):
        database.fail(path, status(code), status(code, **{"Retry-After": "0"}))
    assert len(get(database, tmp_path).new) == 3
    assert len(database.requests(BIG)) == 3


def test_a_broken_line_goes_on_where_it_stopped(database: Database, tmp_path: Path) -> None:
    content = big(database)
    database.fail(BIG, cut(150_000))
    fetched = get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == content
    first, second = database.requests(BIG)
    assert "range" not in first
    assert second["range"] == "bytes=150000-"
    assert second["if-range"].startswith('"')
    assert fetched.received == len(content) + sum(
        len(database.files[f"/{PLANT}/AA39/Calibration/{n}-calibration-properties.json"])
        for n in (100, 101)
    )


def test_a_line_that_breaks_often_but_moves_on_is_not_given_up(
    database: Database, tmp_path: Path
) -> None:
    content = big(database)
    database.fail(BIG, *[cut(20_000)] * 9)
    get(database, tmp_path, settings=FetchSettings(retries=1, backoff=0.0))
    assert (tmp_path / BIG).read_bytes() == content
    assert len(database.requests(BIG)) == 10


def test_giving_up_keeps_what_is_there_for_the_next_run(database: Database, tmp_path: Path) -> None:
    content = big(database)
    database.fail(BIG, cut(90_000), *[status(503)] * 4)
    with pytest.raises(FetchError) as error:
        get(database, tmp_path)
    text = str(error.value)
    assert re.match(
        r"heliostat AA39: http://127\.0\.0\.1:\d+/WRI1030197/AA39/Properties/AA39-heliostat-properties"
        r"\.json: the server replied 503 Service Unavailable; gave up after 4 attempts; run it "
        r"again later, completed parts are kept$",
        text,
    )
    assert not (tmp_path / BIG).exists()
    assert (tmp_path / (BIG + ".part")).stat().st_size == 90_000
    database.asked.clear()
    get(database, tmp_path)
    assert database.requests(BIG)[0]["range"] == "bytes=90000-"
    assert (tmp_path / BIG).read_bytes() == content
    assert not list(tmp_path.rglob("*.part"))


def test_a_part_of_an_older_file_is_not_continued(database: Database, tmp_path: Path) -> None:
    big(database)
    database.fail(BIG, cut(90_000), *[status(500)] * 4)
    with pytest.raises(FetchError):
        get(database, tmp_path)
    newer = big(database, 260_000)
    get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == newer


@pytest.mark.parametrize(
    ("ranges", "etags", "dates", "resumes"),
    [
        (False, True, True, False),
        (True, False, True, True),
        # Nothing says that the rest belongs to the same file.
        (True, False, False, False),
    ],
)
def test_servers_that_promise_less(
    database: Database, tmp_path: Path, ranges: bool, etags: bool, dates: bool, resumes: bool
) -> None:
    content = big(database)
    database.ranges, database.etags, database.dates = ranges, etags, dates
    database.fail(BIG, cut(90_000))
    fetched = get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == content
    assert (fetched.received < len(content) + 90_000) == resumes


def test_a_weak_etag_is_not_trusted_with_a_range(database: Database, tmp_path: Path) -> None:
    content = big(database)
    weak = {"ETag": 'W/"a"', "Last-Modified": f"Mon, 06 Jan 2025 00:00:{len(content) % 60:02d} GMT"}
    database.fail(BIG, lambda a: Answer(a.status, weak, a.body, send=70_000))
    get(database, tmp_path)
    assert database.requests(BIG)[1]["if-range"] == weak["Last-Modified"]
    assert (tmp_path / BIG).read_bytes() == content


def test_a_part_that_is_too_long_is_thrown_away(database: Database, tmp_path: Path) -> None:
    content = big(database)
    database.fail(BIG, cut(90_000), *[status(500)] * 4)
    with pytest.raises(FetchError):
        get(database, tmp_path)
    with (tmp_path / (BIG + ".part")).open("ab") as stream:
        stream.write(b"x" * len(content))
    get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == content


@pytest.mark.parametrize("etags", [True, False])
def test_an_old_file_is_not_taken_for_the_new_one_that_broke_off(
    database: Database, tmp_path: Path, etags: bool
) -> None:
    database.etags = etags
    big(database)
    get(database, tmp_path)
    newer = database.files[f"/{PLANT}/{BIG}"].replace(b"padding", b"PADDING")
    database.put(BIG, newer)
    # A date of its own, because the size, from which the test's server makes it, is the same.
    dated = {"ETag": '"n"'} if etags else {"Last-Modified": "Tue, 07 Jan 2025 00:00:00 GMT"}
    database.fail(BIG, lambda a: Answer(200, dated, newer, send=70_000), *[status(500)] * 4)
    with pytest.raises(FetchError):
        get(database, tmp_path)
    get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == newer


@pytest.mark.parametrize("span", ["bytes 7-9/10", "", "nonsense"])
def test_a_rest_that_is_another_one_is_not_appended(
    database: Database, tmp_path: Path, span: str
) -> None:
    content = big(database)
    wrong = Answer(206, {"Content-Range": span}, b"something else")
    database.fail(BIG, cut(90_000), lambda _: wrong)
    get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == content


def test_a_rest_that_is_only_the_next_piece_is_one_more_step(
    database: Database, tmp_path: Path
) -> None:
    content = big(database)

    def piece(answer: Answer) -> Answer:
        span = answer.headers["Content-Range"]
        start = int(span.split()[1].split("-")[0])
        shorter = span.replace(f"-{len(content) - 1}/", f"-{start + 39_999}/")
        return Answer(206, answer.headers | {"Content-Range": shorter}, answer.body[:40_000])

    database.fail(BIG, cut(90_000), piece, piece)
    get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == content
    assert [headers.get("range") for headers in database.requests(BIG)] == [
        None,
        *(f"bytes={start}-" for start in (90_000, 130_000, 170_000)),
    ]


def test_a_rest_that_nobody_asked_for_is_refused(database: Database, tmp_path: Path) -> None:
    database.fail(BIG, lambda _: Answer(206, {"Content-Range": "bytes 0-1/9"}, b"{}"))
    assert "the server replied 206 Partial Content" in refused(database, tmp_path)


def test_a_process_that_was_killed_goes_on(database: Database, tmp_path: Path) -> None:
    content = big(database, 3_000_000)
    database.fail(BIG, slow(0.05))
    script = (
        "from heliotrope.field.formats.fetch import fetch_heliostats;"
        f"fetch_heliostats('AA39', {str(tmp_path)!r}, base_url={database.base!r})"
    )
    process = subprocess.Popen([sys.executable, "-c", script])
    part = tmp_path / (BIG + ".part")
    deadline = time.monotonic() + 120
    while not (part.is_file() and part.stat().st_size > 200_000):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / BIG).exists()
    kept = part.stat().st_size
    fetched = get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == content
    assert database.requests(BIG)[-1]["range"] == f"bytes={kept}-"
    assert fetched.received < len(content) - 200_000 + 1000


def test_an_interrupted_run_goes_on(database: Database, tmp_path: Path) -> None:
    content = big(database, 1_000_000)

    def interrupt(state: FetchState) -> None:
        if state.received > 300_000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        get(database, tmp_path, progress=interrupt)
    assert not (tmp_path / BIG).exists()
    get(database, tmp_path)
    assert "range" in database.requests(BIG)[-1]
    assert (tmp_path / BIG).read_bytes() == content


def test_a_file_is_never_there_half_written(database: Database, tmp_path: Path) -> None:
    content = big(database, 1_000_000)
    seen: set[int] = set()

    def look(_: FetchState) -> None:
        if (tmp_path / BIG).exists():
            seen.add((tmp_path / BIG).stat().st_size)

    get(database, tmp_path, progress=look)
    assert seen <= {len(content)}
    assert seen


# -- progress --------------------------------------------------------------------------


def test_progress_is_told(database: Database, tmp_path: Path) -> None:
    states: list[FetchState] = []
    fetched = get(database, tmp_path, progress=states.append)
    assert [state.stage for state in states] == sorted(
        (state.stage for state in states), reverse=True
    )
    assert all(state.done <= state.total for state in states)
    received = [state.received for state in states]
    assert received == sorted(received)
    last = states[-1]
    assert (last.stage, last.done, last.total) == ("fetching", 3, 3)
    assert last.received == fetched.received
    assert {state.name for state in states if state.stage == "fetching"} - {""} == {
        path.name for path in fetched.files
    }
    assert "AA39-heliostat-catalog-stac.json" in {state.name for state in states}
