"""Make docs/reference/parameters.md from the parameter table."""

from heliotrope.mechanism.parameters import MODELS, table

PAGE = "docs/reference/parameters.md"
KINDS = {
    "Azimuth-elevation": (
        (
            "tilt_north",
            "tilt_east",
            "azimuth",
            "non_orthogonality",
            "elevation",
            "canting",
            "canting_secondary",
        ),
        (False, False),
    ),
    "Two jacks (Jülich)": (
        (
            "tilt_up",
            "tilt_north",
            "elevation",
            "non_orthogonality",
            "azimuth",
            "canting",
            "canting_secondary",
        ),
        (True, True),
    ),
}

#: Said below the table of models.
ROLES = """The table lists `malan8`, `guo6` and `khalsa8` for azimuth-elevation mechanisms. For
another kind of mechanism, these models consist of the parameters of that kind with the same roles.
The roles are `position`, `tilts`, `biases`, `scales`, `non_orthogonality` and `canting`. To define
a model of your own, join models, roles and parameters by `+`: `malan8+canting`,
`tilts+biases+sag`."""


def pages() -> dict[str, str]:
    """Return the page's text, by path."""
    said = (
        "Each parameter is a deviation from the nominal mechanism. This page is generated from the "
        "table in the program (`python -m scripts.pages`). The two tables are for the two kinds "
        "named in their headings. Other kinds of mechanism have the same parameters, but the names "
        "of drive parameters begin with the names of their own joints."
    )
    lines = ["# Parameters of a mechanism", "", said]
    for kind, (joints, linear) in KINDS.items():
        lines += ["", f"## {kind}", ""]
        lines += ["| name | unit | cause | positive | prior σ | in the literature |"]
        lines += ["|---|---|---|---|---|---|"]
        for row in table(joints, (2, 4), linear).values():
            prior = (
                f"{1e3 * row.prior:g} mrad"
                if row.unit == "rad"
                else (f"{1e3 * row.prior:g} mm" if row.unit == "m" else f"{row.prior:g}")
            )
            cells = [f"`{row.name}`", row.unit, row.cause, row.positive, prior]
            lines.append(f"| {' | '.join([*cells, ', '.join(row.aliases)])} |")
    lines += ["", "## Models", "", "| model | parameters |", "|---|---|"]
    for name, parameters in MODELS.items():
        lines.append(f"| `{name}` | {', '.join(f'`{p}`' for p in parameters)} |")
    lines.append(
        "| `full` | all parameters of a mechanism except the worm parameters and the pivot radius |"
    )
    lines += ["", ROLES]
    return {PAGE: "\n".join(lines) + "\n"}
