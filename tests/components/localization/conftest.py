from collections.abc import Iterator

import pytest
from threadpoolctl import threadpool_limits


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Compute small matrices with one thread: on a busy computer, several wait for each other most of the time."""
    with threadpool_limits(1, user_api="blas"):
        yield
