"""File formats for plants, heliostats and measurements, and downloads of such files.

Begin with `open_plant`. Each format is a module whose functions are called through the module, as
in `heliok.read`: `heliok`, `solarpilot` and `opencsp` (read only), `paint` and `measurements` (the
public data from Jülich), and `plant_file`, our own TOML format. `fetch` downloads PAINT's files.
`paint`, `measurements`, `plant_file` and `fetch` must be imported by name, because they load slow
libraries.
"""

from heliotrope.field.formats import heliok, opencsp, solarpilot
from heliotrope.field.formats.opening import open_plant

__all__ = ["heliok", "open_plant", "opencsp", "solarpilot"]
