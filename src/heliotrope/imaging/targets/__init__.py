"""Targets in photographs: marks found, views fitted, faces rectified, known points taught."""
