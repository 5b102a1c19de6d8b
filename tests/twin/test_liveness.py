"""What the observers expect of a line that nothing disturbs, and of the reason of a refusal."""

from collections.abc import Callable
from math import inf
from types import SimpleNamespace
from typing import Any

import pytest

from heliotrope.plant import refusals
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.plant.refusals import Refusal
from heliotrope.twin.invariants import plant_observer as told
from heliotrope.twin.invariants import quiet as silent
from heliotrope.twin.invariants.invariants import InvariantError
from heliotrope.twin.invariants.lines import LEASE_EVERY, REJOINS_WITHIN, LineObserver
from heliotrope.twin.invariants.plant_observer import PlantObserver
from heliotrope.twin.invariants.quiet import QuietObserver
from heliotrope.twin.records import RecordsDisk
from heliotrope.twin.world.simulation import SETTINGS

ANN, BOB = Person("Ann", Role.OPERATOR), Person("Bob", Role.ENGINEER)


def line(*spans: tuple[float, bool, bool, bool]) -> None:
    """Observe a line: until when, whether it is clear and connected, and whether leases come."""
    observer, now = LineObserver("C1", 0.0), 0.0
    for until, clear, connected, leases in spans:
        while now < until:
            now += 0.5
            if leases:
                observer.on_lease(1, now)
            observer.look(now, clear=clear, connected=connected)
    assert observer.checks[16] > 0


def test_a_line_that_nothing_disturbs_is_connected_within_its_time() -> None:
    line((10.0, True, True, True), (90.0, False, False, False), (105.0, True, False, False))
    with pytest.raises(InvariantError, match=r"C1: nothing separates .* has not reconnected"):
        line((9.0, False, False, False), (9.0 + REJOINS_WITHIN + 1.0, True, False, False))
    # Since it was connected last, not since a fault was near.
    line((200.0, True, True, True), (210.0, True, False, False), (220.0, True, True, True))


def test_leases_keep_their_rate_on_a_line_that_carries() -> None:
    line((10.0, True, True, True), (10.0 + LEASE_EVERY, True, True, False))
    with pytest.raises(InvariantError, match=r"C1: the plant sent its last lease 3\.5 s ago"):
        line((10.0, True, True, True), (14.0, True, True, False))
    # They begin anew with the connection.
    line((10.0, True, True, True), (18.0, True, False, False), (20.0, True, True, False))


@pytest.mark.parametrize(
    ("part", "kind"),
    [
        (told.ROLE_REASON, refusals.ROLE_TOO_LOW),
        (told.NOBODY_REASON, refusals.NO_AUTHORITY),
        (told.OTHER_REASON, refusals.OTHER_AUTHORITY),
        (silent.UNHEARD_REASON, refusals.NOT_HEARD),
        (silent.UNCOMPARED_REASON, refusals.NOT_COMPARED),
        (silent.DOUBT_REASON, refusals.COUNTS_DOUBTFUL),
    ],
)
def test_an_observer_knows_a_reason_by_words_that_no_other_has(part: str, kind: Refusal) -> None:
    assert [each.name for each in refusals.KINDS if part in each.text] == [kind.name]


def asked(reason: str, person: Person, token: int, what: str = "TRACK", at: float = 5.0) -> None:
    """Refuse a command of a person, while Ann has the command authority with token 7 since 1 s."""
    observer = PlantObserver(0.0, RecordsDisk(), SETTINGS, [])
    observer.granted(ANN, 7, 1.0, seized=False)
    observer.on_refused(person, token, (what, ()), reason, at)


def test_a_refusal_names_the_holder_of_the_authority_and_the_role_that_lacks() -> None:
    nobody = str(refusals.NO_AUTHORITY.error(person="Bob"))
    ann = str(refusals.OTHER_AUTHORITY.error(holder="Ann", person="Bob"))
    role = refusals.ROLE_TOO_LOW
    engineer = str(role.error(what="X", person="Ann", role="operator", needed="engineer"))
    asked(ann, BOB, 7)
    asked(ann, ANN, 6)  # her token is of an earlier grant
    asked(nobody, BOB, 7, at=1.0 + SETTINGS.authority)  # which nobody has renewed
    asked(engineer, ANN, 7, "JOG")
    false: list[tuple[Any, ...]] = [
        (nobody, BOB, 7),
        (ann, ANN, 7),
        (str(refusals.OTHER_AUTHORITY.error(holder="Cid", person="Bob")), BOB, 7),
        (engineer, ANN, 7, "TRACK"),
    ]
    for each in false:
        with pytest.raises(InvariantError, match="was refused: "):
            asked(*each)


def test_a_command_refused_for_another_reason_may_renew_the_authority() -> None:
    """Simulated run 996043: the plant renews it before it looks whether the motion is free."""

    def given(reason: str, at: float) -> None:
        observer = PlantObserver(0.0, RecordsDisk(), SETTINGS, [])
        observer.granted(ANN, 7, 1.0, seized=False)
        observer.on_refused(ANN, 7, ("AIM", ()), reason, 0.95 + SETTINGS.authority)
        ticket: Any = SimpleNamespace(identity="x")
        observer.on_accepted(ANN, 7, ticket, "AIM", at)

    busy = str(refusals.NOT_NOW.error(what="AIM", reason="a frozen cluster"))
    lost = str(refusals.NO_AUTHORITY.error(person="Ann"))
    with pytest.raises(InvariantError, match="accepted without its record"):
        given(busy, 0.9 + 2.0 * SETTINGS.authority)
    for reason, at in ((busy, 1.0 + 2.0 * SETTINGS.authority), (lost, SETTINGS.authority + 1.0)):
        with pytest.raises(InvariantError, match="accepted without the command authority"):
            given(reason, at)


@pytest.fixture
def refused() -> Callable[..., None]:
    """Refuse a command to a heliostat that has been quiet, with sure counts, since given times."""

    def refuse(
        kind: Refusal, quiet: float = inf, sure: float = inf, *, fails: bool = False
    ) -> None:
        account = SimpleNamespace(
            name="A1", board=SimpleNamespace(outfit=SimpleNamespace(mechanism=None))
        )
        observer = QuietObserver.__new__(QuietObserver)
        observer.__dict__.update(checks={16: 0}, start=0.0)
        mirror = silent._Mirror(account, "C1", state=0, quiet_since=quiet, sure_since=sure)  # type: ignore[arg-type]
        observer.__dict__.update(_mirrors={"A1": mirror}, _quiet={"A1"} if quiet < inf else set())
        observer._refusals = []
        observer.on_refused(ANN, 7, ("TRACK", ("A1",)), f"TRACK A1: {kind.text}", 100.0)
        if fails:  # the fault that was the reason has just begun
            observer._quiet = frozenset()
        observer._reasoned(100.5)

    return refuse


def test_a_refusal_is_false_by_what_has_been_true_for_a_while(
    refused: Callable[..., None],
) -> None:
    refused(refusals.NOT_HEARD)  # something is wrong near it
    refused(refusals.NOT_HEARD, quiet=98.0, fails=True)
    refused(refusals.NOT_COMPARED, quiet=60.0)
    refused(refusals.COUNTS_DOUBTFUL, quiet=60.0)
    refused(refusals.COUNTS_DOUBTFUL, quiet=60.0, sure=97.0)
    for kind, times in (
        (refusals.NOT_HEARD, {"quiet": 98.0}),
        (refusals.NOT_COMPARED, {"quiet": 50.0}),
        (refusals.COUNTS_DOUBTFUL, {"quiet": 60.0, "sure": 90.0}),
    ):
        with pytest.raises(InvariantError, match=r"A1: .* refused: TRACK A1: "):
            refused(kind, **times)
