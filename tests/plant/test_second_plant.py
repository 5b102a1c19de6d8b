"""Clusters that belong to another plant: who is named, to whom, and when it is over."""

from dataclasses import replace

from heliotrope.links.messages import ClusterStatus
from heliotrope.plant.field.second_plant import SecondPlant
from heliotrope.safety import Alarm, alarms

FREE = ClusterStatus("C1", 0, 0.0, "gps", 0.0, 3.0, 0.1)


def test_the_alarm_names_the_clusters_as_they_change_and_ends_with_the_last() -> None:
    told: list[Alarm] = []
    second_plant = SecondPlant("mine", told.append)
    taken = replace(FREE, run="other", barred=("mine",))
    second_plant.on_status("C1", FREE, 0.0)
    assert told == []
    second_plant.on_status("C1", taken, 0.0)
    second_plant.on_status("C1", taken, 0.0)
    assert told == [alarms.SECOND_PLANT.raised(run="mine", clusters="C1", holder="other")]
    assert "C1 belong to another plant" in second_plant.refusal(["C1", "C2"])
    assert second_plant.refusal(["C2"]) is None
    # A second one, which says of nobody whose it is; then a third plant takes the first.
    second_plant.on_status("C2", replace(taken, run=""), 0.0)
    second_plant.on_status("C1", replace(taken, run="third"), 0.0)
    assert [each.active for each in told] == [True, True, True]
    assert "C1, C2" in told[1].text
    assert "third" in told[2].text
    second_plant.on_status("C1", FREE, 0.0)
    assert told[3].active
    assert "C1" not in told[3].text
    second_plant.on_status("C3", FREE, 0.0)
    assert len(told) == 4
    second_plant.on_status("C2", FREE, 0.0)
    assert told[4:] == [alarms.SECOND_PLANT.ended()]
    second_plant.on_status("C2", FREE, 0.0)
    assert len(told) == 5
    assert second_plant.refusal(["C1", "C2"]) is None
