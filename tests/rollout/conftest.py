"""Pools of processes that several tests share; each is started when it is first asked for.

The cluster ends with the module: its processes are busy all the time. Tests on it are slow ones.
"""

import concurrent.futures
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

from benchmarks.dask_cluster import dask_cluster
from vtbdrake.rollout import ProcessExecutor

# What Dask's processes do while they wait: they look at their own stack a hundred times per second, and at their own
# delays fifty times.
QUIET = {"DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False", "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s"}


def pytest_collection_modifyitems(items):
    for item in items:
        if "cluster" in item.fixturenames and Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="module")
def cluster():
    """A Dask scheduler and two workers, which gives a rollout up when it has lost it with one of them."""
    with pytest.MonkeyPatch.context() as environment:
        for name, value in QUIET.items():
            environment.setenv(name, value)
        with dask_cluster(workers=2, allowed_failures=0) as running:
            yield running


@pytest.fixture(scope="module")
def processes():
    """Two worker processes of our own, which stay warm."""
    with ProcessExecutor(2) as executor:
        yield executor


@pytest.fixture(scope="session")
def process_pool():
    """The standard library's, of two processes."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        yield pool


@pytest.fixture(scope="session")
def loky_pool():
    """An executor of two processes."""
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
