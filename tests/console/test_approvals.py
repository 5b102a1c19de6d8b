"""A second engineer's approval by API, by `ctl` and on the page."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.console import _secrets
from heliotrope.field.approval import ApprovalSettings
from heliotrope.plant.orders.authority import Person, Role
from support.live_console import PASSWORD, LiveConsole
from support.pages import NEEDS_BROWSER, said

Ask = Callable[..., httpx.Response]
Ctl = Callable[..., str]
OPERATOR = Person("operator", Role.OPERATOR)
SECOND, VALUES = "edda", {"tilt_east": 0.0005}


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """A plant whose file asks for a second approval, with two engineers."""
    made = LiveConsole(
        tmp_path_factory.mktemp("approvals"),
        12,
        speed=8.0,
        approval=ApprovalSettings(parameters=True),
    )
    made.keeper.people.add(SECOND, _secrets.hash_password(PASSWORD), "engineer", time.time())
    yield made
    made.close()


@pytest.fixture(scope="module")
def field(console: LiveConsole) -> LiveConsole:
    return console


@pytest.fixture(scope="module")
def tokens(console: LiveConsole) -> dict[str, str]:
    people, now = console.keeper.people, time.time()
    roles = {"viewer": "viewer", "operator": "operator", "engineer": "engineer", SECOND: "engineer"}
    return {name: people.add_token(name, "tests", role, now)[1] for name, role in roles.items()}


@pytest.fixture
def ctl(console: LiveConsole, tokens: dict[str, str], tmp_path: Path) -> Ctl:
    """Run `heliotrope ctl` as somebody; ``code`` is the exit code that is expected."""

    def run(who: str, *words: str, code: int = 0, data: bool = False) -> str:
        secret = tmp_path / who
        secret.write_text(tokens[who])
        where = ["--data", str(console.folder)] if data else ["--url", console.address]
        found = CliRunner().invoke(app, ["ctl", *where, "--token-file", str(secret), *words])
        assert found.exit_code == code, (found.output, found.exception)
        return f"{found.output}{found.exception or ''}"

    return run


def stowed(console: LiveConsole, name: str) -> None:
    operations = console.live.operations
    console.call(lambda: operations.stow(OPERATOR, (name,)))
    console.until(lambda: operations.viewer.heliostat(name).state == "STOWED")


def test_two_engineers_by_the_api(console: LiveConsole, ask: Ask) -> None:
    name, beliefs = console.live.names[0], console.live.plant.beliefs
    stowed(console, name)
    assert ask("viewer", "GET", f"heliostats/{name}/parameters").json()["approval"] is True
    order = {"heliostat": name, "values": VALUES, "reason": "levelled"}
    assert ask("operator", "POST", "parameters", order).status_code == 403
    ticket = ask("engineer", "POST", "parameters", order).json()  # nobody has the authority
    assert (ticket["command"], ticket["finished"]) == ("APPROVAL", False)
    assert "for another engineer's approval" in ticket["text"]
    (change,) = ask("viewer", "GET", "parameters/waiting").json()
    assert (change["author"], change["heliostat"]) == ("engineer", name)
    path = f"parameters/waiting/{change['number']}"
    for role in ("viewer", "operator"):
        assert ask(role, "POST", f"{path}/approve").status_code == 403
        assert ask(role, "POST", f"{path}/refuse", {"reason": "no"}).status_code == 403
    own = ask("engineer", "POST", f"{path}/approve")
    assert (own.status_code, "another engineer must decide" in own.json()["detail"]) == (409, True)
    assert ask(SECOND, "DELETE", path).status_code == 409
    early = ask(SECOND, "POST", f"{path}/approve")
    assert (early.status_code, "take command first" in early.json()["detail"]) == (409, True)
    assert ask(SECOND, "POST", "parameters/waiting/7/approve").status_code == 404
    assert console.call(lambda: beliefs.record(name)) is None
    assert ask(SECOND, "POST", "authority").is_success
    written = ask(SECOND, "POST", f"{path}/approve").json()
    assert written["command"] == "PARAMETERS"
    console.until(lambda: beliefs.record(name) is not None)
    ask(SECOND, "DELETE", "authority")
    record = console.call(lambda: beliefs.record(name))
    assert record.person == "engineer"
    assert record.note == f"levelled; requested by engineer, approved by {SECOND}"
    console.call(console.live.operations.errands.look)
    ended = ask("engineer", "GET", f"commands/{ticket['identity']}").json()
    assert f"approved by {SECOND}" in ended["text"]
    texts = [(row["who"], row["text"]) for row in ask("viewer", "GET", "events").json()]
    assert any(who == SECOND and "of engineer approved" in text for who, text in texts)


def test_ctl_asks_lists_refuses_and_approves(console: LiveConsole, ctl: Ctl) -> None:
    name = console.live.names[1]
    stowed(console, name)

    def asked(*words: str, data: bool = False) -> str:
        text = ctl("engineer", "parameters", name, *words, "--reason", "levelled", data=data)
        assert "1 waiting" in text
        (line,) = (x for x in ctl("viewer", "approvals").splitlines() if x.startswith("change "))
        return line.split()[1]

    number = asked("tilt_east_mrad=0.5")
    shown = ctl("viewer", "parameters", name)
    assert f"change {number} of {name}, requested by engineer" in shown
    assert "the beam moves by" in shown
    assert "needs engineer" in ctl("viewer", "approvals", number, "--withdraw", code=1)
    ctl(SECOND, "approvals", number, "--refuse", "--reason", "look again")
    assert "no changes are waiting" in ctl("engineer", "approvals")
    number = asked("tilt_east_mrad=0.5", data=True)
    ctl("engineer", "approvals", number, "--withdraw", data=True)
    number = asked("tilt_east_mrad=0.5")
    assert "another engineer must" in ctl("engineer", "approvals", number, "--approve", code=1)
    assert "1 done" in ctl(SECOND, "approvals", number, "--approve", data=True)
    record = console.call(lambda: console.live.plant.beliefs.record(name))
    assert record.parameters["tilt_east"] == pytest.approx(5e-4)
    assert "use NUMBER together with" in ctl("viewer", "approvals", number, code=1)
    assert "--reason" in ctl(SECOND, "approvals", number, "--refuse", code=1)


@NEEDS_BROWSER
def test_on_the_page_one_asks_and_another_approves(
    console: LiveConsole, enter: Callable[..., Any]
) -> None:
    name = console.live.names[2]
    stowed(console, name)
    first = enter("engineer")
    first.fill(".hx-query", name)
    first.keyboard.press("Enter")
    first.click(".hx-tabs >> text=Heliostat")
    first.click("text=Versions…")
    first.fill("dialog [name=tilt_east]", "0.5")
    first.fill("dialog [name=reason]", "levelled")
    first.click("dialog >> text=Ask for new values")
    first.wait_for_selector("dialog .hx-told:not(.bad):has-text('waits until')")
    first.wait_for_selector("dialog .hx-waiting:has-text('tilt_east 0.000 → 0.500 mrad')")
    assert not first.locator("dialog .hx-waiting button").count()
    first.click("dialog >> text='Close'")
    first.wait_for_selector(".hx-waiting >> text=Withdraw")
    assert not first.locator(".hx-waiting >> text=Approve").count()

    second = enter(SECOND, viewport={"width": 820, "height": 1180})
    second.click(".hx-tabs >> text=Calibration")
    second.wait_for_selector(f".hx-waiting:has-text('{name}: new parameters wait')")
    second.wait_for_selector(".hx-waiting:has-text('Asked for by engineer')")
    second.click(".hx-waiting >> text=Approve")
    said(second, "take command first")
    second.click(".hx-authority >> text=Take command")
    second.wait_for_selector(".hx-authority >> text=You have command")
    second.click(".hx-waiting >> text=Refuse…")
    second.fill("dialog [name=reason]", "look again")
    second.click("dialog >> text='Refuse'")
    second.wait_for_selector(".hx-waiting", state="detached")
    first.wait_for_selector(".hx-waiting", state="detached")

    approvals = console.live.operations.approvals
    console.wait(approvals.ask(Person("engineer", Role.ENGINEER), name, VALUES, 0, "levelled"))
    second.click(".hx-waiting >> text=Approve")
    console.until(lambda: console.live.plant.beliefs.record(name) is not None)
    said(second, "PARAMETERS: 1 done")
    second.wait_for_selector(".hx-waiting", state="detached")
