"""Checksum of the settings that all clusters of a plant should share, sent in each status."""

import dataclasses
from zlib import crc32

from heliotrope.cluster.config import ClusterConfig
from heliotrope.safety import Watcher, conditions, watched_by

#: What a row of the safety table does; its texts may differ between editions of the program.
_ROW = ("trips", "releases", "delay", "clear_for", "stale_after", "then_stow", "act", "scope")


def settings_checksum(config: ClusterConfig) -> str:
    """Return the checksum of a cluster's common settings, eight hexadecimal digits.

    It is the CRC-32 of ASCII text with a line ``name=value`` for each setting, in the order of the
    names, each line ended by a newline. A value is the shortest decimal that gives the same
    binary64 number ("inf" for never), or "default".

    The settings are those of ``[polling]`` and ``[safety]``, ΔT of the site, and the numbers of the
    rows of the safety table that a cluster watches. Not among them: name, heliostats, phase, keys;
    ports, and the answer times that depend on the bus; the rest of the site, which each status
    carries in full.
    """
    values: dict[str, float | None] = {
        "delta_t_s": config.site.delta_t,
        "longest_autonomy_s": config.longest_autonomy,
        "silence_s": config.silence,
        "steps_every_s": config.steps_every,
    }
    for row in watched_by(conditions(), Watcher.CLUSTER):
        fields = dataclasses.asdict(row)
        values |= {f"{row.name}.{field}": fields[field] for field in _ROW}
    lines = (f"{name}={_text(value)}\n" for name, value in sorted(values.items()))
    return f"{crc32(''.join(lines).encode('ascii')):08x}"


def _text(value: float | None) -> str:
    return "default" if value is None else repr(float(value))
