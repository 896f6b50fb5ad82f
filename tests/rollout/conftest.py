"""Pools of processes that several tests share; each is started when it is first asked for.

The cluster ends with the module: its processes are busy all the time.
"""

import concurrent.futures
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from benchmarks.dask_cluster import dask_cluster


@pytest.fixture(scope="module")
def cluster():
    """A Dask scheduler and two workers, which gives a rollout up when it has lost it with one of them."""
    with dask_cluster(workers=2, allowed_failures=0) as running:
        yield running


@pytest.fixture(scope="session")
def process_pool():
    """The standard library's, of two processes."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        yield pool


@pytest.fixture(scope="session")
def loky_pool():
    """Of two processes."""
    loky = pytest.importorskip("loky")
    with loky.ProcessPoolExecutor(2) as pool:
        yield pool


@pytest.fixture(scope="session")
def own_pool(process_pool):
    """A pool as a user writes one, whose processes vtbdrake does not know."""

    class OwnExecutor(concurrent.futures.Executor):
        num_workers = 2

        def submit(self, fn, /, *args, **kwargs):
            return process_pool.submit(fn, *args, **kwargs)

    return OwnExecutor()
