"""The application: API, live stream and page for one running plant, in its own process.

`create` creates the application; `console.serve` runs it.
"""

import asyncio
import contextlib
import itertools
import time
from collections.abc import AsyncIterator, Callable
from html import escape

from fastapi import FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, RedirectResponse, Response

from heliotrope import __version__
from heliotrope.console import accounts, api, factor
from heliotrope.console._attempts import SignInFailures
from heliotrope.console._files import PAGES, Files, page
from heliotrope.console.auth import Caller, Console, introduced
from heliotrope.console.by_proxy import ByProxy
from heliotrope.console.connections import FOUND
from heliotrope.console.edge import Edge
from heliotrope.console.guard import Guard
from heliotrope.console.headers import network_of
from heliotrope.console.live import Stream
from heliotrope.console.presence import Presence
from heliotrope.console.remote import RemotePeople, RemotePlant
from heliotrope.console.roster import Key, Roster
from heliotrope.console.routes import Routes
from heliotrope.console.settings import ConsoleSettings
from heliotrope.console.sign_in import enter, enter_once, set_cookie
from heliotrope.errors import HeliotropeError, UnknownNameError
from heliotrope.local import AwayError
from heliotrope.plant.interface import BusyError
from heliotrope.plant.orders.audit import AuditError
from heliotrope.plant.orders.authority import RefusedError, Role
from heliotrope.store.people import ApiToken, Session
from heliotrope.store.records import StoreError

ABOUT = (
    "Reads and commands a heliostat field. Sign in (POST /api/v1/session) or send a token "
    "(Authorization: Bearer). In a session, every change needs the header X-CSRF-Token with "
    "the value from the reply to the sign-in."
)

ROUTERS = (api.router, accounts.router, factor.router)
#: Address of the one-time link.
ENTER = "/enter"
#: Number of errors that the response to a request lists, and their longest texts, characters.
MOST_ERRORS, LONGEST_TEXT, LONGEST_WORD = 5, 200, 64


def create(plant: RemotePlant, settings: ConsoleSettings | None = None) -> FastAPI:
    """Return the application.

    Parameters
    ----------
    plant
        The running plant, in its own process.
    settings
        Settings of the console.
    """
    chosen = settings or ConsoleSettings()
    people, stream = RemotePeople(plant), Stream(plant, chosen.period, chosen.viewers)
    attempts = SignInFailures(time.monotonic, chosen.proxies, an_hour=chosen.sign_ins)

    async def read(used: list[str]) -> dict[Key, Session | ApiToken]:
        found = await plant.valid(used)
        # Every signed-in user has a place there, even after a restart of this process.
        for one in found.values():
            if isinstance(one, Session):
                attempts.meet(one.name, network_of(one.note))
        return found

    presence = Presence(chosen.idle_s, time.monotonic)
    console = Console(plant, people, chosen, stream, attempts, Roster(read), presence)
    if chosen.people_by_proxy is not None:
        console.by_proxy = ByProxy.read(chosen.people_by_proxy)

    @contextlib.asynccontextmanager
    async def alive(app: FastAPI) -> AsyncIterator[None]:
        del app
        people.begin()
        async with asyncio.TaskGroup() as group:
            parts = (stream.run(), console.roster.run(), console.forget_expired())
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
    # The middleware added last is called first.
    app.add_middleware(Guard, console=lambda: console, routes=_routes(), edge=app.state.edge)
    _pages(app)
    return app


def _problem(status: int) -> Callable[[Request, Exception], Response]:
    def answer(request: Request, error: Exception) -> Response:
        del request
        headers = {"Retry-After": "1"} if status == 429 else None
        return JSONResponse({"detail": str(error)}, status, headers)

    return answer


def _invalid(request: Request, error: Exception) -> Response:
    """Return the errors of a request, without the content of the request."""
    del request
    assert isinstance(error, RequestValidationError)
    errors = [
        {
            "type": str(problem["type"])[:LONGEST_WORD],
            "loc": [
                part if isinstance(part, int) else part[:LONGEST_WORD] for part in problem["loc"]
            ],
            "msg": str(problem["msg"])[:LONGEST_TEXT],
        }
        for problem in itertools.islice(error.errors(), MOST_ERRORS)
    ]
    return JSONResponse({"detail": errors}, 422)


def _routes() -> Routes:
    """Return the routes that the guard admits."""
    own = {"/api/v1/openapi.json": Role.VIEWER}
    return Routes(ROUTERS, [*Files.paths, *PAGES, "/login", ENTER], own)


def _pages(app: FastAPI) -> None:
    """Add the pages; the guard admits only callers who may see them."""
    texts = {path: page(name) for path, name in PAGES.items()}

    async def show(request: Request) -> Response:
        console: Console = request.scope["heliotrope"]
        who: Caller | None = request.scope[FOUND]
        facts = {"emergency": str(console.emergency_port)}
        if who is not None:
            facts |= {"csrf": who.csrf, "person": who.person.name}
            facts["role"] = who.person.role.name.lower()
        metas = "".join(
            f'\n<meta name="heliotrope-{name}" content="{escape(text)}">'
            for name, text in facts.items()
        )
        text = texts[request.scope["path"]]
        return HTMLResponse(text.replace("</title>", f"</title>{metas}"))

    async def login(request: Request) -> Response:
        console: Console = request.scope["heliotrope"]
        if (person := introduced(console, request)) is not None:
            answer = RedirectResponse("/", 303)
            set_cookie(console, answer, await enter(console, person, request))
            return answer
        notice, text = escape(console.settings.notice), page("login")
        if notice:
            text = text.replace('id="notice" hidden>', f'id="notice">{notice}')
        return HTMLResponse(text)

    async def follow_link(request: Request) -> Response:
        console: Console = request.scope["heliotrope"]
        if request.method == "HEAD" or "prefetch" in request.headers.get("sec-purpose", ""):
            return Response(status_code=503)  # only a person who opens the link uses it up
        try:
            secret = await enter_once(console, request.query_params.get("once", ""), request)
        except HTTPException as refusal:
            return HTMLResponse(page("enter"), refusal.status_code)
        answer = RedirectResponse("/", 303)
        set_cookie(console, answer, secret)
        return answer

    for path in PAGES:
        app.add_route(path, show, include_in_schema=False)
    app.add_route("/login", login, include_in_schema=False)
    app.add_route(ENTER, follow_link, include_in_schema=False)
