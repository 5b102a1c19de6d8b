"""Plot days, errors, fields and mechanisms, on existing or new axes.

`day`, `residuals`, `ellipses`, `field_map`, `year_map`, `drift`, `receiver_map`, `efficiency_map`
and `flux_3d` draw on matplotlib axes and return them; reports use the same functions. `flux_figure`
returns a figure of the field's flux, and `mechanism_3d` a plotly figure with a time slider (``pip
install 'heliotrope[notebook]'``). Colour-blind readers can distinguish the colours.
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
