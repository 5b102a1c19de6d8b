"""Expected beam errors, from the present beliefs about the heliostats."""

from collections.abc import Mapping, Sequence

import numpy as np

from heliotrope.calibration.record import covariances_at
from heliotrope.calibration.uncertainty import expected_error, precision
from heliotrope.geometry import FloatArray
from heliotrope.plant.controller import PlantController


def expected_errors(
    plant: PlantController,
    heliostats: Sequence[str],
    aims: FloatArray,
    model: Mapping[str, tuple[str, ...]] | None = None,
) -> FloatArray:
    """Return the expected errors of K beams at their present aims, rad RMS (2-D), (K,).

    For the arguments, and for results of NaN, see `expected_covariances`.
    """
    spread = expected_covariances(plant, heliostats, aims, model)
    return np.asarray(np.sqrt(np.trace(spread, axis1=-2, axis2=-1)))


def expected_covariances(
    plant: PlantController,
    heliostats: Sequence[str],
    aims: FloatArray,
    model: Mapping[str, tuple[str, ...]] | None = None,
) -> FloatArray:
    """Return the covariances of the errors of K beams at their present aims, rad², (K, 2, 2).

    The axes point right and up at the aim, as seen from the mirror. The covariance is NaN for a
    beam that cannot reach its aim, and for a heliostat that was never calibrated and has no
    ``model``.

    Parameters
    ----------
    plant
        Plant with its heliostats, their calibrations and the sun.
    heliostats, aims
        Names, and points in ENU, m, (K, 3).
    model
        Names of the parameters whose priors apply before the first calibration, by heliostat.
    """
    design, beliefs = plant.design, plant.beliefs
    covariances = np.full((len(heliostats), 2, 2), np.nan)
    # Heliostats of one group with the same parameters are computed together.
    parts: dict[tuple[int, tuple[str, ...], bool], list[int]] = {}
    for k, name in enumerate(heliostats):
        record = beliefs.record(name)
        names = (model or {}).get(name) if record is None else record.names
        if names is not None:
            key = id(design.find(name)[0]), names, record is None
            parts.setdefault(key, []).append(k)
    sun, now = plant.sun_vector(), plant.clock.utc().timestamp()
    for (_, names, new), members in parts.items():
        chosen = [heliostats[k] for k in members]
        group = design.find(chosen[0])[0]
        places = np.array([design.find(name)[1] for name in chosen], dtype=np.intp)
        nominal = group.mechanism[places]
        if new:
            values = {name: value[places] for name, value in group.parameters.items()}
            covariance = np.linalg.inv(precision(nominal, names))
        else:
            records = [record for name in chosen if (record := beliefs.record(name))]
            values = dict(zip(names, np.stack([r.values for r in records], axis=1), strict=True))
            covariance = covariances_at(records, now)
        rows = np.array([plant.field.place(name) for name in chosen], dtype=np.intp)
        present, here = nominal.with_parameters(values), plant.field.counts(rows)
        expected = expected_error(present, names, covariance, sun, aims[members], current=here)
        covariances[members] = expected.covariance
    return covariances
