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
def ray_pool():
    """Ray has no executor of its own; this is what one takes."""
    ray = pytest.importorskip("ray")

    class RayExecutor(concurrent.futures.Executor):
        num_workers = 2

        def submit(self, fn, /, *args, **kwargs):
            return ray.remote(fn).remote(*args, **kwargs).future()

    ray.init(num_cpus=2, include_dashboard=False)
    yield RayExecutor()
    ray.shutdown()
