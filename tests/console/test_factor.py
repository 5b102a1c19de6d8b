"""The second factor: set up, asked for, used once, recovered, reset; and what it never asks."""

import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pyotp
import pytest
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.console._attempts import AN_HOUR
from heliotrope.console.settings import ConsoleSettings
from heliotrope.errors import UnknownNameError
from heliotrope.store.factors import CODES, KEY_FILE, STEP
from support.live_console import PASSWORD, LiveConsole

Ask = Callable[..., httpx.Response]
NAME = "holder"


class Holder:
    """Somebody with a session, who makes codes as an authenticator does."""

    def __init__(self, console: LiveConsole, name: str, role: str) -> None:
        self.console, self.name, self.secret = console, name, ""
        self.http = httpx.Client(base_url=f"{console.address}api/v1/", trust_env=False)
        console.keeper.people.add(name, "none yet", role, time.time())
        console.settle(name, PASSWORD)
        assert self.sign_in().status_code == 200

    def sign_in(self, code: str = "", password: str = PASSWORD) -> httpx.Response:
        given = {"name": self.name, "password": password, "code": code}
        answer = self.http.post("session", json=given)
        if answer.status_code == 200:
            self.http.headers["X-CSRF-Token"] = answer.json()["csrf"]
        return answer

    def enrol(self) -> list[str]:
        """Set up the second factor; return the recovery codes."""
        made = self.http.post("session/factor", json={"own_password": PASSWORD})
        assert made.status_code == 200, made.text
        self.secret = made.json()["secret"]
        done = self.http.put("session/factor", json={"code": self.code(-1)})
        assert done.status_code == 200, done.text
        return [str(one) for one in done.json()["codes"]]

    def code(self, step: int = 0) -> str:
        """Return the code of a step from the present one."""
        now = self.console.server.app.state.console.now()
        return pyotp.TOTP(self.secret).at(int(now) + step * STEP)

    def unlocked(self) -> None:
        """Forget the failures so far."""
        attempts = self.console.server.app.state.console.attempts
        self.console.call(lambda: attempts.good(self.name, "127.0.0.1"))


@pytest.fixture(autouse=True)
def still(console: LiveConsole) -> Iterator[None]:
    """Stop the console's time, so that no code ends within a test."""
    here, now = console.server.app.state.console, time.time()
    console.call(lambda: setattr(here, "now", lambda: now))
    yield
    console.call(lambda: delattr(here, "now"))


@pytest.fixture
def holder(console: LiveConsole) -> Iterator[Holder]:
    made = Holder(console, NAME, "operator")
    yield made
    made.http.close()
    made.unlocked()
    console.keeper.people.remove(NAME)
    console.calm()


@pytest.fixture
def required(console: LiveConsole) -> Iterator[None]:
    """Operators and engineers need a second factor."""
    here = console.server.app.state.console
    before = here.settings

    def put(settings: ConsoleSettings) -> None:
        here.settings = settings
        here.roster.forget()

    console.call(lambda: put(ConsoleSettings(port=0, second_factor="operator")))
    yield
    console.call(lambda: put(before))


def test_it_is_asked_for_after_the_password(holder: Holder) -> None:
    holder.enrol()
    assert holder.sign_in(password="not the password").status_code == 401
    asked = holder.sign_in()
    assert asked.status_code == 428
    assert "code of your second factor" in asked.json()["detail"]
    wrong = holder.sign_in("000000" if holder.code() != "000000" else "111111")
    assert wrong.status_code == 401
    assert "already" in wrong.json()["detail"]
    good = holder.sign_in(holder.code())
    assert good.status_code == 200
    assert good.json()["factor"]


def test_the_question_for_a_code_is_no_failure(holder: Holder) -> None:
    """Every sign-in with a second factor asks for the code first."""
    holder.enrol()
    attempts = holder.console.server.app.state.console.attempts
    holder.console.call(lambda: setattr(attempts, "_good", OrderedDict()))
    for _ in range(2 * AN_HOUR):
        assert holder.sign_in().status_code == 428
    assert holder.sign_in(holder.code()).status_code == 200


def test_a_code_is_good_once(holder: Holder) -> None:
    holder.enrol()
    code = holder.code(1)
    assert holder.sign_in(code).status_code == 200
    assert holder.sign_in(code).status_code == 401
    # Nor is an earlier one, which somebody may have seen.
    assert holder.sign_in(holder.code()).status_code == 401


def test_a_secret_is_in_force_only_once_its_code_was_seen(holder: Holder) -> None:
    made = holder.http.post("session/factor", json={"own_password": PASSWORD}).json()
    assert made["qr"].startswith("data:image/svg+xml")
    assert made["secret"] in made["uri"]
    holder.secret = made["secret"]
    refused = holder.http.put("session/factor", json={"code": "x"})
    assert refused.status_code == 422
    assert "code is wrong" in refused.json()["detail"]
    assert holder.sign_in().status_code == 200
    wrong = {"own_password": "not the password"}
    assert holder.http.post("session/factor", json=wrong).status_code == 403


def test_recovery_codes_are_good_once(holder: Holder) -> None:
    codes = holder.enrol()
    assert len(set(codes)) == CODES
    assert holder.sign_in(codes[0].upper().replace("-", " ")).status_code == 200
    assert holder.sign_in(codes[0]).status_code == 401
    # They need no key file: a backup on a new machine lets its people in.
    file = holder.console.folder / KEY_FILE
    kept = file.read_bytes()
    file.unlink()
    try:
        assert holder.sign_in(holder.code(1)).status_code == 401
        assert holder.sign_in(codes[1]).status_code == 200
    finally:
        file.write_bytes(kept)
        file.chmod(0o600)


def test_no_secret_is_in_the_store(holder: Holder) -> None:
    codes = holder.enrol()
    file = holder.console.folder / KEY_FILE
    assert file.stat().st_mode & 0o777 == 0o600
    kept = b"".join(f.read_bytes() for f in holder.console.folder.glob("store.sqlite*"))
    assert NAME.encode() in kept
    for word in (holder.secret, *codes, *(one.replace("-", "") for one in codes)):
        assert word.encode() not in kept


def test_a_key_file_that_others_may_read_is_refused(holder: Holder) -> None:
    holder.enrol()
    file = holder.console.folder / KEY_FILE
    file.chmod(0o644)
    try:
        assert holder.sign_in(holder.code(1)).status_code == 401
    finally:
        file.chmod(0o600)
    holder.unlocked()
    assert holder.sign_in(holder.code(1)).status_code == 200


def test_it_is_removed_by_password_and_code(holder: Holder) -> None:
    holder.enrol()
    given = {"own_password": PASSWORD}
    assert holder.http.request("DELETE", "session/factor", json=given).status_code == 428
    given["own_code"] = holder.code()
    assert holder.http.request("DELETE", "session/factor", json=given).status_code == 204
    assert holder.sign_in().status_code == 200


def test_an_engineer_with_one_resets_that_of_others(holder: Holder, person: Ask) -> None:
    holder.enrol()
    path = f"accounts/{NAME}/factor"
    refused = person("engineer", "DELETE", path, {"own_code": "123456"})
    assert refused.status_code == 409
    assert "your own second factor" in refused.json()["detail"]
    boss = Holder(holder.console, "boss", "engineer")
    try:
        boss.enrol()
        given = {"own_password": PASSWORD, "own_code": "000000"}
        assert boss.http.request("DELETE", path, json=given).status_code == 403
        given["own_code"] = boss.code()
        assert boss.http.request("DELETE", path, json=given).status_code == 204
        assert holder.http.get("session").status_code == 401  # the sessions have ended
        assert not holder.sign_in().json()["factor"]
    finally:
        boss.http.close()
        holder.console.keeper.people.remove("boss")


def test_a_role_may_need_one(
    holder: Holder, required: None, console: LiveConsole, ask: Ask
) -> None:
    del required
    answer = holder.sign_in()
    assert answer.json()["owes"] == "factor"
    refused = holder.http.get("summary")
    assert refused.status_code == 403
    assert "set up your second factor first" in refused.json()["detail"]
    # Safe orders never ask for it.
    for path, body in (
        ("emergency", {"act": "DEFOCUS", "reason": "smoke"}),
        ("stow", {"heliostats": []}),
        ("defocus", {"heliostats": []}),
    ):
        assert holder.http.post(path, json=body).status_code == 200
    holder.enrol()
    assert holder.http.get("summary").status_code == 200
    viewer = {"name": "viewer", "password": PASSWORD}
    url = f"{console.address}api/v1/session"
    assert httpx.post(url, json=viewer, trust_env=False).json()["owes"] == ""
    assert ask("operator", "GET", "summary").status_code == 200  # programs go on


def test_every_change_is_a_security_event(holder: Holder) -> None:
    (first, *_) = holder.enrol()
    holder.sign_in(first)
    given = {"own_password": PASSWORD, "own_code": holder.code()}
    holder.http.request("DELETE", "session/factor", json=given)

    def texts() -> set[str]:
        return {e.text for e in holder.console.keeper.events(500) if e.source == "security"}

    wanted = {
        f"{NAME}: changed a second factor: {what} (from 127.0.0.1)"
        for what in ("set up", "a recovery code was used, 7 are left", "removed")
    }
    assert holder.console.until(lambda: wanted <= texts())


def test_ctl_sets_it_up_and_asks_for_it(holder: Holder, monkeypatch: pytest.MonkeyPatch) -> None:
    at = ("ctl", "--url", holder.console.address)
    asked: list[str] = []

    def answer(text: str, **_: Any) -> str:
        asked.append(text)
        return PASSWORD if text == "Password" else holder.code(len(asked) - 2)

    made = CliRunner().invoke(app, [*at, "factor", "--name", NAME], input=f"{PASSWORD}\n0\n")
    assert made.exit_code != 0
    holder.secret = made.output.split("enter the secret there: ")[1].split()[0]
    done = holder.http.put("session/factor", json={"code": holder.code(-1)})
    assert done.status_code == 200, done.text
    monkeypatch.setattr("typer.prompt", answer)
    removed = CliRunner().invoke(app, [*at, "factor", "--name", NAME, "--remove"])
    assert removed.exit_code == 0, removed.output
    assert asked == ["Password", "Code of your second factor", "Next code of your second factor"]
    assert f"{NAME} has no second factor" in removed.output


def test_an_unknown_role_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="no role 'boss'"):
        ConsoleSettings(second_factor="boss")
