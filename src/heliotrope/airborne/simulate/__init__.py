"""Simulated flights: rendered photographs with exact truth."""
