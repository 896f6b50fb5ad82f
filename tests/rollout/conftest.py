"""Pools of processes that several tests share; each is started when it is first asked for."""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from benchmarks.dask_cluster import dask_cluster


@pytest.fixture(scope="session")
def cluster():
    """A Dask scheduler and two workers, which gives a rollout up when it has lost it with one of them."""
    with dask_cluster(workers=2, allowed_failures=0) as running:
        yield running


@pytest.fixture(scope="session")
def process_pool():
    """The standard library's, of two processes."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        yield pool
