"""Pictures of days, errors, fields and mechanisms, each on given axes or new ones.

Drawn on axes of matplotlib, which are returned: `day`, `residuals`, `ellipses`, `field_map`,
`year_map`, `drift`, `receiver_map`, `efficiency_map` and `flux_3d`; reports draw with the same
functions. `flux_figure` gives a figure of the field's light, and `mechanism_3d` one of plotly with
a slider of time (``pip install 'heliotrope[notebook]'``). Colours can be told apart by the
colour-blind.
"""

from heliotrope.plot.charts import (
    COLOURS,
    Group,
    day,
    drift,
    ellipses,
    field_map,
    residuals,
    year_map,
)
from heliotrope.plot.light import aim_figure, efficiency_map, flux_3d, flux_figure, receiver_map
from heliotrope.plot.scene import mechanism_3d

__all__ = [
    "COLOURS",
    "Group",
    "aim_figure",
    "day",
    "drift",
    "efficiency_map",
    "ellipses",
    "field_map",
    "flux_3d",
    "flux_figure",
    "mechanism_3d",
    "receiver_map",
    "residuals",
    "year_map",
]
