"""The simulated plant: drives, boards, buses, clocks, whole fields; and what tries to break it."""
