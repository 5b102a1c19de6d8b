"""Simulated local controllers, true to the firmware, and their bus."""
