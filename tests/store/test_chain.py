"""The hash chains: whatever is altered, removed or added is named."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from pyotp import TOTP
from sqlalchemy import text
from tests.store import old_store
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.errors import InputError
from heliotrope.safety import Severity
from heliotrope.store import audit, chain
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import AuditEntry, Event, StoreError

ENTRY = AuditEntry("a0", "anna", "engineer", "TRACK", "t0", (1.5,), ("H1", "H2"), "why")


def fill(keeper: Keeper) -> None:
    """Record five events, three commands, of which the last is open, two accounts and a token."""
    for i in range(5):
        values = {"wind": 3.0, "unknown": float("nan")} if i == 2 else {}
        keeper.record_event(Event(100.0 + i, "test", f"event {i}", Severity.WARNING, "H1", values))
    for i in range(3):
        keeper.do(lambda c, i=i: audit.begin(c, replace(ENTRY, identity=f"a{i}", at=f"t{i}")))
    keeper.do(lambda c: audit.finish(c, "a0", "done", "t5"))
    keeper.do(lambda c: audit.finish(c, "a1", "done", "t6"))
    people = keeper.people
    people.add("mara", "hash", "engineer", 1.0)
    people.add("ben", "hash", "viewer", 2.0, due=True)
    people.add_token("ben", "report", "viewer", 3.0)


def verified(keeper: Keeper, *heads: chain.Head) -> tuple[chain.Head, ...]:
    """Check a keeper's chains."""
    with keeper.database.reading() as connection:
        return chain.verify(connection, heads).heads


def test_what_nobody_touched_fits(
    keeper: Keeper, place: str | Path, opened: Callable[..., Keeper]
) -> None:
    fill(keeper)
    heads = verified(keeper)
    assert [head.number for head in heads] == [5, 5, 3]
    keeper.close()
    again = opened(place)
    again.record_event(Event(200.0, "test", "after a restart"))
    again.do(lambda c: audit.finish_open(c, "stopped", "t9"))
    again.people.change("ben", 4.0, password_hash="new")  # ends the token too
    assert [head.number for head in verified(again, *heads)] == [6, 6, 5]


@pytest.mark.parametrize(
    ("sql", "named"),
    [
        ("UPDATE event SET text = 'nothing' WHERE number = 3", "event 3 .* does not fit"),
        ("UPDATE event SET at = 1.0 WHERE number = 2", "event 2 .* does not fit"),
        ("DELETE FROM event WHERE number = 2", "event 3 .* does not fit"),
        ("DELETE FROM event WHERE number = 5", "event 5 was removed"),
        ("UPDATE audit SET who = 'ben' WHERE identity = 'a1'", "a1 .TRACK by ben, accepted. does"),
        ("UPDATE audit SET result = 'good' WHERE identity = 'a1'", "a1 .TRACK by anna, result. do"),
        ("DELETE FROM audit WHERE identity = 'a2'", "audit record a2 was removed"),
        ("UPDATE audit SET result = 'good' WHERE identity = 'a2'", "a2 .* is not linked"),
        ("DELETE FROM audit_link WHERE number = 2", "a2 .* does not fit"),
        (
            "INSERT INTO account VALUES ('eve', 'engineer', 'hash', FALSE, 1.0, 1.0)",
            "account eve .engineer. was added, and not by the program",
        ),
        ("UPDATE account SET role = 'engineer' WHERE name = 'ben'", "account ben .* was altered"),
        ("UPDATE account SET password_hash = 'x' WHERE name = 'mara'", "account mara .* altered"),
        ("DELETE FROM password_due", "account ben .viewer. was altered"),
        ("INSERT INTO recovery_code VALUES ('0', 'mara')", "account mara .engineer. was altered"),
        ("UPDATE api_token SET role = 'engineer'", "token report of ben was altered"),
        ("UPDATE api_token SET expires = 1e12", "token report of ben was altered"),
        ("DELETE FROM api_token", "token report of ben was removed"),
        ("UPDATE account_link SET state = before WHERE number = 2", "link 2 of the accounts"),
        ("DELETE FROM account_link WHERE number = 1", "link 2 of the accounts .account ben"),
    ],
)
def test_the_first_record_that_does_not_fit_is_named(keeper: Keeper, sql: str, named: str) -> None:
    fill(keeper)
    verified(keeper)
    keeper.do(lambda c: c.execute(text(sql)))
    with pytest.raises(StoreError, match=named):
        verified(keeper)


def test_a_chain_that_was_made_anew_has_another_head(tmp_path: Path) -> None:
    """Whoever has the service's rights can do that; a head noted elsewhere shows it."""
    keeper = Keeper(tmp_path, inline=True)
    fill(keeper)
    noted = verified(keeper)
    for name in ("event", "event_link"):
        keeper.do(lambda c, name=name: c.execute(text(f"DELETE FROM {name} WHERE number = 5")))
    verified(keeper)
    with pytest.raises(StoreError, match="link 5 is missing; records have since been removed"):
        verified(keeper, *noted)
    keeper.close()
    again = Keeper(tmp_path, inline=True)
    again.record_event(Event(1.0, "test", "in its place"))
    with pytest.raises(StoreError, match="link 5 has a different digest"):
        verified(again, *noted)
    again.close()


def test_a_change_by_the_program_does_not_hide_one_by_hand(keeper: Keeper) -> None:
    fill(keeper)
    keeper.do(lambda c: c.execute(text("UPDATE account SET role = 'engineer' WHERE name = 'ben'")))
    keeper.people.change("ben", 5.0, disabled=True)
    with pytest.raises(StoreError, match=r"account ben .* altered before its change in link 4"):
        verified(keeper)


def test_second_factors_are_linked(keeper: Keeper, tmp_path: Path) -> None:
    fill(keeper)
    factors = keeper.people.factors(tmp_path / "key")
    codes = factors.confirm("mara", TOTP(factors.begin("mara", 1e9)).at(10**9), 1e9)
    assert factors.check("mara", codes[0], 1e9 + 100.0) is not None
    assert [head.number for head in verified(keeper)] == [5, 5, 6]
    keeper.do(lambda c: c.execute(text("UPDATE second_factor SET word = 'theirs'")))
    with pytest.raises(StoreError, match=r"account mara .* was altered"):
        verified(keeper)
    factors.remove("mara")


def test_old_events_leave_and_the_rest_fits(keeper: Keeper) -> None:
    fill(keeper)
    early = verified(keeper)
    keeper.forget_events(103.0)
    keeper.record_event(Event(200.0, "test", "later"))
    keeper.writer.confirmed().result(60.0)
    assert len(keeper.events()) == 3
    later = verified(keeper, *early)
    keeper.forget_events(1000.0)
    keeper.writer.confirmed().result(60.0)
    # With no event left, and with one: a head of the last that has left fits the anchor.
    assert verified(keeper, *later)[0].digest == later[0].digest
    keeper.record_event(Event(2000.0, "test", "after all had left"))
    keeper.writer.confirmed().result(60.0)
    verified(keeper, *later)
    with keeper.database.reading() as connection:
        found = chain.verify(connection, [*early, *later])
    # The heads of audit and accounts are the same, and never leave.
    assert (found.fitting, found.old) == ((*early[1:], *later), early[:1])
    assert found.since == 2000.0


@pytest.mark.parametrize("noted", [True, False], ids=["number-noted", "by-an-earlier-program"])
def test_a_head_of_the_last_event_that_left_is_held_against_the_anchor(
    keeper: Keeper, noted: bool
) -> None:
    fill(keeper)
    with keeper.database.reading() as connection:
        (digest,) = connection.scalars(text("SELECT digest FROM event_link WHERE number = 3"))
    head = chain.Head("event", 3, digest)
    keeper.forget_events(103.0)
    keeper.writer.confirmed().result(60.0)
    if not noted:
        keeper.do(lambda c: c.execute(text("DELETE FROM about WHERE name = 'event_anchor_number'")))
    verified(keeper, head)
    with pytest.raises(StoreError, match="link 3 has a different digest; records have since"):
        verified(keeper, replace(head, digest="1" * 64))


@pytest.mark.parametrize("end", [103.0, 1000.0], ids=["some-kept", "none-kept"])
def test_heads_that_can_all_not_be_checked_are_no_proof(keeper: Keeper, end: float) -> None:
    fill(keeper)
    keeper.forget_events(end)
    keeper.writer.confirmed().result(60.0)
    heads = [chain.Head("event", 1, "1" * 64), chain.Head("audit", 0, "0" * 64)]
    since = "no event is" if end > 200.0 else "events are kept since 1970-01-01T00:01:43Z"
    with pytest.raises(StoreError, match=f"none of the 2 heads could be checked: {since}"):
        verified(keeper, *heads)
    verified(keeper)  # without heads it says nothing about them


def test_an_old_store_is_linked_when_it_is_migrated(tmp_path: Path) -> None:
    keeper = Keeper(tmp_path, inline=True)
    old_store.fill(keeper)
    fill(keeper)
    wanted = verified(keeper)
    for sql in (
        "DROP TABLE event_link",
        "DROP TABLE audit_link",
        "DROP TABLE account_link",
        *(f"DROP TABLE {name}" for name in reversed(old_store.LATER)),
        "DROP INDEX uq_hold_standing",
        "ALTER TABLE hold DROP COLUMN kind",
        "ALTER TABLE hold RENAME COLUMN name TO heliostat",
        "CREATE UNIQUE INDEX uq_hold_standing ON hold (heliostat) WHERE ended IS NULL",
        "UPDATE alembic_version SET version_num = '0002'",
    ):
        keeper.do(lambda c, sql=sql: c.execute(text(sql)))
    keeper.close()
    migrated = CliRunner().invoke(app, ["store", "migrate", str(tmp_path)])
    assert migrated.exit_code == 0, migrated.output
    again = Keeper(tmp_path, inline=True)
    found = verified(again)
    assert found[0] == wanted[0]
    assert found[2].number == 5  # accounts and tokens, as they are
    again.record_event(Event(1.0, "test", "after the migration"))
    verified(again, *found)
    again.close()


def test_from_the_command_line(tmp_path: Path) -> None:
    keeper = Keeper(tmp_path, inline=True)
    fill(keeper)
    run = CliRunner()
    head = run.invoke(app, ["store", "head", str(tmp_path)]).stdout.strip()
    assert head.startswith("event:5:")
    good = run.invoke(app, ["store", "verify", str(tmp_path), "--head", head])
    assert good.exit_code == 0, good.output
    assert "all records verified" in good.stdout
    keeper.do(lambda c: c.execute(text("UPDATE event SET text = 'x' WHERE number = 1")))
    bad = run.invoke(app, ["store", "verify", str(tmp_path)])
    assert isinstance(bad.exception, StoreError)
    assert "event 1 " in str(bad.exception)
    wrong = run.invoke(app, ["store", "verify", str(tmp_path), "--head", "nonsense"])
    assert isinstance(wrong.exception, InputError)
    keeper.close()


def test_exported_heads_show_a_chain_that_was_made_anew(tmp_path: Path) -> None:
    keeper, out = Keeper(tmp_path / "data", inline=True), tmp_path / "out"
    out.mkdir()
    file, at = out / chain.HEADS, datetime(2026, 6, 21, tzinfo=UTC)
    fill(keeper)
    chain.write_heads(out, verified(keeper), at)
    keeper.record_event(Event(300.0, "test", "later"))
    chain.write_heads(out, verified(keeper), at)
    assert file.stat().st_mode & 0o777 == 0o600
    # Four different heads: only that of the events has changed. Syslog's lines hold them too.
    assert len(chain.read_heads(file)) == 4
    keeper.close()
    command = ["store", "verify", str(tmp_path / "data"), "--head", str(file)]
    said = CliRunner().invoke(app, command)
    assert said.exit_code == 0, said.exception
    assert "4 of 4 heads match; events are kept since 1970-01-01T00:01:40Z\n" in said.output
    again = Keeper(tmp_path / "data", inline=True)
    again.forget_events(104.0)
    again.close()
    assert "4 of 4 heads match" in CliRunner().invoke(app, command).output
    shutil.copytree(tmp_path / "data", tmp_path / "later")
    again = Keeper(tmp_path / "later", inline=True)
    again.record_event(Event(400.0, "test", "later still"))
    again.forget_events(400.0)
    again.close()
    later = [str(each).replace("/data", "/later") for each in command]
    told = CliRunner().invoke(app, later).output
    assert "3 of 4 heads match; events are kept since 1970-01-01T00:06:40Z, heads of events" in told
    old = " ".join(str(head) for head in chain.read_heads(file)[:1])
    failed = CliRunner().invoke(app, [*later[:-1], old])
    assert failed.exit_code == 1
    assert "none of the 1 heads could be checked: events are kept since" in str(failed.exception)
    again = Keeper(tmp_path / "data", inline=True)
    for name in ("event", "event_link"):
        again.do(lambda c, name=name: c.execute(text(f"DELETE FROM {name} WHERE number = 6")))
    again.close()
    renewed = Keeper(tmp_path / "data", inline=True)
    renewed.record_event(Event(1.0, "test", "in its place"))
    renewed.close()
    found = CliRunner().invoke(app, command)
    assert isinstance(found.exception, StoreError)
    assert "link 6 has a different digest" in str(found.exception)
    (out / "empty").touch()
    with pytest.raises(InputError, match="contains no head"):
        chain.read_heads(out / "empty")
