"""One door and names: plants of every format, heliostats and sightings by name."""

from pathlib import Path

import numpy as np
import pvlib
import pytest

import heliotrope as ht
from heliotrope.errors import FormatError, InputError, UnknownNameError
from support.machines import every_kind, imperfect

FILES = Path(__file__).parent / "files"
SITE = ht.Site(50.91, 6.39, 90.0, name="somewhere")
TIMES = [f"2026-09-02T{hour:02d}:00Z" for hour in range(6, 14)]
SUNS = ht.sun.vector(TIMES, ht.example_plant().site)


@pytest.mark.parametrize(
    ("name", "first", "kind"),
    [
        ("heliok-scene.xml", "HeliostatA", "two_axis"),
        ("solarpilot-export.csv", "H1", "azimuth_elevation"),
        ("opencsp-field.csv", None, "azimuth_elevation"),
    ],
)
def test_one_door_opens_every_format(name: str, first: str | None, kind: str) -> None:
    plant = ht.open(FILES / name, site=SITE)
    assert plant.site == SITE
    one = plant[first or plant.names[0]]
    assert one.nominal.kind == kind
    found = ht.track(one, ht.geometry.direction(2.5, 0.8), (0.0, 0.0, 60.0))
    assert found.best_counts.shape == (2,)


def test_a_format_without_a_place_asks_for_one() -> None:
    for name in ("solarpilot-export.csv", "opencsp-field.csv"):
        with pytest.raises(FormatError, match="specify the site"):
            ht.open(FILES / name)


def test_heliok_brings_its_own_place() -> None:
    site = ht.open(FILES / "heliok-scene.xml").site
    assert (site.name, site.latitude_deg) == ("Pentakomo", pytest.approx(34.707))


def test_a_layout_without_sizes_says_which_were_taken() -> None:
    plant = ht.open(FILES / "solarpilot-export.csv", site=SITE)
    assert plant["H1"].width == 12.2
    assert "SolarPILOT's default" in plant.notes["size of the mirrors"]


def test_a_plant_file_goes_through_the_same_door(tmp_path: Path) -> None:
    ht.write_plant(ht.example_plant(), tmp_path / "plant.toml")
    assert ht.open(tmp_path / "plant.toml").names == ht.example_plant().names
    with pytest.raises(FormatError, match="no such file"):
        ht.open(tmp_path / "other.toml")


def test_a_site_of_pvlib() -> None:
    location = pvlib.location.Location(50.91, 6.39, "Europe/Berlin", 90.0, "somewhere")
    assert ht.Site.from_pvlib(location) == SITE


def test_a_heliostat_is_a_plant_of_one() -> None:
    plant = ht.example_plant()
    group = plant.groups["azel"].with_parameters({"tilt_north": np.linspace(0.0, 8e-3, 18)})
    plant = plant.with_groups({"azel": group})
    aim = plant.targets[0].center
    whole = ht.track(plant, SUNS[:, None], aim)
    row = plant.names.index("P6A")
    one = ht.track(plant["P6A"], SUNS, aim)
    np.testing.assert_array_equal(whole.best_counts[:, row], one.best_counts)
    np.testing.assert_array_equal(one.reachable, whole.reachable[:, row])
    np.testing.assert_array_equal(
        ht.track(plant.calibrated, SUNS[:, None], aim).best_counts, whole.best_counts
    )
    assert plant["P6A"].position.tolist() == [19.2, -30.8, 0.0]
    assert plant["P6A"].cluster == "pod-6"
    assert repr(plant["P6A"]).startswith("<Heliostat: P6A, azimuth_elevation, at 19.2, -30.8")
    assert "P6A" in plant
    assert "P9Z" not in plant
    assert [h.name for h in plant] == list(plant.names)
    with pytest.raises(UnknownNameError, match="did you mean"):
        plant["P6D"]


def test_nominal_of_several_kinds_says_what_to_take() -> None:
    plant = ht.example_plant()
    kinds = every_kind()
    other = ht.Heliostats(("X1",), kinds["tilt_roll"][None], np.array([2.0]), np.array([1.0]))
    mixed = plant.with_groups({**plant.groups, "other": other})
    with pytest.raises(InputError, match=r"azimuth_elevation, tilt_roll.*plant\.groups"):
        _ = mixed.nominal
    assert ht.track(mixed, SUNS[3], (0.0, 0.0, 13.0)).best_counts.shape == (19, 2)


def _seen(truth: ht.Mechanism, names: tuple[str, ...]) -> ht.Sightings:
    aim = (0.0, 0.0, 13.0)
    counts = ht.track(truth, SUNS[:, None], aim).best_counts
    return ht.sightings(names, counts, SUNS[:, None], aim, time=TIMES, sigma=1e-4)


def test_sightings_of_many_at_many_times_are_rows() -> None:
    plant = ht.example_plant()
    seen = _seen(plant.nominal, plant.names)
    assert len(seen) == 8 * 18
    np.testing.assert_array_equal(seen.time.reshape(8, 18)[:, 5], ht.sun.unix_seconds(TIMES))
    one = seen["P6A"]
    assert (len(one), one.names, set(one.heliostat.tolist())) == (8, ("P6A",), {0})
    both = ht.join([seen["P6A"], seen["P1A"]])
    assert both.names == ("P6A", "P1A")
    np.testing.assert_array_equal(both["P1A"].counts, seen["P1A"].counts)
    with pytest.raises(UnknownNameError):
        seen["P9Z"]


def test_names_find_their_heliostats_whatever_the_order() -> None:
    plant = ht.example_plant()
    truth = ht.roughly_installed(plant.nominal, seed=5)
    seen = _seen(truth, plant.names)
    some = ht.join([seen["P6A"], seen["P2B"]])
    fitted = ht.fit(plant, some, "tilts+biases")
    alone = ht.fit(plant["P6A"], seen["P6A"], "tilts+biases")
    row = plant.names.index("P6A")
    np.testing.assert_allclose(fitted.values[row], alone.values, atol=1e-12)
    assert alone.values.shape == (4,)
    assert "1 heliostat" in repr(alone)
    before = ht.beam_errors(plant["P6A"], some["P6A"]).beam
    after = ht.beam_errors(plant["P6A"].nominal.with_calibration(alone), some["P6A"]).beam
    assert np.median(after) < 0.2 * np.median(before)
    with pytest.raises(UnknownNameError, match="P6A"):
        ht.fit(plant["P2B"], some, "tilts")
    with pytest.raises(InputError, match="no names; pass the plant"):
        ht.fit(plant.nominal, some, "tilts")


def test_deviations_are_carried_by_one_and_by_many() -> None:
    for kind, nominal in every_kind().items():
        moved = imperfect(nominal, seed=1, size=1e-3)
        assert moved.deviations, kind
        many = nominal[None].with_calibration(_Values(moved.deviations))
        np.testing.assert_array_equal(many[0].vertex, moved.vertex)
        np.testing.assert_array_equal(many.drives.table[0], moved.drives.table)
        assert {n: float(v[0]) for n, v in many.deviations.items()} == {
            n: float(v) for n, v in moved.deviations.items()
        }
        assert not nominal.deviations
    plant = ht.example_plant()
    with pytest.raises(InputError, match=r"calibration of 2 heliostats.*plant\[name\]"):
        plant.nominal.with_calibration(_Values({"tilt_north": np.zeros(2)}))


def test_a_fit_of_many_moves_one_heliostat_by_name() -> None:
    plant = ht.example_plant()
    old = plant.groups["azel"].with_parameters({"canting": 1e-3, "tilt_north": 5e-3})
    plant = plant.with_groups({"azel": old.take(range(9)), "others": old.take(range(9, 18))})
    truth = ht.roughly_installed(plant.nominal, seed=5)
    # In another order than the plant's, and without three of its heliostats.
    order = list(reversed(plant.names[3:]))
    seen = ht.join([_seen(truth, plant.names)[name] for name in order])
    group = ht.Heliostats(
        tuple(order), plant.nominal[np.arange(17, 2, -1)], np.full(15, 1.8), np.full(15, 1.2)
    )
    fitted = ht.fit(group, seen, "tilts+biases")
    row, many = order.index("P6A"), fitted["P6A"]
    assert (many.heliostats, many.parameters["tilt_north"]) == (
        ("P6A",),
        fitted.values[row, fitted.names.index("tilt_north")],
    )
    assert many == fitted[row]
    assert len(many.lengths) == len(seen["P6A"])
    one, moved = plant["P6A"].with_calibration(fitted), plant.with_calibration(fitted)
    wanted = plant["P6A"].nominal.with_calibration(many)
    for found in (
        one.calibrated,
        plant["P6A"].with_calibration(many).calibrated,
        moved["P6A"].calibrated,
        moved.calibrated[plant.names.index("P6A")],
        moved.groups["others"].calibrated[moved.groups["others"].index("P6A")],
    ):
        np.testing.assert_array_equal(found.vertex, wanted.vertex)
        np.testing.assert_array_equal(found.angles, wanted.angles)
        np.testing.assert_array_equal(found.drives.table, wanted.drives.table)
        # The deviation that the plant had before is none of the fit's.
        assert {n: float(v) for n, v in found.deviations.items() if v} == {
            n: float(v) for n, v in wanted.deviations.items()
        }
    assert float(one.deviations["tilt_north"]) == float(many.parameters["tilt_north"])
    assert moved.deviations["canting"].tolist() == [1e-3] * 3 + [0.0] * 15
    assert moved.deviations["tilt_north"][:3].tolist() == [5e-3] * 3
    for owner in (plant, plant["P6A"], plant.nominal):
        with pytest.raises(InputError, match="calibration: a dict; pass the result of fit"):
            owner.with_calibration({"canting": 1e-3})  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match=plant.names[0]):
        plant[plant.names[0]].with_calibration(fitted)
    with pytest.raises(UnknownNameError, match="fitted"):
        fitted["P9Z"]
    with pytest.raises(InputError, match="heliostat 15: the fit has 15 heliostats"):
        fitted[15]
    with pytest.raises(InputError, match=r"calibration of 15 heliostats.*fitted\[name\]"):
        plant["P6A"].nominal.with_calibration(fitted)


def test_a_fit_without_names_goes_by_rows() -> None:
    plant = ht.example_plant()
    found = _Values({"tilt_north": np.arange(18) * 1e-3, "canting": np.full(18, 1e-3)})
    moved = plant.with_calibration(found)
    assert moved["P6A"].deviations["tilt_north"] == 1e-3 * plant.names.index("P6A")
    alike = plant.groups["azel"].with_calibration(_Values({"canting": np.array(2e-3)}))
    assert alike.deviations["canting"].tolist() == [2e-3] * 18
    with pytest.raises(InputError, match="18 heliostats without names, but there are 1;"):
        plant["P6A"].with_calibration(found)


def test_deviations_of_a_joined_plant_keep_their_heliostats() -> None:
    nominal = ht.example_plant().nominal
    moved = nominal.with_parameters({"tilt_north": np.arange(18) * 1e-3})
    assert float(moved[5].deviations["tilt_north"]) == 5e-3
    again = moved.with_parameters({"tilt_north": 1e-3})
    assert float(again[5].deviations["tilt_north"]) == 6e-3


def test_the_flux_of_a_plant_on_its_receiver() -> None:
    plant = ht.example_plant()
    seen = ht.flux(plant, "2026-09-02T10:00Z", error=2e-3)
    assert seen.heliostats == len(plant)
    area = sum(h.width * h.height for h in plant)
    assert 0.5 * area * 900.0 * 0.9 < seen.power < area * 900.0 * 0.9
    wide = ht.flux(plant, "2026-09-02T10:00Z", error=20e-3)
    assert wide.power < seen.power
    assert wide.flux.max() < seen.flux.max()
    with pytest.raises(InputError, match="one time"):
        ht.flux(plant, ["2026-09-02T10:00Z"])
    with pytest.raises(UnknownNameError, match="receiver"):
        ht.flux(plant, "2026-09-02T10:00Z", "recever")


class _Values:
    def __init__(self, parameters: dict[str, np.ndarray]) -> None:
        self.parameters = parameters
        self.heliostats: tuple[str, ...] = ()
