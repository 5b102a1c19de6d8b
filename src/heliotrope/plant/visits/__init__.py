"""Visits of a heliostat to a target: the photographs, the search for its beam, the calibration."""
