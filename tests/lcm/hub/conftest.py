import pytest

from vtbdrake.lcm.hub import Hub


@pytest.fixture
def hub():
    with Hub(port=0) as hub:
        yield hub
