"""Settings that all clusters of a plant share, and their checksum in each status.

The plant computes the checksum of its own settings and compares it with the reported checksum.
"""

import dataclasses
from dataclasses import dataclass, field
from zlib import crc32

from heliotrope.safety import Limits, Watcher, conditions, limited, watched_by

#: What a row of the safety table does; its texts may differ between versions of the program.
_ROW = ("trips", "releases", "delay", "clear_for", "stale_after", "then_stow", "act", "scope")


@dataclass(frozen=True)
class CommonSettings:
    """Settings that should be the same in all clusters.

    Parameters
    ----------
    steps_every
        Interval at which the step counts of each heliostat are requested, in s.
    silence
        Time without a reply after which a heliostat is reported, in s.
    delta_t
        TT − UT1, in s; None if it follows from the date.
    limits
        Limits of the safety table that the plant sets; only rows that clusters evaluate count.
    """

    steps_every: int = 1
    silence: float = 10.0
    delta_t: float | None = None
    limits: Limits = field(default_factory=dict)


def settings_checksum(common: CommonSettings) -> str:
    """Return the checksum of common settings as eight hexadecimal digits.

    It is the CRC-32 of ASCII text with a line ``name=value`` for each setting, sorted by name, each
    line terminated by a newline. A value is the shortest decimal that yields the same binary64
    number ("inf" for never), or "default".

    The settings are those of ``[polling]``, ΔT of the site, and the limits of the safety-table rows
    that a cluster evaluates. The checksum does not cover name, heliostats, phase and keys; ports,
    and reply times that depend on the bus; the rest of the site, which each status carries in full;
    and the longest autonomy, which depends on whether a cluster has an emergency line. If the
    longest autonomy is less than the plant grants, the cluster reports this (`autonomy_limited`).
    """
    values: dict[str, float | None] = {
        "delta_t_s": common.delta_t,
        "silence_s": common.silence,
        "steps_every_s": common.steps_every,
    }
    for row in watched_by(limited(conditions(), common.limits), Watcher.CLUSTER):
        fields = dataclasses.asdict(row)
        values |= {f"{row.name}.{name}": fields[name] for name in _ROW}
    lines = (f"{name}={_text(value)}\n" for name, value in sorted(values.items()))
    return f"{crc32(''.join(lines).encode('ascii')):08x}"


def _text(value: float | None) -> str:
    return "default" if value is None else repr(float(value))
