"""The console behind a real nginx, with the configuration of docs/how-to/deploy.md."""

import os
import re
import socket
import ssl
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from heliotrope.console.settings import ConsoleSettings
from heliotrope.local import Buckets
from support.live_console import PASSWORD, LiveConsole
from support.nginx import HERE, NAME, NGINX, Nginx, SignIn
from support.papers import certificate

pytestmark = pytest.mark.skipif(
    NGINX is None and not os.environ.get("CI"), reason="Debian's nginx is not installed"
)
DEPLOY = Path(__file__).parents[2] / "docs" / "how-to" / "deploy.md"
PAGE = DEPLOY.read_text("utf-8")
(PEOPLE,) = re.findall(r'```toml\n(format = "heliotrope-proxy".*?)```', PAGE, re.S)
(SERVERS,) = re.findall(r"```text\n(server \{.*?)```", PAGE, re.S)
WORD = "0123456789abcdef" * 4
#: What the proxy says of a person; nobody else is believed.
FORGED = {
    "X-Heliotrope-Person": "eve",
    "X-Heliotrope-Groups": "solar-engineers",
    "X-Heliotrope-Secret": WORD,
}
PAGE_ORIGIN = f"https://{NAME}"


class Front:
    """The proxy as browsers see it; `page` and `way` are its ports."""

    def __init__(self, console: LiveConsole, nginx: Nginx, oidc: SignIn, tls: ssl.SSLContext):
        self.console, self.nginx, self.oidc, self.tls = console, nginx, oidc, tls
        self.page, self.way = nginx.ports

    @contextmanager
    def browser(self, person: str = "", address: str = "127.0.0.1") -> Iterator[httpx.Client]:
        """A browser at an address whose person oauth2-proxy knows, if one is given."""
        transport = httpx.HTTPTransport(verify=self.tls, local_address=address)
        with httpx.Client(
            base_url=f"https://{HERE}:{self.page}",
            transport=transport,
            headers={"Host": NAME},
            timeout=60.0,
        ) as client:
            if person:
                client.headers["Cookie"] = f"_oauth2_proxy={person}"
            yield client

    def sign_in(self, client: httpx.Client) -> None:
        """Let a browser enter; it then sends its session's cookie and word."""
        answer = client.get("/login")
        assert (answer.status_code, answer.headers["location"]) == (303, "/"), answer.text
        self.keep(client, answer)
        client.headers["X-CSRF-Token"] = client.get("/api/v1/session").json()["csrf"]

    def keep(self, client: httpx.Client, answer: httpx.Response) -> None:
        """Keep the cookie of a session beside that of the proxy, for the name of the plant."""
        secret = answer.headers["set-cookie"].partition(";")[0]
        client.headers["Cookie"] = f"{client.headers['Cookie']}; {secret}"
        client.cookies.clear()


@pytest.fixture(scope="module")
def front(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Front]:
    """One console, one nginx, one stand-in of oauth2-proxy."""
    folder = tmp_path_factory.mktemp("proxy")
    (folder / "people.toml").write_text(PEOPLE)
    (folder / "proxy.secret").write_text(WORD)
    (folder / "proxy.secret").chmod(0o600)
    settings = ConsoleSettings(
        port=0,
        names=(NAME,),
        plain=True,
        proxies=("127.0.0.1",),
        people_by_proxy=folder / "people.toml",
    )
    console = LiveConsole(folder, 10, speed=8.0, settings=settings)
    oidc = SignIn()
    pem, key = certificate(folder, 30)
    port = httpx.URL(console.address).port
    places = {
        "/etc/nginx/console.pem": pem,
        "/etc/nginx/console.key": key,
        "http://127.0.0.1:4180": f"http://127.0.0.1:{oidc.port}",
        "http://127.0.0.1:8080": f"http://127.0.0.1:{port}",
        "http://127.0.0.1:8081": f"http://127.0.0.1:{console.emergency_port}",
        " SECRET;": f" {WORD};",
    }
    servers = SERVERS
    for old, new in places.items():
        assert old in servers, old
        servers = servers.replace(old, str(new))
    tls = ssl.create_default_context(cafile=str(pem))
    tls.check_hostname = False
    nginx = Nginx(folder, servers)
    try:
        yield Front(console, nginx, oidc, tls)
    finally:
        nginx.close()
        oidc.close()
        console.close()


@pytest.fixture(autouse=True)
def groups(front: Front) -> Iterator[None]:
    """Everybody's groups, and afterwards no emergency."""
    front.oidc.people |= {"ada": "staff,solar-operators", "eve": "staff", "mary": "solar-guests"}
    yield
    front.oidc.people.clear()
    front.console.calm()


def test_oauth2_proxy_signs_people_in(front: Front) -> None:
    with front.browser() as stranger:
        answer = stranger.get("/api/v1/health")
        assert (answer.status_code, answer.text) == (200, "sign in here")  # of oauth2-proxy
    with front.browser("ada") as ada:
        front.sign_in(ada)
        who = ada.get("/api/v1/session").json()
        assert (who["name"], who["role"]) == ("ada", "operator")
        assert ada.post("/api/v1/authority").json()["mine"]
        assert ada.delete("/api/v1/authority").status_code == 200
        front.oidc.people["ada"] = "solar-guests"
        assert ada.get("/api/v1/session").status_code == 401  # the role is another one now
    with front.browser("mary") as mary:
        front.sign_in(mary)
        assert mary.get("/api/v1/session").json()["role"] == "viewer"
        assert mary.post("/api/v1/stow", json={"heliostats": []}).status_code == 403


def test_forged_headers_are_refused(front: Front) -> None:
    """By a browser through nginx, which sets them itself; and at the console from elsewhere."""
    with front.browser("eve") as eve:
        answer = eve.get("/login", headers=FORGED)
        assert answer.status_code == 403
        assert "none of your groups has a role" in answer.text
        assert "set-cookie" not in answer.headers
    with front.browser() as stranger:
        assert stranger.get("/login", headers=FORGED).text == "sign in here"
        order = stranger.post("/api/v1/emergency", json={}, headers=FORGED)
        assert order.status_code == 401
    for address, believed in (("127.0.0.7", False), ("127.0.0.1", True)):
        transport = httpx.HTTPTransport(local_address=address)
        with httpx.Client(base_url=front.console.address, transport=transport) as client:
            answer = client.get("login", headers=FORGED)
            assert ("set-cookie" in answer.headers) == believed, address


@contextmanager
def socket_of(front: Front, cookie: str, path: str, origin: str) -> Iterator[Callable[[], object]]:
    """Open a socket through nginx during a block; yield what receives from it."""
    with connect(
        f"wss://{NAME}:{front.page}{path}",
        sock=socket.create_connection((HERE, front.page)),
        ssl=front.tls,
        origin=origin,  # type: ignore[arg-type]
        additional_headers={"Cookie": cookie},
        open_timeout=60.0,
        proxy=None,
    ) as line:
        yield lambda: line.recv(60.0)


def test_the_socket_of_the_page(front: Front) -> None:
    """The live stream, from the page's origin only."""
    with front.browser("ada") as ada:
        front.sign_in(ada)
        assert "heliotrope-csrf" in ada.get("/").text
        cookie = ada.headers["Cookie"]
    with socket_of(front, cookie, "/api/v1/live", PAGE_ORIGIN) as received:
        assert isinstance(received(), bytes)
    with (
        pytest.raises(ConnectionClosed, match="4401"),
        socket_of(front, cookie, "/api/v1/live", "https://evil.example") as received,
    ):
        received()


def test_strangers_are_counted_by_their_own_address(
    front: Front, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that asks too often is refused, whatever it writes into X-Forwarded-For; others not."""
    edge = front.console.server.app.state.edge
    monkeypatch.setattr(edge, "_stranger", Buckets(1.0, 10.0, lambda: 0.0))
    with front.browser("mary", "127.0.0.11") as flood, front.browser("mary", "127.0.0.12") as other:
        statuses = [
            flood.get("/api/v1/health", headers={"X-Forwarded-For": f"192.0.2.{k}"}).status_code
            for k in range(12)
        ]
        assert statuses == [200] * 10 + [429] * 2
        assert other.get("/api/v1/health").status_code == 200


def test_a_password_is_taken_where_the_proxy_signs_nobody_in(front: Front) -> None:
    """Without --people-by-proxy; the failures are counted by the browser's own address."""
    state = front.console.server.app.state.console
    by_proxy = state.by_proxy
    front.console.console_call(lambda: setattr(state, "by_proxy", None))
    try:
        with front.browser("mary", "127.0.0.21") as client:
            answer = client.post("/api/v1/session", json={"name": "viewer", "password": PASSWORD})
            assert answer.status_code == 200, answer.text
            front.keep(client, answer)
            assert client.get("/api/v1/session").json()["name"] == "viewer"
        opened = [
            e.text
            for e in front.console.call(lambda: front.console.live.operations.logbook.events(200))
            if e.kind == "security" and "127.0.0.21" in e.text
        ]
        assert opened
    finally:
        front.console.console_call(lambda: setattr(state, "by_proxy", by_proxy))


def test_emergency_by_both_ways_without_oauth2_proxy(front: Front) -> None:
    """From a session that has begun; oauth2-proxy is gone."""
    with front.browser("mary") as mary:
        front.sign_in(mary)
        front.oidc.people.clear()
        assert mary.get("/api/v1/session").text == "sign in here"
        order = {"reason": "smoke", "call": "one", "csrf": mary.headers["X-CSRF-Token"]}
        by_way = mary.post(
            f"https://{HERE}:{front.way}/api/v1/emergency",
            json=order,
            headers={"Host": f"{NAME}:{front.way}", "Origin": PAGE_ORIGIN},
        )
        assert by_way.status_code == 200, by_way.text
        assert by_way.headers["access-control-allow-origin"] == PAGE_ORIGIN
        front.console.calm()
        order = {"reason": "smoke", "call": "two"}
        answer = mary.post("/api/v1/emergency", json=order, headers={"Origin": PAGE_ORIGIN})
        assert answer.status_code == 200, answer.text
        assert answer.json()["on"]
