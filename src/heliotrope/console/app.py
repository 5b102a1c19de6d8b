"""The application: API, live stream and page over one plant at work in its own process.

`create` makes it; `console.serve` runs it.
"""

import asyncio
import contextlib
import itertools
import time
from collections.abc import AsyncIterator, Callable

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.staticfiles import StaticFiles

from heliotrope import __version__
from heliotrope.console import accounts, api, factor
from heliotrope.console._attempts import Attempts
from heliotrope.console._files import CLICKING, KEPT, PLAIN, STATIC, Files
from heliotrope.console.auth import Caller, Console, introduced
from heliotrope.console.by_proxy import ByProxy
from heliotrope.console.connections import FOUND
from heliotrope.console.edge import Edge
from heliotrope.console.guard import Guard
from heliotrope.console.live import Stream
from heliotrope.console.remote import RemotePeople, RemotePlant
from heliotrope.console.routes import Routes
from heliotrope.console.settings import ConsoleSettings
from heliotrope.console.sign_in import enter, set_cookie
from heliotrope.errors import HeliotropeError, UnknownNameError
from heliotrope.local import AwayError
from heliotrope.plant.audit import AuditError
from heliotrope.plant.authority import RefusedError, Role
from heliotrope.plant.interface import BusyError
from heliotrope.store.records import StoreError

ABOUT = (
    "Reads and commands a heliostat field. Sign in (POST /api/v1/session) or send a token "
    "(Authorization: Bearer). In a session, every change needs the header X-CSRF-Token with the "
    "word that the answer to the sign-in gave."
)

ROUTERS = (api.router, accounts.router, factor.router)
#: Errors of a request that the answer lists, and their longest texts, characters.
MOST_ERRORS, LONGEST_TEXT, LONGEST_WORD = 5, 200, 64


def create(plant: RemotePlant, settings: ConsoleSettings | None = None) -> FastAPI:
    """Return the application.

    Parameters
    ----------
    plant
        The plant at work, in its own process.
    settings
        Settings of the console. A process can have one page (NiceGUI is global), and any number of
        applications without one.
    """
    chosen = settings or ConsoleSettings()
    people, stream = RemotePeople(plant), Stream(plant, chosen.period)
    attempts = Attempts(time.monotonic, chosen.proxies)
    console = Console(plant, people, chosen, stream, attempts)
    if chosen.people_by_proxy is not None:
        console.by_proxy = ByProxy.read(chosen.people_by_proxy)

    @contextlib.asynccontextmanager
    async def alive(app: FastAPI) -> AsyncIterator[None]:
        del app
        people.begin()
        async with asyncio.TaskGroup() as group:
            parts = (stream.run(), console.forget_expired())
            works = [group.create_task(part) for part in parts]
            yield
            for work in works:
                work.cancel()

    app = FastAPI(
        title="Heliotrope",
        version=__version__,
        description=ABOUT,
        lifespan=alive,
        openapi_url="/api/v1/openapi.json",
        docs_url=None,
        redoc_url=None,
    )
    app.state.console, app.state.edge = console, Edge()
    for router in ROUTERS:
        app.include_router(router)
    for kind, status in (
        (HeliotropeError, 422),
        (BusyError, 429),
        (UnknownNameError, 404),
        (RefusedError, 409),
        (AuditError, 503),
        (StoreError, 503),
        (AwayError, 503),
    ):
        app.add_exception_handler(kind, _problem(status))
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_middleware(Files)
    # The middleware added last comes first.
    app.add_middleware(Guard, console=lambda: console, routes=_routes(chosen), edge=app.state.edge)
    _pages(app)
    if chosen.page:
        from heliotrope.console import page

        page.attach(app)
    return app


def _problem(status: int) -> Callable[[Request, Exception], Response]:
    def answer(request: Request, error: Exception) -> Response:
        del request
        headers = {"Retry-After": "1"} if status == 429 else None
        return JSONResponse({"detail": str(error)}, status, headers)

    return answer


def _invalid(request: Request, error: Exception) -> Response:
    """Return what is wrong with a request, without its contents."""
    del request
    assert isinstance(error, RequestValidationError)
    errors = [
        {
            "type": str(one["type"])[:LONGEST_WORD],
            "loc": [part if isinstance(part, int) else part[:LONGEST_WORD] for part in one["loc"]],
            "msg": str(one["msg"])[:LONGEST_TEXT],
        }
        for one in itertools.islice(error.errors(), MOST_ERRORS)
    ]
    return JSONResponse({"detail": errors}, 422)


def _routes(settings: ConsoleSettings) -> Routes:
    """Return the routes that the guard admits."""
    files = [
        f"{place}/{file.name}" for place in (KEPT, PLAIN) for file in (*STATIC.iterdir(), CLICKING)
    ]
    page = ["/"] * settings.page
    own = {"/api/v1/openapi.json": Role.VIEWER}
    if settings.page:
        own["/favicon.ico"] = Role.VIEWER
    return Routes(ROUTERS, [*files, *page, "/login", "/emergency", "/account"], own)


def _pages(app: FastAPI) -> None:
    """Add the page's files and the sign-in page, which does without the frame."""

    async def clicking(request: Request) -> Response:
        del request
        return FileResponse(CLICKING, media_type="text/javascript; charset=utf-8")

    for place in (KEPT, PLAIN):
        app.add_route(f"{place}/{CLICKING.name}", clicking, include_in_schema=False)
        app.mount(place, StaticFiles(directory=STATIC), name=place)

    @app.get("/login", include_in_schema=False)
    async def login(request: Request) -> Response:
        console: Console = request.scope["heliotrope"]
        if (found := introduced(console, request)) is not None:
            answer = RedirectResponse("/", 303)
            set_cookie(console, answer, await enter(console, found, request))
            return answer
        return FileResponse(STATIC / "login.html", media_type="text/html; charset=utf-8")

    plain = {
        name: (STATIC / f"{name}.html").read_text("utf-8") for name in ("emergency", "account")
    }

    @app.get("/emergency", include_in_schema=False)
    @app.get("/account", include_in_schema=False)
    async def with_emergency(request: Request) -> Response:
        console: Console = request.scope["heliotrope"]
        who: Caller | None = request.scope[FOUND]
        facts = {"csrf": "" if who is None else who.csrf, "emergency": console.emergency_port}
        metas = "".join(
            f'<meta name="heliotrope-{name}" content="{text}">' for name, text in facts.items()
        )
        text = plain[request.scope["path"].strip("/")]
        return HTMLResponse(text.replace("<main>", f"{metas}\n<main>"))
