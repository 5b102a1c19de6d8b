"""Deterministic simulation: plant, clusters and boards in virtual time, with seeded faults."""
