"""The fit of one heliostat: residuals and the maximum a posteriori estimate."""
