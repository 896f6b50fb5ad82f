from collections.abc import Iterator

import pytest

from vtbdrake.lcm.hub import Hub


@pytest.fixture
def hub() -> Iterator[Hub]:
    with Hub(port=0) as hub:
        yield hub
