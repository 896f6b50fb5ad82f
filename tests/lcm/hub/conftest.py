from functools import partial

import pytest

from tests.lcm.hub.clients import raw_client
from vtbdrake.lcm.hub import Hub


@pytest.fixture
def hub():
    with Hub(port=0) as hub:
        yield hub


@pytest.fixture(params=[False, True], ids=["tcp", "unix"])
def connect(request: pytest.FixtureRequest):
    """Connect a raw client by TCP or by the shortcut."""
    return partial(raw_client, unix=request.param)
