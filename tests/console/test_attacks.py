"""A plant under attack keeps its leases, its loop and EMERGENCY.

Minutes, and figures that depend on the machine, so it runs with the slow tests only. With ``-s``
each test prints its row of docs/explanation/security.md.
"""

import time
from collections.abc import Iterator

import pytest

from support.attacked_plant import LAG, Measured, Target, measure, plant, row
from support.attacks import ATTACKS


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


def test_what_exceeds_a_limit_is_named() -> None:
    assert Measured().over() == []
    late = Measured(lag=1.01 * LAG, page=float("inf"))
    assert late.over() == ["lag", "page"]
    assert row("idle", late).endswith("| **failed**: lag, page |")
