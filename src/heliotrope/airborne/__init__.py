"""Calibration from the air: a drone with a lamp beside its camera (HelioPoint)."""
