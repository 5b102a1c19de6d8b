"""Accounts, sessions and tokens, on SQLite and on PostgreSQL."""

from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import select

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.store import tables
from heliotrope.store.keeper import Keeper
from heliotrope.store.people import Account, People

HASH = "$argon2id$v=19$m=65536,t=3,p=4$c2FsdA$aGFzaA"


@pytest.fixture
def people(keeper: Keeper) -> People:
    made = keeper.people
    assert made.empty()
    made.add("anna", HASH, "engineer", 100.0)
    made.add("ben", HASH, "operator", 101.0)
    return made


class TestAccounts:
    def test_are_kept_over_a_restart(
        self, place: str | Path, opened: Callable[..., Keeper]
    ) -> None:
        first = opened(place)
        first.people.add("anna", HASH, "engineer", 100.0)
        first.close()
        again = opened(place).people
        assert not again.empty()
        wanted = Account("anna", "engineer", HASH, disabled=False, created=100.0, changed=100.0)
        assert again.accounts() == (wanted,)
        assert again.account("anna") == wanted
        assert again.account("Anna") is None

    def test_never_show_the_hash(self, people: People) -> None:
        assert HASH not in repr(people.accounts())

    def test_can_be_changed(self, people: People) -> None:
        changed = people.change("ben", 150.0, role="viewer", password_hash="other")
        assert changed == people.account("ben")
        assert (changed.role, changed.password_hash, changed.changed) == ("viewer", "other", 150.0)
        assert changed.created == 101.0

    @pytest.mark.parametrize(
        ("name", "password_hash", "role", "text"),
        [
            ("anna", HASH, "viewer", "account anna: it exists"),
            (" ", HASH, "viewer", "give a name of 1 to 100 printable"),
            ("x" * 101, HASH, "viewer", "give a name of 1 to 100 printable"),
            ("a\nb", HASH, "viewer", "give a name of 1 to 100 printable"),
            ("..", HASH, "viewer", "not of dots alone"),
            ("carl", "", "viewer", "a password hash is needed"),
            ("carl", HASH, "boss", "no role 'boss'; known: viewer, operator, engineer"),
        ],
    )
    def test_that_cannot_be(
        self, people: People, name: str, password_hash: str, role: str, text: str
    ) -> None:
        with pytest.raises(InputError, match=text):
            people.add(name, password_hash, role, 100.0)
        assert [a.name for a in people.accounts()] == ["anna", "ben"]

    def test_there_is_always_an_engineer(self, people: People) -> None:
        with pytest.raises(InputError, match="no engineer would be left"):
            people.remove("anna")
        with pytest.raises(InputError, match="no engineer would be left"):
            people.change("anna", 150.0, role="operator")
        with pytest.raises(InputError, match="no engineer would be left"):
            people.change("anna", 150.0, disabled=True)
        assert people.account("anna").role == "engineer"  # type: ignore[union-attr]
        people.change("ben", 150.0, role="engineer")
        people.remove("anna")
        assert [a.name for a in people.accounts()] == ["ben"]

    def test_that_are_not_there(self, people: People) -> None:
        for act in (
            lambda: people.remove("bent"),
            lambda: people.change("bent", 1.0, disabled=True),
            lambda: people.open_session("bent", 1.0, 5.0),
            lambda: people.add_token("bent", "x", "viewer", 1.0),
        ):
            with pytest.raises(UnknownNameError, match="no account 'bent'; did you mean ben"):
                act()


class TestSessions:
    def test_last_until_they_expire(self, people: People) -> None:
        secret = people.open_session("ben", 200.0, 60.0, "control room")
        found = people.session(secret, 259.9)
        assert found is not None
        assert (found.name, found.role, found.since, found.expires, found.note) == (
            "ben",
            "operator",
            200.0,
            260.0,
            "control room",
        )
        assert people.session(secret, 260.0) is None
        assert people.sessions(259.9) == (found,)
        assert people.sessions(260.0) == ()

    def test_end(self, people: People) -> None:
        secrets = [people.open_session("ben", 200.0, 60.0) for _ in range(3)]
        other = people.open_session("anna", 200.0, 60.0)
        assert len(set(secrets)) == 3
        people.close_session(secrets[0])
        people.close_session("none")
        assert [people.session(s, 201.0) is None for s in secrets] == [True, False, False]
        people.close_sessions("ben")
        assert [people.session(s, 201.0) is None for s in secrets] == [True, True, True]
        assert people.session(other, 201.0) is not None

    @pytest.mark.parametrize("change", [{"password_hash": "new"}, {"disabled": True}])
    def test_end_with_a_new_password_and_when_disabled(
        self, people: People, change: dict[str, str]
    ) -> None:
        secret = people.open_session("ben", 200.0, 60.0)
        _, word = people.add_token("ben", "report", "viewer", 200.0)
        _, other = people.add_token("anna", "report", "viewer", 200.0)
        people.change("ben", 201.0, **change)  # type: ignore[arg-type]
        people.change("ben", 201.5, disabled=False)
        assert people.session(secret, 202.0) is None
        assert people.token(word, 202.0) is None
        assert people.token(other, 202.0) is not None

    def test_have_the_role_that_the_account_has_now(self, people: People) -> None:
        secret = people.open_session("ben", 200.0, 60.0)
        people.change("ben", 201.0, role="viewer")
        assert people.session(secret, 202.0).role == "viewer"  # type: ignore[union-attr]

    def test_are_not_for_the_disabled(self, people: People) -> None:
        people.change("ben", 150.0, disabled=True)
        with pytest.raises(InputError, match="account ben: it is disabled"):
            people.open_session("ben", 200.0, 60.0)

    def test_are_forgotten(self, people: People, keeper: Keeper) -> None:
        people.open_session("ben", 200.0, 60.0)
        people.add_token("ben", "old", "viewer", 200.0, 10.0)
        people.add_token("ben", "for ever", "viewer", 200.0)
        people.forget_expired(300.0)
        keeper.writer.confirmed().result(10.0)
        assert people.sessions(0.0) == ()
        assert [t.label for t in people.tokens()] == ["for ever"]


class TestTokens:
    def test_last_no_longer_than_their_role_allows(self, people: People) -> None:
        for role, days in (("viewer", 365), ("operator", 90)):
            with pytest.raises(InputError, match=f"role {role} lasts at most {days}"):
                people.add_token("ben", "long", role, 0.0, (days + 1) * 86_400.0)
            made, secret = people.add_token("ben", "long", role, 0.0)
            assert made.expires is None
            assert people.token(secret, days * 86_400.0 - 1.0) is not None
            assert people.token(secret, days * 86_400.0) is None

    def test_of_earlier_programs_end_too(self, people: People, keeper: Keeper) -> None:
        _, secret = people.add_token("ben", "ten years", "operator", 0.0)
        table = tables.api_token
        for expires in (None, 3650 * 86_400.0):
            keeper.do(lambda c, at=expires: c.execute(table.update().values(expires=at)))
            assert people.token(secret, 89 * 86_400.0) is not None
            assert people.token(secret, 90 * 86_400.0) is None

    def test_act_for_their_account(self, people: People, keeper: Keeper) -> None:
        made, secret = people.add_token("ben", "report", "viewer", 200.0, 50.0)
        assert people.tokens("ben") == (made,)
        assert people.tokens("anna") == ()
        found = people.token(secret, 249.0)
        assert found == made
        keeper.writer.confirmed().result(10.0)
        assert people.tokens()[0].last_used == 249.0
        assert people.token(secret, 250.0) is None
        assert people.token("wrong", 201.0) is None

    def test_may_never_do_more_than_their_account(self, people: People) -> None:
        with pytest.raises(InputError, match="its role engineer is above that of ben, operator"):
            people.add_token("ben", "too much", "engineer", 200.0)
        _, secret = people.add_token("ben", "script", "operator", 200.0)
        people.change("ben", 210.0, role="viewer")
        assert people.token(secret, 220.0).role == "viewer"  # type: ignore[union-attr]
        people.change("ben", 210.0, disabled=True)
        assert people.token(secret, 220.0) is None

    def test_are_revoked(self, people: People) -> None:
        made, secret = people.add_token("ben", "report", "viewer", 200.0)
        people.revoke_token(made.key)
        assert people.token(secret, 201.0) is None
        _, other = people.add_token("ben", "report", "viewer", 200.0)
        people.remove("ben")
        assert people.token(other, 201.0) is None


def test_no_secret_is_in_the_database(people: People, keeper: Keeper) -> None:
    secrets = [
        people.open_session("ben", 200.0, 60.0),
        people.add_token("ben", "x", "viewer", 1.0)[1],
    ]
    assert all(len(secret) == 64 for secret in secrets)
    with keeper.database.reading() as connection:
        for table in tables.metadata.sorted_tables:
            content = str(connection.execute(select(table)).all())
            assert not any(secret in content for secret in secrets)
