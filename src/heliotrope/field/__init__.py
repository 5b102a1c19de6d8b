"""Many heliostats, the tower with its targets and receiver, and the files they come in."""
