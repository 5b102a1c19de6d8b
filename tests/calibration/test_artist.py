"""What was learnt returns in ARTIST's own form: a scenario in HDF5."""

import json
import os
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pytest

from heliotrope.calibration.learn import learning
from heliotrope.calibration.learn.learned import Learned
from heliotrope.calibration.report import write_artist
from heliotrope.calibration.workflow import of_measurements
from heliotrope.errors import FormatError, InputError
from heliotrope.field.formats import measurements, paint
from heliotrope.field.plant import Plant
from support.data import juelich

#: Parameters with a place in the form, and one without.
MODEL = ("tilt_up", "tilt_north", "non_orthogonality", "elevation_bias", "azimuth_bias", "canting")
NAME, OTHER = "AA39", "AA31"
PYTHON = os.environ.get("HELIOTROPE_ARTIST_PYTHON", "")
SCRIPT = Path(__file__).parents[1] / "support" / "artist_scenario.py"


def learnt() -> tuple[Plant, Learned]:
    plant = paint.read_plant(juelich())
    (group,) = plant.groups.values()
    seen, _ = of_measurements(measurements.read_measurements(juelich()), group)
    return plant, learning.learn(plant[NAME], seen[NAME], MODEL, processes=())


def imitated(path: Path, origin: tuple[float, float, float]) -> Path:
    """Write the parts of a scenario of ARTIST 2.0 that are read or written here."""
    with h5py.File(path, "w") as root:
        root["power_plant/position"] = np.array(origin)
        for place in ("prototypes", f"heliostats/{OTHER}"):
            for axis in (0, 1):
                actuator = f"{place}/actuator/actuator_{axis}"
                root[f"{actuator}/type"] = "ideal"
                root[f"{actuator}/clockwise_axis_movement"] = True
                root[f"{actuator}/min_max_motor_positions"] = np.array([0, 60000])
                for name in ("increment", "initial_angle"):
                    root[f"{actuator}/parameters/{name}"] = np.float32(0.5)
            root[f"{place}/kinematics/type"] = "rigid_body"
            root[f"{place}/kinematics/deviations/first_joint_tilt_n"] = np.float32(0.0)
        for name in (NAME, OTHER):
            root[f"heliostats/{name}/position"] = np.array([0, 0, 0, 1], dtype=np.float32)
            root[f"heliostats/{name}/surface/facets/facet_0/canting"] = np.ones((2, 4))
    return path


def test_a_scenario_gets_what_was_learnt_and_keeps_the_rest(tmp_path: Path) -> None:
    plant, learned = learnt()
    scenario, out = imitated(tmp_path / "old.h5", plant.site.origin), tmp_path / "new.h5"
    before = scenario.read_bytes()
    lost = write_artist(out, scenario, plant, learned)
    value = dict(zip(learned.names, learned.parameters_at([0], float("nan"))[0][0], strict=True))
    assert lost == {NAME: (f"canting {value['canting']:.4g} rad",)}
    assert scenario.read_bytes() == before
    with h5py.File(out) as root:
        own = root[f"heliostats/{NAME}"]
        tilts = own["kinematics/deviations"]
        assert tilts["first_joint_tilt_u"][()] == np.float32(value["tilt_north"])
        assert abs(tilts["second_joint_tilt_n"][()]) == pytest.approx(
            abs(value["non_orthogonality"]), rel=1e-6
        )
        assert own["kinematics/type"][()] == b"rigid_body"
        assert own["actuator/actuator_1/type"][()] == b"linear"
        np.testing.assert_allclose(
            own["position"][()], [*plant[NAME].position, 1.0], rtol=1e-6, atol=1e-6
        )
        assert root[f"heliostats/{OTHER}/kinematics/deviations/first_joint_tilt_n"][()] == 0.0
        assert root[f"heliostats/{OTHER}/actuator/actuator_0/type"][()] == b"ideal"
        assert (root[f"heliostats/{NAME}/surface/facets/facet_0/canting"][()] == 1.0).all()


def test_what_is_no_scenario_or_lacks_the_heliostat_is_refused(tmp_path: Path) -> None:
    plant, learned = learnt()
    out = tmp_path / "new.h5"
    (tmp_path / "text.h5").write_text("no scenario")
    with pytest.raises(FormatError, match=r"text\.h5.*an ARTIST scenario"):
        write_artist(out, tmp_path / "text.h5", plant, learned)
    with h5py.File(tmp_path / "other.h5", "w") as root:
        root["heliostats/X1/position"] = np.zeros(4)
        root["power_plant/position"] = np.array(plant.site.origin)
    with pytest.raises(InputError, match=f"heliostat {NAME}.*none with that name"):
        write_artist(out, tmp_path / "other.h5", plant, learned)
    assert not out.exists()


@pytest.mark.skipif(not PYTHON, reason="HELIOTROPE_ARTIST_PYTHON names no interpreter with ARTIST")
def test_artist_loads_it_and_turns_its_mirrors_alike(tmp_path: Path) -> None:
    plant, learned = learnt()
    old, new = tmp_path / "old.h5", tmp_path / "new.h5"

    def artist(*words: object) -> None:
        given = [PYTHON, str(SCRIPT), *(str(word) for word in words)]
        done = subprocess.run(given, capture_output=True, text=True, check=False, cwd=tmp_path)
        assert done.returncode == 0, done.stderr[-3000:]

    artist("make", juelich(), f"{NAME},{OTHER}", old)
    write_artist(new, old, plant, learned)
    counts = np.random.default_rng(0).uniform(5000, 60000, (20, 2))
    (tmp_path / "motors.json").write_text(json.dumps({NAME: counts.tolist()}))
    turned = {}
    for file in (old, new):
        artist("normals", file, tmp_path / "motors.json", tmp_path / "out.json")
        turned[file] = np.array(json.loads((tmp_path / "out.json").read_text())[NAME])
    value = dict(zip(learned.names, learned.parameters_at([0], float("nan"))[0][0], strict=True))
    value.pop("canting")
    wanted = plant[NAME].nominal.with_parameters(value).pose(counts).normal
    miss = np.linalg.norm(turned[new] - wanted, axis=-1)
    # Single precision: 1e-7 of counts of 60,000 and lengths of 100 m.
    assert miss.max() < 2e-5
    assert np.linalg.norm(turned[old] - wanted, axis=-1).min() > 1e-3
