"""Pictures of days, errors, fields and mechanisms, each on given axes or new ones.

`day`, `residuals`, `ellipses`, `field_map`, `year_map` and `drift` draw on axes of matplotlib and
return them; reports draw with the same functions. `mechanism_3d` gives a figure of plotly with a
slider of time (``pip install 'heliotrope[notebook]'``). Colours can be told apart by the
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
from heliotrope.plot.scene import mechanism_3d

__all__ = [
    "COLOURS",
    "Group",
    "day",
    "drift",
    "ellipses",
    "field_map",
    "mechanism_3d",
    "residuals",
    "year_map",
]
