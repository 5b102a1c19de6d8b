"""The simulated plant: boards and buses, whole fields, worlds, and attempts to break it.

- `boards`: local controllers true to the firmware, on a simulated bus.
- `field`: ten thousand local controllers as arrays.
- `cameras`, `wind`: cameras that see the simulated beams, and wind that turns the mirrors.
- `live`: a world for a plant at work; begin with `live.World`.
- `records`: command records on a simulated disk.
- `yesterday`: calibrations of the day before, with which a simulated plant may begin.
- `world`, `invariants`: the deterministic simulation with its faults, and the safety invariants
  that it checks at every step.

Each room shows its own public names. The modules below are imported by name, because cameras load
the reading of photographs, which boards and buses do not need.
"""

__all__ = ["cameras", "records", "wind", "yesterday"]
