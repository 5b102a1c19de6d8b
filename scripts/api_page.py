"""Write the table of routes in docs/reference/api-http.md from the routes of the console."""

import re
from pathlib import Path

from fastapi.routing import APIRoute

from heliotrope.console.app import ROUTERS
from heliotrope.console.routes import least_role
from heliotrope.plant.interface import CALLS

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reference" / "api-http.md"
_HEAD = "| route | least role | |\n|---|---|---|\n"
_PLACES = {"none": 0, "viewer": 1, "operator": 2, "engineer": 3}


def _rows() -> list[tuple[str, str, str, str]]:
    """Return role, path, method and text of each route, in the order of the page."""
    texts = {call.request: call.text for call in CALLS.values()}
    found = []
    for route in (each for router in ROUTERS for each in router.routes):
        if isinstance(route, APIRoute):
            (method,) = route.methods
            path, role = route.path_format.removeprefix("/api/v1/"), least_role(route.dependant)
            text = texts.get(f"{method} {path}") or " ".join(route.description.split())
            text = text.removesuffix(".").removeprefix("Return " if method == "GET" else "")
            text = text[:1].lower() + text[1:]
            found.append(("none" if role is None else role.title, path, method, text))
    return sorted(found, key=lambda row: (_PLACES[row[0]], *row[1:]))


def pages() -> dict[str, str]:
    """Return the page's text by its path."""
    rows = [f"| `{method} {path}` | {role} | {text} |\n" for role, path, method, text in _rows()]
    text = PAGE.read_text(encoding="utf-8")
    made = re.sub(re.escape(_HEAD) + r"(\|.*\n)+", lambda _: _HEAD + "".join(rows), text, count=1)
    return {str(PAGE.relative_to(ROOT)): made}
