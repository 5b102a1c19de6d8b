r"""Atmospheric attenuation between a mirror and the receiver, by published models.

The fraction of the light that is lost over d km is:

- `clear`: 0.006789 + 0.1046 d − 0.0170 d² + 0.002845 d³ (Vittitoe and Biggs, SAND78-1137C, 1978,
  for a visibility of 23 km; the default of DELSOL3 and SolarPILOT).
- `hazy`: 0.01293 + 0.2748 d − 0.03394 d² (same source, for 5 km).
- `mirval`: 0.00679 + 0.1176 d − 0.0197 d² to 1 km, then 1 − exp(−0.1106 d) (Leary and Hankins,
  SAND77-8280, 1979, p. 14).
- `ballestrin-clear`: 0.0029544 + 0.1522128 d − 0.018598 d² + 0.0015182 d³, and `ballestrin-hazy`:
  0.0077941 + 0.5549083 d − 0.147887 d² + 0.0153718 d³ (Ballestrín's models as implemented in
  Tonatiuh).
- `none`: 0.
- A number, the visibility V in km: 1 − exp(−d ln 50 / V), Koschmieder's law at a contrast of 2 %.

The polynomials were fitted for slant ranges of up to a few kilometres. Beyond their maximum, or
where they leave the range 0 to 1, the largest loss up to that distance is used.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float

#: Polynomials of the distance in km, lowest power first.
_POLYNOMIALS = {
    "none": (0.0,),
    "clear": (0.006789, 0.1046, -0.0170, 0.002845),
    "hazy": (0.01293, 0.2748, -0.03394),
    "ballestrin-clear": (0.0029544, 0.1522128, -0.018598, 0.0015182),
    "ballestrin-hazy": (0.0077941, 0.5549083, -0.147887, 0.0153718),
}
#: Names of the models.
AIR_MODELS = (*_POLYNOMIALS, "mirval")
#: ln 50: Koschmieder's extinction times visibility, at a contrast of 2 %.
_CONTRAST = float(np.log(50.0))
#: Visibilities that are taken, km.
_VISIBILITY = (0.1, 500.0)


def air_loss(distance: npt.ArrayLike, model: str | float = "clear") -> FloatArray:
    """Return the fraction of the light that the atmosphere absorbs and scatters, 0 to 1, (...).

    Parameters
    ----------
    distance
        From mirror to receiver, m, (...), 0 or more; NaN yields NaN.
    model
        One of `AIR_MODELS`, or the visibility, km.

    Raises
    ------
    InputError
        If the model does not exist, or the visibility is out of range.
    """
    return air_model(model)(as_float(distance))


def air_model(model: str | float) -> Callable[[FloatArray], FloatArray]:
    """Return a function that maps distances (m) to the fraction lost in the atmosphere.

    Raises
    ------
    InputError
        If there is no such model, or the visibility is out of range.
    """
    if model == "mirval":
        return _mirval
    if isinstance(model, str) and model in _POLYNOMIALS:
        terms = np.array(_POLYNOMIALS[model])
        return lambda distance: _polynomial(terms, distance)
    try:
        visibility = float(model)
    except ValueError:
        visibility = np.nan
    low, high = _VISIBILITY
    if not low <= visibility <= high:
        raise InputError(
            f"unknown air model {model!r}; known: {', '.join(AIR_MODELS)}; or specify the "
            f"visibility, {low:g} to {high:g} km"
        )
    return lambda distance: as_float(-np.expm1(-_CONTRAST * 1e-3 * distance / visibility))


def _polynomial(terms: FloatArray, distance: FloatArray) -> FloatArray:
    d = 1e-3 * distance
    turns = (
        np.roots(np.polynomial.polynomial.polyder(terms)[::-1]) if len(terms) > 2 else np.empty(0)
    )
    rising = [float(x.real) for x in turns if abs(x.imag) < 1e-12 and x.real > 0.0]
    far = np.minimum(d, min(rising, default=np.inf))
    return as_float(np.clip(np.polynomial.polynomial.polyval(far, terms), 0.0, 1.0))


def _mirval(distance: FloatArray) -> FloatArray:
    d = 1e-3 * distance
    near = 0.00679 + 0.1176 * d - 0.0197 * d**2
    return as_float(np.where(d <= 1.0, near, -np.expm1(-0.1106 * d)))
