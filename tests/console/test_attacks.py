"""A plant under attack keeps its leases, its loop and EMERGENCY.

Minutes, and figures that depend on the machine, so it runs with the slow tests only. With ``-s``
each test prints its row of docs/explanation/security.md.
"""

import time
from collections.abc import Iterator

import pytest

from support.attacked_plant import LAG, Measured, Target, measure, plant, row
from support.attacks import ATTACKS
from support.bystander import attacked, order_emergency, signed_in, stand_by


@pytest.fixture(scope="class")
def target(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Target]:
    """A plant of 320 heliostats, with as many descriptors as the class of tests says."""
    with plant(tmp_path_factory.mktemp("plant"), request.cls.descriptors) as running:
        time.sleep(5.0)
        yield running


def attack(target: Target, name: str) -> None:
    """Attack the plant; fail if it ends, or exceeds a limit."""
    found = measure(target, ATTACKS[name])
    print(row(name, found))
    assert target.process.poll() is None, "the attack has ended the plant"
    assert found.over() == [], found


@pytest.mark.slow
class TestPlantAsUsual:
    descriptors = None

    @pytest.mark.parametrize("name", ATTACKS)
    def test_it_stays_within_its_limits(self, target: Target, name: str) -> None:
        attack(target, name)


@pytest.mark.slow
class TestPlantWithFewDescriptors:
    descriptors = 512

    @pytest.mark.parametrize("name", ["idle", "half-open", "viewer-streams"])
    def test_it_stays_within_its_limits(self, target: Target, name: str) -> None:
        attack(target, name)


@pytest.mark.slow
class TestOthersWhileAPlantIsAttacked:
    """An operator signs in, watches, commands, orders and withdraws meanwhile."""

    descriptors = None

    @pytest.mark.parametrize(
        "names",
        [
            ("nothing",),
            ("scattered-guesses", "scattered-tokens"),
            ("viewer-streams", "viewer-sends"),
            ("pages", "viewer-reads"),
        ],
        ids=" ".join,
    )
    def test_an_operator_goes_on_with_her_work(
        self, target: Target, names: tuple[str, ...]
    ) -> None:
        found = stand_by(target, *(ATTACKS[name] for name in names))
        print(names, {name: round(took, 2) for name, took in found.took.items()}, found.growth)
        assert target.process.poll() is None
        assert found.over() == []

    def test_a_name_is_guessed_slowly_from_everywhere(self, target: Target) -> None:
        with attacked(target, ATTACKS["scattered-guesses-for-one"]):
            time.sleep(8.0)
            with signed_in(target, "engineer") as engineer:
                events = engineer.get("events?limit=2000").json()
        tried = [e for e in events if "failed to sign in" in e["text"] and e["who"] == "engineer"]
        assert 5 <= len(tried) <= 10

    def test_an_emergency_is_withdrawn_although_a_program_repeats_it(self, target: Target) -> None:
        assert target.withdraw()
        with signed_in(target, "engineer") as engineer, signed_in(target, "Olga") as olga:
            before, stored = len(engineer.get("events?limit=2000").json()), target.stored()
            with attacked(target, ATTACKS["viewer-emergencies"]):
                time.sleep(5.0)
                assert engineer.get("emergency").json()["on"]
                engineer.request("DELETE", "emergency", json={"owner": "Vera"}).raise_for_status()
                time.sleep(5.0)
                assert engineer.get("emergency").json()["calls"] == []
                # Nobody else pauses.
                order_emergency(target, target.unmet.pop(), "a word").raise_for_status()
                (call,) = engineer.get("emergency").json()["calls"]
                assert call["who"] == "Olga"
                olga.request("DELETE", "emergency", json={}).raise_for_status()
            events = engineer.get("events?limit=2000").json()
        assert len(events) - before < 30
        assert target.stored() - stored < 5.0


def test_what_exceeds_a_limit_is_named() -> None:
    assert Measured().over() == []
    late = Measured(lag=1.01 * LAG, page=float("inf"))
    assert late.over() == ["lag", "page"]
    assert row("idle", late).endswith("| **failed**: lag, page |")
