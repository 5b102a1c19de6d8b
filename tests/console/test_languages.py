"""The languages of the page: no text is left out of a catalogue, and none is left over there."""

import json
import re
from pathlib import Path

import pytest

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.console._files import STATIC
from heliotrope.lcu import states
from heliotrope.lcu.names import FAULTS
from heliotrope.plant import __file__ as plant
from heliotrope.plant.operations import history, report, trends
from heliotrope.plant.orders.authority import Role
from heliotrope.safety import Act
from heliotrope.store.records import Kind
from support.page_texts import css_texts, html_texts, literals

CLICKING = STATIC.parents[1] / "imaging" / "targets" / "clicking.js"
SOURCES = [path for path in (*sorted(STATIC.glob("*.js")), CLICKING) if "uplot" not in path.name]
CATALOGUES = sorted((STATIC / "languages").glob("*.json"))
#: Read by nobody on the page: the reason that the record keeps, and whose orders are left out.
NOT_SHOWN = {"EMERGENCY button", "automatic control"}
NAMES = {"Heliotrope"}
VALUES = re.compile(r"\{(\w+)\}")


def catalogue(path: Path) -> dict[str, str]:
    """Return a catalogue; a text that stands there twice fails."""
    pairs = json.loads(path.read_text("utf-8"), object_pairs_hook=list)
    assert len(dict(pairs)) == len(pairs)
    return dict(pairs)


def said_by_the_plant() -> set[str]:
    """Return the fixed words that the plant sends and the page translates."""
    events: set[str] = set()
    for path in Path(plant).parent.rglob("*.py"):
        events |= set(re.findall(r'\.event\(\s*"(\w+)"', path.read_text("utf-8")))
    assert {"command", "calibration", "plant"} <= events
    figures = {*history.UNITS, *trends.VISITS, *trends.TELEMETRY}
    words = {*states.STATES, *(one.value for one in CalibrationOutcome), *figures}
    words |= {*report.LACKS.values(), *FAULTS, *events, *Kind, *(role.title for role in Role)}
    words |= {Act.DEFOCUS.name, Act.STOW.name, "steps", "note", "event", "alarm", "first", "never"}
    words |= {"authority", "security"}  # kinds of events that are named by a variable
    return {word.replace("_", " ") for word in words}


def used() -> set[str]:
    """Return all texts that the page looks up."""
    found = {one.text for path in SOURCES for one in literals(path.read_text("utf-8"))
             if one.translated}  # fmt: skip
    for path in STATIC.glob("*.html"):
        found |= set(html_texts(path.read_text("utf-8")))
    return (found | said_by_the_plant()) - NAMES


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_no_text_is_shown_past_the_catalogues(path: Path) -> None:
    shown = [one for one in literals(path.read_text("utf-8")) if one.shown]
    past = [f"{path.name}:{one.line}: {one.text}" for one in shown if one.text not in NOT_SHOWN]
    assert not past, "wrap in t(), with values in braces: " + "; ".join(past)


def test_no_style_sheet_adds_a_text() -> None:
    texts = [text for path in STATIC.glob("*.css") for text in css_texts(path.read_text("utf-8"))]
    assert not texts


@pytest.mark.parametrize("path", CATALOGUES, ids=lambda path: path.stem)
def test_a_catalogue_has_every_text_and_no_other(path: Path) -> None:
    known, needed = set(catalogue(path)), used()
    assert not needed - known, f"{path.name}: not translated"
    assert not known - needed, f"{path.name}: no longer used"


@pytest.mark.parametrize("path", CATALOGUES, ids=lambda path: path.stem)
def test_a_translation_has_the_values_of_its_text(path: Path) -> None:
    wrong = {
        text: said
        for text, said in catalogue(path).items()
        if not said.strip() or set(VALUES.findall(text)) != set(VALUES.findall(said))
    }
    assert not wrong


def test_the_page_offers_each_catalogue() -> None:
    source = (STATIC / "words.js").read_text("utf-8")
    (listed,) = re.findall(r"LANGUAGES = \[([^\]]*)\]", source)
    assert re.findall(r'"(\w+)"', listed) == ["en", *(path.stem for path in CATALOGUES)]


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ('h("p", {}, "left in English")', "left in English"),
        ('h("span", {}, mine ? t("yes") : "no")', "no"),
        ('h("b", { className: "hx-row hx-wide", title: "on hover" })', "on hover"),
        ("h('em', {}, ` since ${clock(at)}`)", " since "),
        ("said.textContent = `${n} heliostats`;", " heliostats"),
        ('throw new Error("nothing selected")', "nothing selected"),
        ('say("done", true)', "done"),
        ('table([["Time", (r) => clock(r.at)]], rows)', "Time"),
        ('const UNITS = { dni: ["Direct sunlight", "W/m²"] };', "Direct sunlight"),
        ('if (/[",]/.test(text)) h("p", {}, "after a pattern")', "after a pattern"),
        ("t(`${n} of ${all}`)", " of "),
    ],
)
def test_a_planted_text_is_found(source: str, text: str) -> None:
    assert [one.text for one in literals(source) if one.shown] == [text]


@pytest.mark.parametrize(
    "source",
    [
        'h("p", { className: "hx-hint hx-wide" }, t("translated {n}", { n: count(n) }))',
        'h("button", { type: "button", onclick: () => api("POST", "commands") }, t("Stow"))',
        'box.classList.toggle("bad"); // left in English',
        'h("p", {}, `${mrad(error)} mrad`, r.kind === "heliostat" ? r.name : "–")',
        'const STATES = [word("STOWED")];',
    ],
)
def test_a_translated_text_is_not_called_untranslated(source: str) -> None:
    assert not [one.text for one in literals(source) if one.shown]


def test_texts_of_html_are_found_as_the_page_looks_them_up() -> None:
    source = (
        '<title>One</title><label>Two\n  <input placeholder="Three"></label>'
        '<p translate="no">Four</p><script>five()</script><img alt="Six" src="x">'
    )
    assert html_texts(source) == ["One", "Two", "Three", "Six"]
