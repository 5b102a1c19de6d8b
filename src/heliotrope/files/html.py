"""Create self-contained HTML pages: templates with escaping, one style, embedded pictures."""

import base64
import io
from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup
    from matplotlib.figure import Figure

#: Style sheet of every report.
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 76rem; padding: 0 1rem }
table { border-collapse: collapse } td, th { padding: .15rem .8rem; text-align: right }
td:first-child, th:first-child, td:last-child, th:last-child { text-align: left }
tr:nth-child(even) { background: #8881 } img { max-width: 100%; background: #fff }
section { border-top: 1px solid #8886; margin-top: 2rem } :root { color-scheme: light dark }
"""


def render(package: str, name: str, **values: object) -> "Markup":
    """Fill a template with values, which are escaped unless they are markup.

    Parameters
    ----------
    package
        Package with the folder ``templates`` that contains the template.
    name
        File name of the template.
    values
        Variables of the template; an undefined variable is an error.
    """
    from markupsafe import Markup

    text = _environment(package).get_template(name).render(**values)
    return Markup(text)  # noqa: S704  # the template escaped it


@lru_cache
def _environment(package: str) -> "Environment":
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader(package),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )


def as_written(figure: "Figure") -> None:
    """Make a figure show its texts literally, so that "$" in a name does not start a formula.

    A name taken for a formula may be unreadable, or abort the whole report. Only the powers of ten
    on logarithmic axes are formulas.
    """
    from matplotlib.text import Text

    powers = {
        id(text)
        for axes in figure.axes
        for axis in (axes.xaxis, axes.yaxis)
        if axis.get_scale() == "log"
        for text in (*axis.get_ticklabels(), *axis.get_ticklabels(minor=True))
    }
    for text in figure.findobj(Text):
        if id(text) not in powers:
            text.set_parse_math(False)


def picture(figure: "Figure", alt: str, dpi: int = 80) -> "Markup":
    """Return a figure as an image inside a page; ``alt`` describes it for a screen reader."""
    from markupsafe import Markup

    data = io.BytesIO()
    as_written(figure)
    figure.savefig(data, dpi=dpi, format="png")
    code = base64.b64encode(data.getvalue()).decode("ascii")
    image = Markup('<img loading="lazy" src="data:image/png;base64,{}" alt="{}">')
    return image.format(code, alt)
