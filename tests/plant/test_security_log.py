"""The log of security events: bounded, and with alarms that end."""

import asyncio
from collections.abc import Callable

import pytest

from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.operations import Logbook, SecurityEvent, SecurityLog, SecurityNote
from heliotrope.plant.operations.security import (
    MOST,
    MOST_OF_ALL,
    ORDERS,
    ORDERS_SPAN,
    QUIET,
    SPAN,
    plain,
)


def within(work: Callable[[Logbook, SecurityLog], object]) -> Logbook:
    """Return the logbook after some work in virtual time."""

    async def run(clock: VirtualClock) -> Logbook:
        book = Logbook(clock)
        waiting = work(book, SecurityLog(book, clock))
        if asyncio.iscoroutine(waiting):
            await waiting
        return book

    return run_virtual(run)


def texts(book: Logbook) -> list[str]:
    return [row.text for row in book.events(1000) if row.kind == "security"]


def test_a_flood_is_counted() -> None:
    async def flood(book: Logbook, log: SecurityLog) -> None:
        for _ in range(10_000):
            log.note(SecurityEvent.SIGN_IN_FAILED, "", "10.0.0.9")
        log.note(SecurityEvent.SIGNED_IN, "anna", "10.0.0.3")
        assert len(texts(book)) == MOST + 1
        await asyncio.sleep(SPAN + 1.0)
        log.look()

    book = within(flood)
    assert texts(book)[0] == f"failed to sign in: {10_000 - MOST} more in a minute"
    assert "signed in (from 10.0.0.3)" in texts(book)


def test_a_flood_of_one_person_leaves_out_nobody_else() -> None:
    def flood(book: Logbook, log: SecurityLog) -> None:
        del book
        for _ in range(MOST + 10):
            log.note(SecurityEvent.SIGNED_IN, "ben", "10.0.0.9")
        log.note(SecurityEvent.SIGNED_IN, "anna", "10.0.0.3")

    rows = within(flood).events(1000)
    assert [row.text for row in rows if row.who == "anna"] == ["signed in (from 10.0.0.3)"]
    assert len([row for row in rows if row.who == "ben"]) == MOST


def test_a_flood_of_many_persons_is_counted_for_each() -> None:
    """The store must not fill, and yet each person is named."""

    async def flood(book: Logbook, log: SecurityLog) -> None:
        del book
        for k in range(MOST_OF_ALL + 50):
            log.note(SecurityEvent.SIGNED_IN, f"person {k // 10}", "10.0.0.9")
        await asyncio.sleep(SPAN + 1.0)
        log.look()

    rows = [row for row in within(flood).events(1000) if row.kind == "security"]
    assert len(rows) == MOST_OF_ALL + 5
    assert {(row.who, row.text) for row in rows[:5]} == {
        (f"person {k}", "signed in: 10 more in a minute") for k in range(30, 35)
    }


def test_what_was_counted_is_recorded_at_the_end() -> None:
    def flood(book: Logbook, log: SecurityLog) -> None:
        del book
        for _ in range(MOST + 2):
            log.note(SecurityEvent.SIGNED_IN, "ben", "10.0.0.9")
        log.note(SecurityEvent.SIGNED_IN, "ben", more=40)
        log.close()

    assert texts(within(flood))[0] == "signed in: 42 more in a minute"


def test_a_flood_goes_on_for_minutes() -> None:
    """A span that follows another has the sum of both."""

    async def flood(book: Logbook, log: SecurityLog) -> None:
        del book
        for _ in range(2):
            for _ in range(MOST + 5):
                log.note(SecurityEvent.TOKEN_REFUSED, "", "10.0.0.9")
            await asyncio.sleep(SPAN + 1.0)
        log.look()

    found = texts(within(flood))
    assert found[0] == "a token was refused: 10 more in a minute"
    assert len(found) == 2 * MOST + 1


def test_alarms_end_when_it_is_quiet() -> None:
    async def work(book: Logbook, log: SecurityLog) -> None:
        for _ in range(ORDERS):
            log.note(SecurityEvent.ORDER_REFUSED, "ben", "10.0.0.3", "POST /stow")
        log.note(SecurityEvent.LOCKED_OUT, "", "10.0.0.9")
        assert {row.condition for row in book.alarms() if row.active} == {
            "orders_refused",
            "sign_in_lockout",
        }
        await asyncio.sleep(QUIET - 1.0)
        log.look()
        assert all(row.active for row in book.alarms())
        await asyncio.sleep(2.0)
        log.look()
        assert not any(row.active for row in book.alarms())

    within(work)


def test_a_few_refused_orders_raise_none() -> None:
    def work(_: Logbook, log: SecurityLog) -> None:
        for _ in range(ORDERS - 1):
            log.note(SecurityEvent.ORDER_REFUSED, "ben", "10.0.0.3")

    assert within(work).alarms() == ()


@pytest.mark.parametrize(("span", "raised"), [(ORDERS_SPAN, True), (ORDERS_SPAN + 4.0, False)])
def test_five_refused_orders_within_five_minutes_raise_an_alarm(span: float, raised: bool) -> None:
    async def work(_: Logbook, log: SecurityLog) -> None:
        log.note(SecurityEvent.ORDER_REFUSED, "ben", "10.0.0.3")
        for _ in range(4):
            await asyncio.sleep(span / 4.0)
            log.note(SecurityEvent.ORDER_REFUSED, "ben", "10.0.0.3")

    assert (ORDERS, ORDERS_SPAN) == (5, 300.0)
    assert [row.condition for row in within(work).alarms()] == ["orders_refused"] * raised


def test_a_refused_link_is_noted_once() -> None:
    def work(_: Logbook, log: SecurityLog) -> None:
        for text in ("", "wrong key (1 so far)", "wrong key (1 so far)", "wrong key (2 so far)"):
            log.look(text)

    assert texts(within(work)) == [
        "link refused: wrong key (2 so far)",
        "link refused: wrong key (1 so far)",
    ]


def test_what_strangers_type_is_one_short_line() -> None:
    def work(_: Logbook, log: SecurityLog) -> None:
        log.note(SecurityEvent.HOST_REFUSED, detail="a\r\nb" + "x" * 1000)

    (text,) = texts(within(work))
    assert text.startswith("request for an unknown host name refused: a??bxxx")
    assert len(text) < 200


@pytest.mark.parametrize("length", [99, 100, 101, 1000])
def test_a_text_of_a_stranger_has_at_most_a_hundred_characters(length: int) -> None:
    shown = plain("x" * length)
    assert shown == ("x" * length if length <= 100 else "x" * 99 + "…")


def test_notes_are_sent_on() -> None:
    sent: list[SecurityNote] = []

    def work(_: Logbook, log: SecurityLog) -> None:
        log.forward = sent.append
        log.note(SecurityEvent.SIGNED_IN, "anna", "10.0.0.3")

    within(work)
    assert [(note.kind, note.who, note.address) for note in sent] == [
        (SecurityEvent.SIGNED_IN, "anna", "10.0.0.3")
    ]
