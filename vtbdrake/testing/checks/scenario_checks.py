"""Checks of a scenario as plain data that builds testbeds."""

from __future__ import annotations

import pickle
import tempfile
from pathlib import Path

from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.common.pickling import dumps
from vtbdrake.state.systems import leaves
from vtbdrake.testbed import DpsAlone, VirtualTestbed, load_scenario
from vtbdrake.testing.subject import CheckFailedError, CheckSkippedError, Subject

# Pytest shows none of the frames of this module: what a check has found is its message.
__tracebackhide__ = True

_LOOP = "algebraic loop"


def check_builds(subject: Subject) -> None:
    """Check that the scenario builds a testbed.

    Everything else needs it. The error names the field, the signal or the system that does not fit.
    """
    if not isinstance(subject.built, VirtualTestbed) and _LOOP not in str(subject.built):
        raise CheckFailedError(f"the scenario does not build: {error_text(subject.built)}") from subject.built


def check_no_algebraic_loop(subject: Subject) -> None:
    """Check that no output depends on itself at the same instant.

    A sensor that shows the plant directly, a DPS that computes without sampling and a plant whose measured forces
    depend on its actuators make such a loop. Sample the sensor: its output is then its own state.
    """
    if not isinstance(subject.built, VirtualTestbed) and _LOOP in str(subject.built):
        raise CheckFailedError(
            f"an output depends on itself at the same instant; sample a sensor in the loop, so that its output is its "
            f"state: {error_text(subject.built)}"
        ) from subject.built


def check_builds_alike_twice(subject: Subject) -> None:
    """Check that two builds have the same systems, variables and default values.

    Workers, the robot and the saved studies of tomorrow build anew. What is drawn at random in a constructor differs
    there: draw it from a generator with a seed that is a field of the scenario.
    """
    start, other = subject.start, subject.scenario.build()
    paths, other_paths = ([path for path, _ in leaves(t.diagram)] for t in (subject.testbed, other))
    if paths != other_paths:
        differing = sorted(set(paths) ^ set(other_paths)) or ["their order"]
        raise CheckFailedError(f"a second build has other systems: {', '.join(differing)}")
    addresses = set(subject.testbed.variables()) ^ set(other.variables())
    if addresses:
        raise CheckFailedError(f"only one of two builds has the variables {', '.join(sorted(addresses))}")
    differences = start.compare(other.snapshot(subject.started(other)))
    if differences:
        raise CheckFailedError(
            f"a second build has other default values of {', '.join(sorted(differences))}: take them from fields of "
            "the scenario, and random ones from a generator with a seed"
        )


def check_yaml_round_trip(subject: Subject) -> None:
    """Check that the scenario can be saved as a YAML file, and loaded again.

    Studies, logs and the command line know a scenario by its file. Fields are plain types, dataclasses of them and
    Drake's configs; the class is found by its name in a module.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.yaml"
        try:
            subject.scenario.save(path)
            loaded = load_scenario(path)
        except FAILURES as error:
            raise CheckFailedError(f"the scenario cannot be saved and loaded: {error_text(error)}") from error
    if loaded != subject.scenario:
        raise CheckFailedError(f"after a round trip through a file, {subject.scenario!r} is {loaded!r}")


def check_pickle_round_trip(subject: Subject) -> None:
    """Check that the scenario can be pickled, and comes back equal.

    So it is sent to the workers of a study. Make what cannot be sent (locks, connections, open files) where it is used,
    from plain data.
    """
    try:
        loaded = pickle.loads(dumps(subject.scenario))
    except FAILURES as error:
        raise CheckFailedError(f"the scenario cannot be sent to other processes: {error_text(error)}") from error
    if loaded != subject.scenario:
        raise CheckFailedError(f"in another process, {subject.scenario!r} is {loaded!r}")


def check_mental_copy_continues(subject: Subject) -> None:
    """Check that the DPS of the mental scenario takes over the state of the running one.

    A reasoner simulates the mental scenario from the state of the running DPS: both have the same systems with states
    and parameters of the same sizes. The world, its integrator and the periods may differ.
    """
    mental = subject.scenario.mental()
    if mental == subject.scenario:
        raise CheckSkippedError("the scenario is its own mental copy")
    subject.presuppose_testbed()  # A scenario that does not build has no mental copy, either.
    try:
        mental.validate()
        alone = DpsAlone(mental)
    except FAILURES as error:
        raise CheckFailedError(f"the mental scenario does not build: {error_text(error)}") from error
    sizes, mental_sizes = (
        {key: array.shape for key, array in snapshot.groups.items() if "/abstract/" not in key and _of_dps(key)}
        for snapshot in (subject.start, alone.snapshot(alone.default_context()))
    )
    differing = [key for key in {**sizes, **mental_sizes} if sizes.get(key) != mental_sizes.get(key)]
    if differing:
        raise CheckFailedError(
            f"the DPS of the mental scenario has another state than the DPS of the running one: {', '.join(differing)}"
        )


def _of_dps(key: str) -> bool:
    return key.partition("/")[0].partition(".")[0] == "dps"
