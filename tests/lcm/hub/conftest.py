from functools import partial

import pytest

from tests.lcm.hub.clients import raw_client


@pytest.fixture(params=[False, True], ids=["tcp", "unix"])
def connect(request: pytest.FixtureRequest):
    """Connect a raw client by TCP or by the shortcut."""
    return partial(raw_client, unix=request.param)
