"""Passwords that are guessed first are refused, others are not."""

import random

import httpx
import pytest

from heliotrope.console import _secrets
from heliotrope.console._guessable import weakness
from heliotrope.errors import InputError
from support.live_console import PASSWORD, LiveConsole


@pytest.mark.parametrize(
    ("password", "reason"),
    [
        ("password123", "common"),
        ("P@ssw0rd!!", "common"),
        ("Sommer2026!!", "common"),
        ("letmein12345", "common"),
        ("Heliotrope1!", "common"),
        ("hello, world", "common"),
        ("admin-admin1", "common"),
        ("1234567890", "keyboard"),
        ("0987654321", "keyboard"),
        ("qwertyuiop", "keyboard"),
        ("qwertz12345", "keyboard"),
        ("1qaz2wsx3edc", "keyboard"),
        ("aaaaaaaaaaaa", "different characters"),
        ("sunlight sunlight ", "repeats"),
        ("Anna.Smith2026", "name of the account"),
    ],
)
def test_what_is_guessed_first_is_refused(password: str, reason: str) -> None:
    assert reason in (weakness(password, "anna.smith") or "")
    with pytest.raises(InputError, match="choose a different one, such as three"):
        _secrets.check_password(password, "anna.smith")


@pytest.mark.parametrize(
    "password",
    [
        "correct horse",
        "a long password",
        "anna.smith walks by the sea",
        "fishcamelbottle",
        "x7§kq#2mvp",
    ],
)
def test_others_are_taken(password: str) -> None:
    assert _secrets.check_password(password, "anna.smith") == password


def test_a_password_that_the_program_makes_is_taken() -> None:
    rng = random.Random(5)
    letters = "abcdefghjkmnpqrstuvwxyz23456789"
    made = ["-".join("".join(rng.choices(letters, k=5)) for _ in range(4)) for _ in range(2000)]
    assert [word for word in made if weakness(word, "engineer")] == []
    assert _secrets.check_password(_secrets.new_password(), "engineer")


def test_the_api_refuses_it_for_new_and_changed_accounts(console: LiveConsole) -> None:
    with httpx.Client(base_url=f"{console.address}api/v1/", trust_env=False) as client:
        who = client.post("session", json={"name": "engineer", "password": PASSWORD}).json()
        client.headers["X-CSRF-Token"] = who["csrf"]
        own = {"own_password": PASSWORD}
        new = {"name": "newcomer", "role": "viewer", "password": "newcomer-1234", **own}
        for answer in (
            client.post("accounts", json=new),
            client.patch("accounts/viewer", json={"password": "qwertyuiop1", **own}),
            client.put("session/password", json={"old": PASSWORD, "new": "password2026"}),
        ):
            assert answer.status_code == 422
            assert answer.json()["detail"].startswith("password: it ")
    assert console.keeper.people.account("newcomer") is None
