"""The calibration schedule: which heliostat is measured next, on which target."""
