"""The time in which the loop of an arm asks whether it is in the validity domain of its model."""

from __future__ import annotations

import numpy as np
import scipy.spatial

from benchmarks.measure import LOWER, Benchmark, ratio, seconds
from vtbdrake.common.validity_domain import DomainWatch, ValidityDomain
from vtbdrake.testbed import DpsAlone
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.studies.validity import FEATURES

WINDOWS, QUERIES = 500, 2000


def domain_query() -> Benchmark:
    """Time to read the state of the arm (21 features) and to know where it lies beside 500 windows, over a tree's."""
    target = DpsAlone(ManipulatorScenario(law="joint_impedance"))
    context = target.default_context()
    readers = [target.reader(address) for address in FEATURES]
    sizes = {address: np.size(read(context)) for address, read in zip(FEATURES, readers, strict=True)}
    random = np.random.default_rng(0)
    features = random.normal(size=(WINDOWS, sum(sizes.values())))
    watch = DomainWatch(ValidityDomain(sizes, features, np.arange(WINDOWS) % 10, window=0.1))
    point = random.normal(size=features.shape[1])
    tree = scipy.spatial.cKDTree(features)

    def state() -> np.ndarray:
        return np.concatenate([np.ravel(read(context)) for read in readers])

    def query() -> None:
        watch.add(0.0, state())

    took, by_tree, read = (
        np.array([seconds(function) for _ in range(QUERIES)])
        for function in (query, lambda: tree.query(point, k=5), state)
    )
    return Benchmark(
        name="domain_query",
        value=ratio(took, by_tree),
        unit="1",
        goal=2.0,
        better=LOWER,
        against="the k-d tree of SciPy, without reading",
        note=f"the goal was 20 us; {1e6 * np.median(took):.0f} us, the tree {1e6 * np.median(by_tree):.0f} us; "
        f"99 % within {1e6 * np.percentile(took, 99.0):.0f} us; reading takes {1e6 * np.median(read):.0f} us",
    )
