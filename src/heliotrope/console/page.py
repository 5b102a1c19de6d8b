"""The operator page: NiceGUI's frame (head, tabs, command bar), filled by the parts in static/.

The page has no powers of its own: everything it shows comes from the live stream and the API, and
everything it does goes to the API with the person's session. EMERGENCY is a plain button with its
own script, outside the frame: it works when the frame does not.
"""

from html import escape
from pathlib import Path

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, RedirectResponse, Response
from nicegui import core, ui

from heliotrope.console._files import KEPT
from heliotrope.console.auth import Caller, find_caller
from heliotrope.plant.authority import Role

#: Tabs: name of the part, title.
TABS = (
    ("plant", "Plant"), ("heliostat", "Heliostat"), ("targets", "Targets"),
    ("calibration", "Calibration"), ("clusters", "Clusters"), ("alarms", "Alarms"),
    ("logs", "Logs"), ("schedule", "Schedule"),
)  # fmt: skip
#: Modules of the page, in order of their dependencies.
_SCRIPTS = (
    "live", "dom", "palette", "orders", "map", "clicking", "marking", "panels", "people", "console",
)  # fmt: skip
_EMERGENCY = f"""
<div id="emergency-box">
  <span id="emergency-said" role="status"></span>
  <button id="emergency" type="button" title="Take all beams off the receiver now (Alt+E)">
    EMERGENCY</button>
</div>
<script defer src="{KEPT}/emergency.js"></script>
"""


class View(ui.element, component="static/view.js"):
    """A part of the page, drawn by static/console.js.

    Parameters
    ----------
    kind
        Name of the part.
    """

    def __init__(self, kind: str) -> None:
        super().__init__()
        self._props["kind"], self._props["base"] = kind, KEPT


def attach(app: FastAPI) -> None:
    """Add the page to an application; a process can have one."""
    core.app.add_exception_handler(404, _nothing)
    ui.page("/", title="Heliotrope", response_timeout=10.0)(_page)
    ui.run_with(
        app,
        title="Heliotrope",
        favicon=Path(__file__).with_name("static") / "mark.svg",
        dark=True,
        tailwind=False,
        show_welcome_message=False,
        # No code of the page runs here, so bindings need no polling.
        binding_refresh_interval=None,
        reconnect_timeout=10.0,
    )


async def _nothing(request: Request, error: Exception) -> Response:
    """Answer for a missing file of the framework, which would build a whole page for it."""
    del request, error
    return JSONResponse({"detail": "nothing is at this address"}, 404)


async def _page(request: Request) -> Response | None:
    """Return the page, or redirect to the sign-in."""
    who = await find_caller(request.scope["heliotrope"], request)
    if who is None or who.by != "session":
        return RedirectResponse("/login", 303)
    ui.add_head_html(_head(who, request.scope["heliotrope"].emergency_port))
    ui.add_body_html(_EMERGENCY)
    with ui.header(elevated=False).classes("hx-header"):
        View("head")
        ui.space()
        View("authority")
        theme = ui.button(icon="contrast", color=None)
        theme.props("flat dense round aria-label='Dark or light'")
        theme.on("click", js_handler="() => heliotrope.theme()")
        name = f"{who.person.name} · {who.person.role.name.lower()}"
        person = ui.button(name, icon="person", color=None).props("flat dense no-caps")
        with person, ui.menu():
            for title, part in _menu(who):
                ui.menu_item(title).on("click", js_handler=f"() => heliotrope.open('{part}')")
            ui.menu_item("Second factor").on(
                "click", js_handler="() => location.assign('/account')"
            )
            ui.menu_item("Sign out").on("click", js_handler="() => heliotrope.leave()")
    View("alert")
    with ui.element("main").classes("hx-main"):
        View("map")
        with ui.element("section").classes("hx-side"):
            _tabs()
    with ui.footer(elevated=False).classes("hx-footer"):
        View("bar")
    return None


def _menu(who: Caller) -> list[tuple[str, str]]:
    """Return a person's tab for accounts: title, and name of the part."""
    own = [("Change password", "password"), ("API tokens", "tokens")]
    return own + [("People", "people")] * (who.person.role >= Role.ENGINEER)


def _tabs() -> None:
    with (
        ui.tabs()
        .props("dense no-caps outside-arrows mobile-arrows inline-label")
        .classes("hx-tabs") as tabs
    ):
        for kind, title in TABS:
            with ui.tab(kind, label=title):
                if kind == "alarms":
                    View("badge").classes("hx-badge")
    with ui.tab_panels(tabs, value="plant", animated=False).classes("hx-panels"):
        for kind, _ in TABS:
            with ui.tab_panel(kind):
                View(kind)


def _head(who: Caller, port: int) -> str:
    facts = {
        "heliotrope-csrf": who.csrf,
        "heliotrope-person": who.person.name,
        "heliotrope-emergency": str(port),
        "heliotrope-role": who.person.role.name.lower(),
    }
    metas = "".join(
        f'<meta name="{name}" content="{escape(text)}">' for name, text in facts.items()
    )
    # The page's own scripts load while those of the frame do, and ask for the field at once.
    links = "".join(f'<link rel="modulepreload" href="{KEPT}/{name}.js">' for name in _SCRIPTS)
    style = f'<link rel="stylesheet" href="{KEPT}/console.css">'
    return f'{metas}{style}{links}<script type="module" src="{KEPT}/live.js"></script>'
