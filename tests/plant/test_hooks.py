"""The hooks by which the parts of a plant hear of what happens."""

from collections.abc import Sequence
from pathlib import Path

from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import ClusterStatus, Stage
from heliotrope.plant import controller
from heliotrope.plant.emergency import Sentinel
from heliotrope.plant.field.part import Part
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import Alarm, Severity
from support.plant_bench import Bench, running

NAME = "P5A"


class Log(Part):
    """A part that notes what it hears, in the order in which it hears it."""

    def __init__(self, name: str, heard: list[tuple[str, str]]) -> None:
        self._name, self._heard = name, heard

    def _note(self, what: str) -> None:
        self._heard.append((self._name, what))

    def on_connected(self, cluster: str, now: float) -> None:
        self._note(f"connected {cluster}")

    def on_status(self, cluster: str, status: ClusterStatus, now: float) -> None:
        self._note(f"status {cluster}")

    def on_rows(self, cluster: str, now: float) -> None:
        self._note(f"rows {cluster}")

    def on_alarm(self, cluster: str, alarm: Alarm) -> None:
        self._note(f"alarm {alarm.condition}")

    def on_sent(
        self,
        name: str,
        values: Sequence[float],
        heliostats: Sequence[str],
        now: float,
        again: bool,
    ) -> None:
        self._note(f"{'repeated' if again else 'sent'} {name}")

    def on_stage(
        self, ticket: Ticket, heliostats: tuple[str, ...], stage: Stage, now: float
    ) -> None:
        self._note(f"{stage.name} {ticket.name} {' '.join(heliostats)}")

    def on_beat(self, now: float) -> None:
        self._note("beat")

    def on_second(self, now: float) -> None:
        self._note("second")


def both(what: str) -> list[tuple[str, str]]:
    """Return what two parts hear of one event."""
    return [("first", what), ("last", what)]


def test_each_part_hears_of_each_event_in_its_turn(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        heard: list[tuple[str, str]] = []
        plant._parts = (Log("first", heard), *plant._parts, Log("last", heard))

        def these(what: str) -> list[tuple[str, str]]:
            return [each for each in heard if each[1].startswith(what)]

        async with running(bench):
            await bench.wait(2.0)
            home = cluster.name
            assert these(f"connected {home}") == both(f"connected {home}")
            # All have taken a status before any acts on its rows.
            about = [each for each in heard if each[1].endswith(home)][2:6]
            assert about == both(f"status {home}") + both(f"rows {home}")
            begun = heard.index(("first", "second"))
            assert heard[begun - 2 : begun + 2] == both("beat") + both("second")
            await cluster.send(Alarm("bus_failed", "", Severity.ALARM, "text"))
            cluster.set(states.IDLE, NAME)
            plant.stow("Olga", (NAME,))
            await bench.wait(1.0)
            assert these("alarm") == both("alarm bus_failed")
            assert these("sent") == both("sent STOW")
            for stage in ("ACKNOWLEDGED", "DONE"):
                assert these(stage) == both(f"{stage} STOW {NAME}")
            cluster.deaf.add(NAME)
            plant.defocus("Olga", (NAME,))
            await bench.wait(1.5 * plant.settings.repeat)
            assert these("sent DEFOCUS") == both("sent DEFOCUS")
            assert these("repeated") == both("repeated DEFOCUS")

    run_virtual(main)


def test_a_part_replaces_only_hooks_that_the_plant_calls() -> None:
    """A misspelt hook would never be called."""
    hooks = {name for name in vars(Part) if name.startswith("on_")}
    text = Path(controller.__file__).read_text(encoding="utf-8")
    assert {name for name in hooks if f"part.{name}(" not in text} == set()
    parts = [kind for kind in Part.__subclasses__() if kind is not Log]
    assert len(parts) > 12
    for kind in parts:
        assert {name for name in vars(kind) if name.startswith("on_")} <= hooks, kind


def test_the_sentinel_acts_first_at_a_beat_and_proves_after_all_have_judged(
    tmp_path: Path,
) -> None:
    async def main(clock: VirtualClock) -> None:
        parts = Bench(clock, tmp_path).plant._parts
        first, *rest = (type(part) for part in parts)
        assert first is Sentinel
        # A part that is not in the tuple hears of nothing.
        assert {first, *rest} == {kind for kind in Part.__subclasses__() if kind is not Log}
        # By a status it would prove a heliostat that others find strange by the same status.
        assert {"on_connected", "on_stage", "on_rows", "on_beat"} <= vars(Sentinel).keys()
        assert "on_status" not in vars(Sentinel)

    run_virtual(main)
