"""The files that plants, heliostats and measurements come in, and how they are fetched.

Begin with `open_plant`. Each format is a module, whose functions are used through it, as in
`heliok.read`: `heliok`, `solarpilot` and `opencsp` (read only), `paint` and `measurements` (the
public data of Jülich), and `plant_file`, our own TOML. `fetch` downloads PAINT's files. `paint`,
`measurements`, `plant_file` and `fetch` are imported by name, because they load slow libraries.
"""

from heliotrope.field.formats import heliok, opencsp, solarpilot
from heliotrope.field.formats.opening import open_plant

__all__ = ["heliok", "open_plant", "opencsp", "solarpilot"]
