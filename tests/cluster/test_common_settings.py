"""The checksum of the settings that all clusters share: what changes it, and what does not."""

from dataclasses import replace
from typing import Any
from zlib import crc32

import pytest

from heliotrope.links import common_settings
from heliotrope.links.common_settings import CommonSettings, settings_checksum
from heliotrope.safety import Watcher, conditions
from support.clusters import SITE, Field, config_of, run

CONFIG = config_of(2)
#: Rows that no cluster watches, so that a text of few lines is left.
FOREIGN = tuple(row for row in conditions() if row.watcher is not Watcher.CLUSTER)


def test_it_is_the_checksum_of_the_documented_text(monkeypatch: pytest.MonkeyPatch) -> None:
    line = next(row for row in conditions() if row.name == "plant_link_lost")
    monkeypatch.setattr(common_settings, "conditions", lambda: (*FOREIGN, line))
    text = (
        "delta_t_s=default\n"
        "plant_link_lost.act=3.0\n"
        "plant_link_lost.clear_for=2.0\n"
        "plant_link_lost.delay=0.0\n"
        "plant_link_lost.releases=2.0\n"
        "plant_link_lost.scope=1.0\n"
        "plant_link_lost.stale_after=5.0\n"
        "plant_link_lost.then_stow=20.0\n"
        "plant_link_lost.trips=3.0\n"
        "silence_s=10.0\n"
        "steps_every_s=1.0\n"
    )
    found = settings_checksum(CONFIG.common)
    assert found == f"{crc32(text.encode()):08x}"


@pytest.mark.parametrize(
    "change",
    [
        {"silence": 11.0},
        {"steps_every": 2},
        {"site": replace(SITE, delta_t=69.0)},
        {"limits": {"bus_errors": {"trips_percent": 30.0}}},
    ],
)
def test_each_common_setting_changes_it(change: dict[str, Any]) -> None:
    assert settings_checksum(replace(CONFIG, **change).common) != settings_checksum(CONFIG.common)


@pytest.mark.parametrize(
    "change",
    [
        {"name": "C2"},
        {"heliostats": CONFIG.heliostats[:1]},
        {"phase": 0.5},
        {"answer": 0.1},
        {"longest_autonomy": 60.0},
        {"stored_answer": 0.9},
        {"site": replace(SITE, longitude_deg=1.0)},
        {"silence": 10},
    ],
)
def test_what_belongs_to_one_cluster_does_not(change: dict[str, Any]) -> None:
    assert settings_checksum(replace(CONFIG, **change).common) == settings_checksum(CONFIG.common)


@pytest.mark.parametrize("watcher", Watcher)
def test_a_threshold_changes_it_where_the_cluster_watches(
    watcher: Watcher, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = settings_checksum(CONFIG.common)
    rows = list(conditions())
    place = next(i for i, row in enumerate(rows) if row.watcher is watcher)
    rows[place] = replace(rows[place], remedy="Do something else.")
    monkeypatch.setattr(common_settings, "conditions", lambda: tuple(rows))
    assert settings_checksum(CONFIG.common) == before
    rows[place] = replace(rows[place], clear_for=rows[place].clear_for + 1.0)
    assert (settings_checksum(CONFIG.common) != before) == (watcher is Watcher.CLUSTER)


def test_of_a_plants_limits_those_count_that_clusters_watch() -> None:
    gust = {"wind_gust_stow": {"trips_m_s": 18.0}}
    assert settings_checksum(CommonSettings(limits=gust)) == settings_checksum(CONFIG.common)
    bus = {"bus_errors": {"trips_percent": 30.0}}
    expected = settings_checksum(CommonSettings(limits=gust | bus))
    assert expected == settings_checksum(replace(CONFIG, limits=bus).common)


def test_the_status_of_a_running_cluster_carries_it() -> None:
    async def main(field: Field) -> None:
        assert field.plant.status().settings == settings_checksum(config_of(2).common)

    run(main)


def test_the_settings_of_a_cluster_that_states_none_are_the_defaults() -> None:
    assert CONFIG.common == CommonSettings()
