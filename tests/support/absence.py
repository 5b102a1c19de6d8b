"""What a machine lacks: a visible reason to skip for a developer, a failure in CI."""

import os
from typing import NoReturn

import pytest


def absent(reason: str) -> NoReturn:
    """Skip where a developer lacks something, fail where nothing may be lacking."""
    if os.environ.get("CI"):
        pytest.fail(f"{reason}; CI tests everything")
    pytest.skip(reason)
