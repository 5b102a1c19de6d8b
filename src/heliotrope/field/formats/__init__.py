"""The files that plants, heliostats and measurements come in, and how they are fetched."""
