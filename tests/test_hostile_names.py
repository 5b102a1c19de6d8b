"""Pages and pictures show names as they are, whatever somebody has written into a file."""

import matplotlib as mpl
import numpy as np
import pytest
from lxml import etree
from matplotlib.figure import Figure

from heliotrope.airborne.evaluate.drawing import Panel, drawing
from heliotrope.files.html import as_written, picture

NAMES = (
    r"A $\frac$ 1",
    r"$\unknown{$",
    "$$",
    '"><script>alert(1)</script>',
    "</svg><script>alert(1)</script>",
    "]]><!--",
    "&amp;{{ 7 * 7 }}{% raw %}",
    "\u202egnp.exe",
)


@pytest.fixture(autouse=True)
def _agg() -> None:
    mpl.use("agg")


def figure_of(name: str) -> Figure:
    figure = Figure(figsize=(3.0, 2.0))
    left, right = figure.subplots(1, 2)
    figure.suptitle(f"{name}: 3 sightings")
    left.set_title(name)
    left.plot([0.0, 1.0], [1.0, 1000.0], label=name)
    left.set_yscale("log")
    left.set_xticks([0.0, 1.0], [name, name])
    left.annotate(name, (0.5, 10.0))
    left.legend()
    right.set_yticks([0.0, 1.0], [name, name])
    return figure


@pytest.mark.filterwarnings("ignore:Glyph")
@pytest.mark.parametrize("name", NAMES)
def test_a_picture_shows_any_name_and_is_no_markup(name: str) -> None:
    image = picture(figure_of(name), f"Errors of {name}", dpi=40)
    (found,) = etree.fromstring(f"<div>{image}</div>", etree.HTMLParser())[0][0]
    assert found.tag == "img"
    assert found.get("alt") == f"Errors of {name}"
    assert set(found.keys()) == {"loading", "src", "alt"}


def test_a_name_is_no_formula_and_a_power_of_ten_is_one() -> None:
    figure = figure_of("$x$")
    as_written(figure)
    left = figure.axes[0]
    assert not left.title.get_parse_math()
    assert not any(text.get_parse_math() for text in left.get_xticklabels())
    assert all(text.get_parse_math() for text in left.get_yticklabels())


@pytest.mark.parametrize("name", NAMES)
def test_a_drawing_is_well_formed_with_any_name(name: str) -> None:
    panel = Panel(0.0, 0.0, 200.0, 100.0, (0.0, 1.0), (0.0, 1.0), title=name)
    panel.dots(np.array([0.5]), np.array([0.5]), "#123")
    panel.text(0.5, 0.5, name)
    page = etree.fromstring(drawing([panel], 300.0, 200.0, name).encode())
    assert {etree.QName(part).localname for part in page.iter()}.isdisjoint({"script", "img"})
    assert name in "".join(page.itertext())
