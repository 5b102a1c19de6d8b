"""The files that plants, heliostats and measurements come in, and how they are fetched.

Begin with `open_plant`. One module per format: `plant_file` (our own TOML), `paint` and
`measurements` (PAINT, the public data of Jülich), `heliok`, `solarpilot`, `opencsp`; `fetch`
downloads PAINT's files. Their names are used through the module, as in `heliok.read`; `plant_file`
loads pydantic.
"""

from heliotrope.field.formats.opening import open_plant

__all__ = ["open_plant"]
