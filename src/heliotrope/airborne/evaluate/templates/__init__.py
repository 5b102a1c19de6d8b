"""Templates of the report: a page and its drawings, filled by jinja2 with escaping on."""

from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


def render(name: str, **values: object) -> "Markup":
    """Return a template of this folder filled with values, safe to stand in another one."""
    from markupsafe import Markup

    return Markup(_environment().get_template(name).render(**values))  # noqa: S704  # escaped there


@lru_cache(maxsize=1)
def _environment() -> "Environment":
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader(__name__, "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
