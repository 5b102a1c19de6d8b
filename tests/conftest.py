"""Settings of all tests: seeded, the same on every run, and no time limits."""

import os

from hypothesis import HealthCheck, settings

settings.register_profile(
    "default",
    derandomize=True,
    deadline=None,
    max_examples=60,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
#: A long random search, by hand: HYPOTHESIS_PROFILE=search pytest -n 2
settings.register_profile(
    "search", settings.get_profile("default"), derandomize=False, max_examples=3000, database=None
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))
