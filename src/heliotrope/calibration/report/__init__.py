"""Reports of a calibration: the page, its pictures, and files for other programs."""
