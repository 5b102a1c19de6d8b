"""Accounts, sessions and tokens, on SQLite and on PostgreSQL."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import select

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.store import tables
from heliotrope.store.keeper import Keeper
from heliotrope.store.people import LONGEST, MOST_SESSIONS, MOST_TOKENS, Account, People, Session

HASH = "$argon2id$v=19$m=65536,t=3,p=4$c2FsdA$aGFzaA"


@pytest.fixture
def people(keeper: Keeper) -> People:
    made = keeper.people
    assert made.empty()
    made.add("anna", HASH, "engineer", 100.0)
    made.add("ben", HASH, "operator", 101.0)
    return made


def session_of(people: People, secret: str, now: float) -> Session | None:
    """Return the valid session of a secret, None if there is none."""
    key = hashlib.sha256(secret.encode()).hexdigest()
    return next((one for one in people.valid(now).sessions if one.key == key), None)


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

    def test_have_names_of_any_letters(self, people: People) -> None:
        for name in ("\u00e9lise", "elise", "\u0418\u0432\u0430\u043d", "ann", "Hanna", "ben 2"):
            assert people.add(name, HASH, "viewer", 100.0).name == name

    def test_never_show_the_hash(self, people: People) -> None:
        assert HASH not in repr(people.accounts())

    def test_can_be_changed(self, people: People) -> None:
        changed = people.change("ben", 150.0, role="viewer", password_hash="other")
        assert changed == people.account("ben")
        assert (changed.role, changed.password_hash, changed.changed) == ("viewer", "other", 150.0)
        assert changed.created == 101.0

    def test_that_cannot_be(self, people: People) -> None:
        for name, password_hash, role, text in (
            ("anna", HASH, "viewer", "account anna: it already exists"),
            (
                "Anna",
                HASH,
                "viewer",
                "account Anna: the name looks like that of anna",
            ),
            (" anna ", HASH, "viewer", "looks like that of anna"),
            ("\u0430nna", HASH, "viewer", "looks like that of anna"),  # a Cyrillic a
            ("\uff42en", HASH, "viewer", "looks like that of ben"),  # of full width
            (" ", HASH, "viewer", "the name must have 1 to 100 printable"),
            ("x" * 101, HASH, "viewer", "the name must have 1 to 100 printable"),
            ("a\nb", HASH, "viewer", "the name must have 1 to 100 printable"),
            ("..", HASH, "viewer", "not only dots"),
            ("carl", "", "viewer", "a password hash is needed"),
            ("carl", HASH, "boss", "no role 'boss'; known: viewer, operator, engineer"),
        ):
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
        found = session_of(people, secret, 259.9)
        assert found is not None
        assert (found.name, found.role, found.since, found.expires, found.note) == (
            "ben",
            "operator",
            200.0,
            260.0,
            "control room",
        )
        assert session_of(people, secret, 260.0) is None
        assert people.valid(259.9).sessions == (found,)
        assert people.valid(260.0).sessions == ()

    def test_end(self, people: People) -> None:
        secrets = [people.open_session("ben", 200.0, 60.0) for _ in range(3)]
        other = people.open_session("anna", 200.0, 60.0)
        assert len(set(secrets)) == 3
        people.close_session(secrets[0])
        people.close_session("none")
        assert [session_of(people, s, 201.0) is None for s in secrets] == [True, False, False]
        people.close_sessions("ben")
        assert [session_of(people, s, 201.0) is None for s in secrets] == [True, True, True]
        assert session_of(people, other, 201.0) is not None

    def test_of_one_person_are_few(self, people: People) -> None:
        other = people.open_session("anna", 100.0, 600.0)
        secrets = [people.open_session("ben", 200.0 + k, 600.0) for k in range(MOST_SESSIONS + 3)]
        valid = [session_of(people, secret, 300.0) is not None for secret in secrets]
        assert valid == [False] * 3 + [True] * MOST_SESSIONS
        assert session_of(people, other, 300.0) is not None

    @pytest.mark.parametrize("change", [{"password_hash": "new"}, {"disabled": True}])
    def test_end_with_a_new_password_and_when_disabled(
        self, people: People, change: dict[str, str]
    ) -> None:
        secret = people.open_session("ben", 200.0, 60.0)
        _, word = people.add_token("ben", "report", "viewer", 200.0)
        _, other = people.add_token("anna", "report", "viewer", 200.0)
        people.change("ben", 201.0, **change)  # type: ignore[arg-type]
        people.change("ben", 201.5, disabled=False)
        assert session_of(people, secret, 202.0) is None
        assert people.token(word, 202.0) is None
        assert people.token(other, 202.0) is not None
        assert [token.name for token in people.valid(202.0).tokens] == ["anna"]

    def test_have_the_role_that_the_account_has_now(self, people: People) -> None:
        secret = people.open_session("ben", 200.0, 60.0)
        people.change("ben", 201.0, role="viewer")
        assert session_of(people, secret, 202.0).role == "viewer"  # type: ignore[union-attr]

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
        assert people.valid(0.0).sessions == ()
        assert [t.label for t in people.tokens()] == ["for ever"]


class TestTokens:
    def test_of_one_person_are_few(self, people: People) -> None:
        made = [people.add_token("ben", f"t {k}", "viewer", 200.0)[0] for k in range(MOST_TOKENS)]
        with pytest.raises(InputError, match=f"ben already has {MOST_TOKENS} tokens; revoke one"):
            people.add_token("ben", "one more", "viewer", 200.0)
        people.add_token("anna", "report", "viewer", 200.0)
        people.revoke_token(made[0].key)
        people.add_token("ben", "one more", "viewer", 200.0)

    def test_are_all_valid_as_each_is(self, people: People) -> None:
        """One picture of all says what a question about each one says, also of its use."""
        tokens = [people.add_token("ben", "t", "operator", 200.0, life) for life in (5.0, None)]
        people.change("ben", 201.0, role="viewer")
        for now, left in ((204.0, 2), (206.0, 1), (200.0 + LONGEST["operator"], 0)):
            found = people.valid(now).tokens
            assert {one.key for one in found} == {
                made.key for made, secret in tokens if people.token(secret, now) is not None
            }
            assert len(found) == left
            assert {one.role for one in found} <= {"viewer"}
        people.valid(9000.0, [tokens[1][0].key])
        people.revoke_token(tokens[0][0].key)  # waits for what was written before
        assert [one.last_used for one in people.tokens("ben")] == [9000.0]

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
