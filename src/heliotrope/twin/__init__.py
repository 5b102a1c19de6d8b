"""The simulated plant: boards and buses, whole fields, environments, and attempts to break it.

- `boards`: simulated local controllers that run the real firmware, on a simulated bus.
- `field`: ten thousand local controllers as arrays.
- `cameras`, `wind`: cameras that see the simulated beams, and wind that deflects the mirrors.
- `live`: simulated surroundings for a running plant; begin with `live.World`.
- `records`: command records on a simulated disk.
- `yesterday`: calibrations from the day before, with which a simulated plant may begin.
- `world`, `invariants`: the deterministic simulation with its faults, and the safety invariants
  that it checks at every step.

Each subpackage exports its own public names. The modules below must be imported by name, because
cameras load the evaluation of photographs, which boards and buses do not need.
"""

__all__ = ["cameras", "records", "wind", "yesterday"]
