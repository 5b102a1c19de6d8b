"""Compile the numeric kernels once, so that programs start at full speed.

``python -m heliotrope.warm`` takes about half a minute after an installation and a
second afterwards; the compiled code stays in the package's ``__pycache__``.
"""


def main() -> None:
    """Run every kernel once on a small case."""
    import numpy as np

    from heliotrope.calibration.fit.estimator import fit
    from heliotrope.calibration.learn.present import fitting_present
    from heliotrope.calibration.sightings import sightings
    from heliotrope.mechanism import kinds
    from heliotrope.mechanism.tracking import track

    mechanism = kinds.azimuth_elevation(np.array([[0.0, 50.0, 0.0]]), pivot_offset=0.2)
    sun, aim = np.array([0.0, -0.6, 0.8]), np.array([0.0, 0.0, 30.0])
    tracking = track(mechanism, sun, aim)
    counts = tracking.best_counts
    mechanism.jacobian(counts, ("tilt_north", "position_up"))
    mechanism.drives.radians_per_count(counts)
    seen = sightings([0], counts, sun, aim, time=0.0)
    for _ in fitting_present(mechanism, seen, fit(mechanism, seen, "malan8")):
        pass


if __name__ == "__main__":
    main()
