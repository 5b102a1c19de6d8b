"""``heliotrope aim``: what it prints, what it writes, and what it refuses."""

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import heliotrope as ht
from heliotrope.cli import main
from heliotrope.cli.aim import _ranges

WORDS = ("--sun=0.1,0.6,0.8", "--cells=10x12")


@pytest.fixture
def aim(tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run the command on the example plant in its folder."""
    monkeypatch.chdir(tmp_path)
    ht.write_plant(ht.example_plant(), "plant.toml")

    def run(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["heliotrope", "aim", "plant.toml", *WORDS, *words])
        with pytest.raises(SystemExit) as leaving:
            main()
        said = capsys.readouterr()
        return int(leaving.value.code or 0), said.out, said.err

    return run


def test_strategies_stand_in_one_table_and_files_are_written(aim: Any) -> None:
    code, out, err = aim("--limit=120", "--strategy=all", "--csv=a.csv", "--picture=a.png")
    assert code == 0, err
    names = ("middle", "spread", "image-size", "gradient", "optimal")
    for name in (*names, "csv: a.csv", "picture: a.png"):
        assert name in out
    with Path("a.csv").open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    assert {row["state"] for row in rows} <= {"aim", "defocus"}
    assert sum(float(row["power_kw"]) for row in rows) > 10.0


def test_json_keeps_the_limit_of_a_file(aim: Any) -> None:
    Path("limit.csv").write_text("90000,90000\n140000,140000\n", encoding="utf-8")
    code, out, err = aim("--limit=limit.csv", "--margin=0", "--json")
    assert code == 0, err
    got = json.loads(out)
    limit, flux = np.array(got["limit_w_m2"]), np.array(got["quantile_w_m2"])
    assert limit[0].max() == 140000.0
    assert limit[-1].max() == 90000.0
    assert (flux <= limit).all()
    assert got["strategies"][0]["excess"] <= 0.0
    assert [one["state"] for one in got["heliostats"]] == ["aim"] * 18


def test_without_light_the_irradiance_is_named(aim: Any) -> None:
    code, _, err = aim("--limit=60", "--dni=0")
    assert code == 2
    assert err.endswith("the direct normal irradiance is 0 W/m²; use one above 0\n")


def test_the_map_has_flux_and_limit_of_each_cell(aim: Any) -> None:
    Path("limit.csv").write_text("90000,90000\n140000,140000\n", encoding="utf-8")
    words = ("--limit=limit.csv", "--margin=0", "--strategy=middle")
    code, out, err = aim(*words, "--map=m.csv")
    assert code == 0, err
    assert "map: m.csv" in out
    with Path("m.csv").open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    got = json.loads(aim(*words, "--json")[1])
    assert len(rows) == 120
    for row in rows:
        cell = int(row["row"]), int(row["column"])
        for name in ("flux", "quantile", "limit"):
            value = 1e-3 * np.array(got[f"{name}_w_m2"])[cell]
            assert float(row[f"{name}_kw_m2"]) == pytest.approx(value, abs=1e-4)
        assert (row["binds"] == "yes") == got["binding"][cell[0]][cell[1]]
        assert (float(row["limit_kw_m2"]) == 90.0) == (cell[0] >= 5)
    up = {int(row["row"]): float(row["up_m"]) for row in rows}
    assert all(up[k] < up[k + 1] for k in range(9))
    assert {row["binds"] for row in rows} == {"yes", "no"}
    power = sum(float(row["area_m2"]) * float(row["flux_kw_m2"]) for row in rows)
    assert power == pytest.approx(1e-3 * got["strategies"][0]["power_w"], rel=2e-3)


def test_the_places_where_the_limit_binds_are_printed(aim: Any) -> None:
    code, out, err = aim("--limit=60", "--strategy=middle")
    assert code == 0, err
    got = json.loads(aim("--limit=60", "--strategy=middle", "--json")[1])
    binding, over = np.array(got["binding"]), np.array(got["quantile_w_m2"])
    rows, columns = np.nonzero(binding)
    assert f"{binding.sum()} of 120 cells at or above the limit, in rows {rows.min()} to " in out
    assert f"columns {columns.min()} to {columns.max()}\n" in out
    row, column = np.unravel_index(over.argmax(), over.shape)
    share = 100.0 * (over.max() / np.max(got["limit_w_m2"]) - 1.0)
    lines = [line for line in out.splitlines() if line.startswith("  row ")]
    assert len(lines) == 5
    assert lines[0].startswith(f"  row {row}, column {column} (")
    assert lines[0].endswith(f" m): {share:.1f} % above the limit")
    code, out, err = aim("--limit=9000", "--strategy=middle")
    assert code == 0, err
    below = 100.0 * (1.0 - 1e-3 * over.max() / (0.99 * 9000.0))
    line = f"0 of 120 cells at the limit; the closest is {below:.1f} % below it: row {row}, column "
    assert f"{line}{column} (" in out
    assert "  row " not in out


def test_a_limit_file_in_kw_gets_a_hint_of_the_unit(aim: Any) -> None:
    Path("limit.csv").write_text("120,120\n140,140\n", encoding="utf-8")
    code, out, err = aim("--limit=limit.csv", "--strategy=middle", "--json")
    assert code == 0
    assert json.loads(out)["limit_w_m2"][0][0] == pytest.approx(0.99 * 140.0)
    assert err == (
        "heliotrope: limit.csv: no cell's limit is above 140 W/m², which is very low; if the "
        "numbers were meant as kW/m², multiply them by 1,000\n"
    )
    Path("limit.csv").write_text("120,120\n10000,140\n", encoding="utf-8")
    assert aim("--limit=limit.csv", "--strategy=middle")[::2] == (0, "")


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ([3], "row 3"),
        ([0, 1, 2, 5, 9], "rows 0 to 2, 5, 9"),
        ([0, 2, 4, 6, 7], "rows 0 to 7"),
    ],
)
def test_ranges_are_few(numbers: list[int], text: str) -> None:
    assert _ranges("row", np.array(numbers)) == text


def test_a_uniform_flux_and_a_ramp_are_told(aim: Any) -> None:
    code, out, err = aim(
        "--limit=120", "--wanted=uniform", "--give-percent=5", "--ramp=21", "--csv=a.csv"
    )
    assert code == 0, err
    assert "differs from the desired flux by" in out
    assert "start-up: the last of" in out
    with Path("a.csv").open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    assert all((row["joins_s"] != "") == (row["state"] == "aim") for row in rows)
    assert len({row["joins_s"] for row in rows}) > 1


@pytest.mark.parametrize("words", [("--limit=5",), ("--limit=30", "--keep-all")])
def test_the_limit_that_a_refusal_advises_holds(aim: Any, words: tuple[str, ...]) -> None:
    code, _, err = aim(*words)
    assert code == 2
    advised = err.split("raise the limit there to ")[1].split()[0]
    code, _, err = aim(f"--limit={advised}", *words[1:])
    assert code == 0, err


def test_the_advised_limit_of_a_map_is_for_all_its_cells(aim: Any) -> None:
    Path("limit.csv").write_text("30000,25000\n25000,25000\n", encoding="utf-8")
    code, _, err = aim("--limit=limit.csv", "--keep-all")
    assert code == 2
    assert " kW/m² and elsewhere by the same factor, or let heliostats be defocused" in err


def test_a_limit_over_temperature_and_velocity_lies_on_the_panels(aim: Any) -> None:
    Path("afd.csv").write_text(
        "temperature_c,velocity_m_s,flux_w_m2\n290,2,160000\n565,2,80000\n", encoding="utf-8"
    )
    Path("panels.csv").write_text(
        "path,begin,end,flow,inlet_c,outlet_c,velocity_m_s\n"
        "west,0,0.5,up,290,565,2\neast,0.5,1,down,290,565,2\n",
        encoding="utf-8",
    )
    code, out, err = aim("--limit=afd.csv", "--panels=panels.csv", "--margin=0", "--json")
    assert code == 0, err
    got = json.loads(out)
    limit, flux = np.array(got["limit_w_m2"]), np.array(got["quantile_w_m2"])
    assert limit[-1, 0] == limit[0, -1] == 80000.0
    assert limit[0, 0] > 150000.0
    assert (flux <= limit).all()


def test_heliostats_that_reach_no_cell_are_named(aim: Any) -> None:
    plant = ht.read_plant("plant.toml")
    (first,) = plant.receivers
    sideways = replace(first, normal=np.array([1.0, 0.0, 0.0]), corners=None)
    ht.write_plant(replace(plant, receivers=(sideways,)), "plant.toml")
    code, out, err = aim("--limit=200", "--csv=a.csv")
    assert code == 0, err
    with Path("a.csv").open(encoding="utf-8") as lines:
        rows = {row["heliostat"]: row for row in csv.DictReader(lines)}
    names = [name for name, row in rows.items() if row["state"] == "reaches no cell"]
    assert f"{len(names)} heliostats reach no receiver cell; the first is {names[0]}" in out
    (group,) = plant.groups.values()
    east = dict(zip(plant.names, group.mechanism.position[:, 0] - first.center[0], strict=True))
    assert {name for name, x in east.items() if x < -3.0} <= set(names)
    assert all(east[name] < 3.0 for name in names)
    assert not any(rows[name]["east_m"] for name in names)


def test_lost_heliostats_and_clusters_send_no_light(aim: Any) -> None:
    plant = ht.read_plant("plant.toml")
    (cluster, *_), (name, *_) = plant.groups["azel"].cluster, plant.names[::-1]
    gone = {*(n for n, c in zip(plant.names, plant.groups["azel"].cluster, strict=True)
              if c == cluster), name}  # fmt: skip
    code, out, err = aim("--limit=120", f"--without={cluster}", f"--without={name}", "--csv=a.csv")
    assert code == 0, err
    assert f"{len(gone)} heliostats are lost" in out
    with Path("a.csv").open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    assert {row["heliostat"] for row in rows if row["state"] == "lost"} == gone
    assert not any(float(row["power_kw"]) or row["up_m"] for row in rows if row["state"] == "lost")
    code, out, err = aim("--limit=120", f"--without={name}")
    assert code == 0, err
    assert f"1 heliostat is lost: {name}\n" in out


def test_with_two_receivers_each_heliostat_counts_for_its_own(aim: Any) -> None:
    plant = ht.read_plant("plant.toml")
    (first,) = plant.receivers
    second = replace(first, name="second", center=first.center + [0.0, 0.0, 15.0])
    (name,) = plant.groups
    group = plant.groups[name]
    own = np.where((np.arange(len(group)) % 3 == 0)[:, None], second.center, np.nan)
    groups = {name: replace(group, aim=own)}
    ht.write_plant(replace(plant, groups=groups, receivers=(first, second)), "plant.toml")
    rows: dict[str, list[str]] = {}
    for receiver, others in (("", 6), ("second", 12)):
        code, out, err = aim("--limit=100", f"--receiver={receiver}", f"--csv={receiver}.csv")
        assert code == 0, err
        assert f"aims on {receiver or first.name}" in out
        assert f"{others} heliostats belong to other receivers" in out
        with Path(f"{receiver}.csv").open(encoding="utf-8") as lines:
            rows[receiver] = [row["state"] for row in csv.DictReader(lines)]
    on, off = {"aim", "defocus", "out of reach"}, {"other receiver"}
    for k, (one, other) in enumerate(zip(rows[""], rows["second"], strict=True)):
        assert one in (off if k % 3 == 0 else on)
        assert other in (on if k % 3 == 0 else off)
    ht.write_plant(replace(plant, receivers=(first, second)), "plant.toml")
    code, out, err = aim("--limit=100", "--receiver=second")
    assert code == 2
    assert "none of the 18 heliostats can reach receiver second, and 18 belong to other" in err


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--limit=5", "--keep-all"), "no aims were found that respect the flux limit; row "),
        (("--limit=0.1",), "does not allow even the beam with the lowest peak; row "),
        (("--limit=0.1",), "% above its 0.099; raise the limit there to "),
        (("--limit=zero.csv",), "zero.csv: line 2, column 1: the flux must be above 0"),
        (("--limit=ragged.csv",), "line 2: this row has 1 numbers, but earlier rows have 2"),
        (("--limit=much",), "--limit 'much': use 0.001 to 64000 kW/m²"),
        (("--limit=120", "--ramp=5"), "ramp: one beam alone heats a cell by "),
        (("--limit=none.csv",), "none.csv"),
        (("--limit=holes.csv",), "holes.csv: line 1, column 2: the cell is empty; enter W/m²"),
        (("--limit=semicolons.csv",), "line 1: '1e5;2e5' is not a number; separate numbers"),
        (("--limit=blank.csv",), "blank.csv: the file contains no numbers"),
        (("--limit=afd.csv",), "'temperature_c' is not a number; separate numbers in W/m²"),
        (("--limit=afd.csv", "--panels=panels.csv"), "afd.csv: line 3, column flux_w_m2: -80000"),
        (
            ("--limit=good.csv", "--panels=panels.csv"),
            "panel of path east: flux table: a temperature of 280 °C",
        ),
        (("--limit=none.csv", "--panels=panels.csv"), "none.csv"),
        (("--limit=100", "--without=P6"), "there is no heliostat or cluster 'P6'; did you mean"),
        (("--limit=100", "--wanted=even"), "--wanted must be uniform"),
        (("--limit=100", "--wanted=none.csv"), "no such file; specify the path of a flux map"),
        (("--limit=100", "--time=now"), "--time or --sun"),
        (("--limit=100", "--receiver=other"), "other"),
    ],
)
def test_bad_input_is_one_line_and_code_2(aim: Any, words: tuple[str, ...], line: str) -> None:
    Path("zero.csv").write_text("1e5,2e5\n0,1e5\n", encoding="utf-8")
    Path("ragged.csv").write_text("1e5,2e5\n1e5\n", encoding="utf-8")
    Path("holes.csv").write_text("1e5,,2e5\n1e5,,1e5\n", encoding="utf-8")
    Path("semicolons.csv").write_text("1e5;2e5\n1e5;1e5\n", encoding="utf-8")
    Path("blank.csv").write_text("\n,,\n", encoding="utf-8")
    head = "temperature_c,velocity_m_s,flux_w_m2\n"
    Path("afd.csv").write_text(f"{head}290,2,1e5\n565,2,-8e4\n", encoding="utf-8")
    Path("good.csv").write_text(f"{head}290,2,1e5\n565,2,8e4\n", encoding="utf-8")
    Path("panels.csv").write_text(
        "path,begin,end,flow,inlet_c,outlet_c,velocity_m_s\neast,0,1,up,280,565,2\n",
        encoding="utf-8",
    )
    code, _, err = aim(*words)
    assert code == 2
    assert line in err
    assert err.count("\n") == 1
