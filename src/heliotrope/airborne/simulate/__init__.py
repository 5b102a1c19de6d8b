"""Simulated flights with ground truth: exact reflections, rendered photographs, and trials.

`fly` simulates a flight. `render_flight` writes its photographs, and `reflections_of` returns its
reflections without rendering images. `fly_rendered` also evaluates the photographs and compares the
result with the ground truth. `trials` measures one mirror repeatedly, to find how many photographs
a flight needs.
"""

from heliotrope.airborne.simulate.rendered import (
    Compared,
    compare,
    fly_rendered,
    paper_field,
    paper_flight,
)
from heliotrope.airborne.simulate.rendering import (
    Conditions,
    dark,
    night,
    render_flight,
    write_photo,
)
from heliotrope.airborne.simulate.simulation import (
    Errors,
    Flight,
    Installed,
    exact_reflections,
    fly,
    hover_grid,
    install,
    look_counts,
    reflections_of,
)
from heliotrope.airborne.simulate.trial import TrialConditions, Trials, four_facets, trials

__all__ = [
    "Compared",
    "Conditions",
    "Errors",
    "Flight",
    "Installed",
    "TrialConditions",
    "Trials",
    "compare",
    "dark",
    "exact_reflections",
    "fly",
    "fly_rendered",
    "four_facets",
    "hover_grid",
    "install",
    "look_counts",
    "night",
    "paper_field",
    "paper_flight",
    "reflections_of",
    "render_flight",
    "trials",
    "write_photo",
]
