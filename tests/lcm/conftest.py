from collections.abc import Iterator

import pytest

from vtbdrake.lcm.hub import Hub


@pytest.fixture
def hub() -> Iterator[Hub]:
    with Hub(port=0) as hub:
        yield hub


@pytest.fixture(scope="module")
def quiet_hub() -> Iterator[Hub]:
    """A hub that the tests of a module share; it does not publish its status meanwhile."""
    with Hub(port=0, status_period=3600.0, patience=3600.0) as hub:
        yield hub
