"""Faults that local controllers report, as alarms of their cluster."""

from heliotrope.lcu import names
from support.clusters import Field, run


def test_a_fault_is_an_alarm_in_words_until_it_is_over() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        controller, told = field.boards[0].node.controller, 0
        unknown = len(names.FAULTS)
        for number, words in ((1, names.FAULTS[1]), (unknown - 1, names.FAULTS[-1]),
                              (unknown, f"fault {unknown}")):  # fmt: skip
            controller.fault = number
            # The first answer tells it: each is asked once a second.
            await field.until(lambda n=told: len(field.plant.alarms("node_fault")) == n + 1, 1.1)
            alarm = field.plant.alarms("node_fault")[-1]
            assert alarm.active
            assert (alarm.subject, words in alarm.text) == ("A1", True)
            controller.fault = 0
            await field.until(lambda n=told: len(field.plant.alarms("node_fault")) == n + 2, 1.1)
            assert not field.plant.alarms("node_fault")[-1].active
            told += 2

    run(main)
