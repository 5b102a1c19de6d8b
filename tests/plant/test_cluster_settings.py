"""Settings that all clusters should share: a cluster whose checksum differs is named."""

from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path

import pytest

from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.common_settings import CommonSettings, settings_checksum
from heliotrope.links.messages import ClusterStatus, Emergency
from heliotrope.plant.field.cluster_settings import PATIENCE, ClusterSettings
from heliotrope.plant.settings import PlantSettings
from heliotrope.safety import Alarm, Severity, alarms
from support.plant_bench import Bench, running

SAME, OTHER, THIRD = "0000002a", "ffffffff", "12345678"
STATUS = ClusterStatus("C1", 0, 0.0, "gps", 0.0, 3.0, 0.1)


def named(told: list[Alarm]) -> dict[str, str]:
    """Texts of the alarms that have not ended, by cluster."""
    last = {a.subject: a for a in told if a.condition == alarms.SETTINGS_DIFFER.name}
    return {name: a.text for name, a in last.items() if a.active}


def play(
    folder: Path,
    scene: Callable[[Bench], Awaitable[None]],
    settings: PlantSettings | None = None,
) -> None:
    """Run a scene in virtual time."""

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, folder, settings=settings or PlantSettings())
        async with running(bench):
            await scene(bench)

    run_virtual(main)


def test_a_cluster_with_other_settings_is_named_within_10_s_and_moves_on(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        told = bench.plant.alarms
        for cluster in bench.clusters.values():
            cluster.settings = SAME
        await bench.wait(20.0)
        assert not named(list(told))
        odd = bench.clusters["pod-2"]
        odd.settings = OTHER
        await bench.wait(10.0)
        texts = named(list(told))
        assert set(texts) == {"pod-2"}
        assert "cluster pod-2: its settings differ" in texts["pod-2"]
        assert "the 5 other clusters, which all have the same settings" in texts["pod-2"]
        raised = [a for a in told if a.condition == alarms.SETTINGS_DIFFER.name]
        assert [a.severity for a in raised] == [Severity.WARNING]
        assert not odd.of(Emergency)
        odd.settings = SAME
        await bench.wait(3.0)
        assert not named(list(told))

    play(tmp_path, scene)


def test_an_older_cluster_that_sends_none_is_not_named(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        old, *new = bench.clusters.values()
        for cluster in new:
            cluster.settings = SAME
        await bench.wait(20.0)
        assert not named(list(bench.plant.alarms))
        assert not old.of(Emergency)

    play(tmp_path, scene)


def named_of(*settings: str, expected: str = "") -> dict[str, str]:
    """Who is named where clusters A, B, C, … have sent these checksums for a while."""
    told: list[Alarm] = []
    watch = ClusterSettings(told.append, expected)
    for second in range(10):
        for name, each in zip("ABCDEF", settings, strict=False):
            watch.on_status(name, replace(STATUS, settings=each), float(second))
    return named(told)


@pytest.mark.parametrize(
    ("settings", "who"),
    [
        ((SAME,), ""),
        ((SAME, SAME), ""),
        ((SAME, OTHER), "AB"),
        ((SAME, ""), ""),
        (("", "", OTHER), ""),
        ((SAME, OTHER, SAME), "B"),
        ((SAME, OTHER, THIRD), "ABC"),
        ((SAME, SAME, OTHER, OTHER), "ABCD"),
        ((SAME, SAME, OTHER, OTHER, SAME), "CD"),
        ((SAME, SAME, SAME, OTHER, ""), "D"),
    ],
)
def test_the_minority_is_named_and_all_where_there_is_no_majority(
    settings: tuple[str, ...], who: str
) -> None:
    assert "".join(sorted(named_of(*settings))) == who


def test_the_text_says_whether_the_others_agree() -> None:
    assert "from those of B." in named_of(SAME, OTHER)["A"]
    assert (
        "the 2 other clusters, which all have the same settings" in named_of(SAME, OTHER, SAME)["B"]
    )
    text = named_of(SAME, SAME, SAME, OTHER, THIRD)["D"]
    assert "4 of the 4 other clusters, whose settings are not all the same" in text


def test_the_alarm_waits_is_told_once_and_follows_the_others() -> None:
    told: list[Alarm] = []
    watch = ClusterSettings(told.append)
    good, bad = replace(STATUS, settings=SAME), replace(STATUS, settings=OTHER)

    def second(at: float, **statuses: ClusterStatus) -> None:
        for name, status in statuses.items():
            watch.on_status(name, status, at)

    second(0.0, A=good, B=bad)
    second(0.0, A=good)
    second(PATIENCE - 0.1, A=good, B=bad)
    assert told == []
    second(PATIENCE + 0.1, A=good, B=bad)
    second(PATIENCE + 1.0, A=good, B=bad)
    assert [a.active for a in told] == [True, True]
    # A third agrees with one of them: the other is the odd one.
    second(PATIENCE + 2.0, C=good, A=good, B=bad)
    assert set(named(told)) == {"B"}
    assert "the 2 other clusters, which all have the same settings" in named(told)["B"]
    # An older program in its place sends none: nothing is known to differ.
    second(PATIENCE + 3.0, B=STATUS)
    assert told[-1] == alarms.SETTINGS_DIFFER.ended("B")
    # It counts from the beginning when it comes back.
    count = len(told)
    second(PATIENCE + 4.0, B=bad)
    assert len(told) == count


def test_a_cluster_counts_with_its_last_settings_only() -> None:
    """When one of two that agree goes over to the third, the other of them is the odd one."""
    told: list[Alarm] = []
    watch = ClusterSettings(told.append)
    for begin, settings, odd in ((0, (SAME, SAME, OTHER), "C"), (10, (OTHER, SAME, OTHER), "B")):
        for second in range(begin, begin + 10):
            for name, each in zip("ABC", settings, strict=True):
                watch.on_status(name, replace(STATUS, settings=each), float(second))
        assert set(named(told)) == {odd}


def test_the_plants_own_settings_decide_where_it_knows_them(tmp_path: Path) -> None:
    """All clusters alike are wrong together, and the only right one among many is not named."""
    common = CommonSettings(steps_every=2)
    right, wrong = settings_checksum(common), settings_checksum(CommonSettings())

    async def scene(bench: Bench) -> None:
        told = bench.plant.alarms
        for cluster in bench.clusters.values():
            cluster.settings = wrong
        await bench.wait(10.0)
        texts = named(list(told))
        assert set(texts) == set(bench.clusters)
        assert "settings differ from those of this plant." in texts["pod-2"]
        assert not any(cluster.of(Emergency) for cluster in bench.clusters.values())
        bench.clusters["pod-2"].settings = right
        bench.clusters["pod-3"].settings = ""
        await bench.wait(3.0)
        assert set(named(list(told))) == set(bench.clusters) - {"pod-2", "pod-3"}

    play(tmp_path, scene, PlantSettings(common=common))


def test_one_cluster_alone_is_compared_with_the_plant() -> None:
    assert set(named_of(OTHER, expected=SAME)) == {"A"}
    assert not named_of(SAME, expected=SAME)
