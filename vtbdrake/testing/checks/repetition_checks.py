"""Checks that simulations repeat: again, side by side, elsewhere, from a copy and from a file."""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import FunctionType
from typing import Any

from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, System

from vtbdrake.rollout.repeatability import (
    Numbers,
    Trace,
    elsewhere,
    first,
    first_difference,
    kept_contexts,
    python_attributes,
    trace,
)
from vtbdrake.rollout.runner import RolloutRunner
from vtbdrake.state import Snapshot
from vtbdrake.state.systems import class_name, leaves
from vtbdrake.state.variables import X
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.testing.checks.scenario_checks import check_pickle_round_trip, check_yaml_round_trip
from vtbdrake.testing.subject import CheckFailedError, Subject

# Pytest shows none of the frames of this module: what a check has found is its message.
__tracebackhide__ = True

_NOISE = 3  # objects that Python itself may make meanwhile


def check_simulates(subject: Subject) -> None:
    """Check that the first part of a simulation does not fail.

    The error comes from the system that raised, or says that the state has become infinite or NaN. Look at the
    integrator, at its step, and at units.
    """
    subject.presuppose_testbed()
    if subject.failure:
        raise CheckFailedError(f"the simulation fails after {subject.reference[-1][0]:g} s: {subject.failure}")


def check_state_is_in_the_context(subject: Subject) -> None:
    """Check that no system remembers anything outside of its Context.

    Rollouts share the systems and have a Context each: what a system keeps in ``self`` or in a Context of its own
    passes from one rollout to another, and no snapshot has it. Declare it as state, as a parameter or as a cache entry.
    """
    subject.presuppose_simulation()
    count, samples = len(subject.reference), trace(subject.runner(1), subject.values)
    attributes = []
    for _ in range(2):
        # In the middle, and at the end.
        _consume(samples, (count + 1) // 2)
        attributes.append(python_attributes(subject.testbed))
    changed = [name for name, value in attributes[1].items() if attributes[0].get(name) != value]
    problems = [f"{name} changes while it is simulated" for name in changed] + list(kept_contexts(subject.testbed))
    if problems:
        raise CheckFailedError(
            "; ".join(problems) + ": declare what is to be remembered as state (DeclareDiscreteState, "
            "DeclareAbstractState), and read it from the context"
        )


def check_runs_repeat(subject: Subject) -> None:
    """Check that a second simulation from the same state is identical to the last bit.

    Optimization compares rollouts, and a log is proved by repeating it. What differs comes from a random generator
    without a seed, from the clock, from a file, or from memory outside of the Context.
    """
    subject.presuppose_simulation()
    _compare(subject.reference, first(trace(subject.runner(2), subject.values), count=len(subject.reference)), "again")


def check_threads_agree(subject: Subject) -> None:
    """Check that a simulation in a thread, beside another on the same Diagram, is identical.

    So a study uses all cores with one build. What differs is shared by the two: memory outside of the Context, or an
    object that belongs to the thread that made it.
    """
    subject.presuppose(check_runs_repeat)
    _compare(subject.reference, list(subject.beside()), "beside another one and in another thread")


def check_processes_agree(subject: Subject) -> None:
    """Check that a simulation in another process, on a new build, is identical.

    So a study uses all cores, and a cluster. What differs depends on the process: a global variable, the order of a
    set, the time, a file, an environment variable.
    """
    subject.presuppose(check_pickle_round_trip, check_runs_repeat)
    states = [a for a, v in subject.testbed.variables().items() if v.kind == X and not v.derived]
    outputs = [f"dps.{signal.name}" for signal in subject.testbed.interface.act]
    horizon = max(float(subject.reference[-1][0]), subject.task.sample_period)
    task = replace(subject.task, horizon=horizon, record=[*states, *outputs], start=subject.start)
    for finding in elsewhere(task, RolloutRunner(task, subject.testbed), {}):
        raise CheckFailedError(finding)


def check_reset_equals_a_new_build(subject: Subject) -> None:
    """Check that a reset Context and a new one equal the first Context of the build.

    Rollouts reset a Context instead of building anew. Who changes the defaults of a system while it is simulated
    (SetDefaultPositions, configure_default_state) changes where all later rollouts begin. In the Context that is reset,
    deformable bodies are not compared: Drake 1.51 leaves them as they are. (Rollouts set them themselves.)
    """
    start, testbed = subject.start, subject.testbed
    context = subject.started(testbed)
    _run(testbed.simulator(context), subject)
    testbed.diagram.SetDefaultContext(context)
    context.SetTime(0.0)
    testbed.write(context, subject.values)
    deformable = set(_deformable_groups(testbed))
    for name, again, left_out in (
        ("a used Context that is reset", context, deformable),
        ("a new Context", subject.started(testbed), set()),
    ):
        differences = start.compare(testbed.snapshot(again)).keys() - left_out
        if differences:
            raise CheckFailedError(
                f"after a simulation, {name} differs from the first one in {', '.join(sorted(differences))}: a system "
                "changes its defaults while it is simulated; let it change its context only"
            )


def _deformable_groups(testbed: VirtualTestbed) -> Iterator[str]:
    """Yield the keys of the groups of a snapshot in which plants have the nodes of deformable bodies."""
    for path, system in leaves(testbed.diagram):
        if isinstance(system, MultibodyPlant):
            model = system.deformable_model()
            for instance in map(ModelInstanceIndex, range(system.num_model_instances())):
                for body in model.GetBodyIds(instance):
                    yield f"{path}/discrete/{int(model.GetDiscreteStateIndex(body))}"


def check_fork_is_the_future(subject: Subject) -> None:
    """Check that a copy of a running simulation continues exactly as the original does.

    A robot reasons in copies of its own state. A value of abstract state that two contexts share must never change:
    make it a frozen dataclass with read-only arrays, and replace it as a whole.
    """
    subject.presuppose(check_runs_repeat)
    testbed = subject.testbed
    original, simulator, middle = _halfway(testbed, subject)
    copied = testbed.default_context()
    testbed.copier_from(testbed).copy(original, copied)
    testbed.fork(simulator)  # An integrator with error control begins anew in both.
    future = _futures(testbed, simulator, subject)
    forecast = _futures(testbed, testbed.simulator(copied, restored=True), subject)
    _compare(future, forecast, f"from a copy at {middle:g} s")


def check_snapshot_resumes(subject: Subject) -> None:
    """Check that a simulation continues exactly from a saved snapshot, on a new build.

    Studies are resumed, and machines started, from files. A codec must keep every bit of an abstract state: do not
    round, and do not leave out what can be computed again.
    """
    subject.presuppose(check_yaml_round_trip, check_runs_repeat)
    testbed = subject.testbed
    _, simulator, middle = _halfway(testbed, subject)
    saved = testbed.fork(simulator).to_bytes()
    future = _futures(testbed, simulator, subject)
    other = subject.scenario.build()
    resumed = other.default_context()
    other.restore(resumed, Snapshot.load(saved))
    forecast = _futures(other, other.simulator(resumed, restored=True), subject)
    _compare(future, forecast, f"from a snapshot at {middle:g} s")


def check_dropped_testbed_is_freed(subject: Subject) -> None:
    """Check that a testbed that nobody uses any more is freed.

    A study that varies a field builds hundreds. A system in Python that is not a `vtbdrake.state.AddressedSystem` and
    keeps its own methods, or itself in a list, is never freed; nor one whose port or cache entry is declared with a
    lambda that refers to it. Declare it with a method: ``self.DeclareVectorOutputPort("y", 1, self.calc_y)``.
    """
    subject.presuppose_simulation()
    before = _systems()
    testbed = subject.scenario.build()
    context = subject.started(testbed)
    testbed.simulator(context).AdvanceTo(min(subject.period, float(subject.instants[-1])))
    del testbed, context
    alive: dict[int, System] = {}
    for _ in range(3):  # What a system of the Diagram owns is freed after it.
        alive.clear()
        gc.collect()
        alive.update((number, system) for number, system in _systems().items() if number not in before)
        if not alive:
            break
    if alive:
        counts = Counter(map(class_name, alive.values()))
        names = ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
        remedy = "Make systems in Python subclasses of vtbdrake.state.AddressedSystem, and keep them in no list"
        if holders := _functions_that_hold(alive):
            remedy = (
                f"A function that refers to its system keeps it: {', '.join(holders)}. Declare ports and cache entries "
                "with methods instead, such as self.calc_y"
            )
        raise CheckFailedError(
            f"of a testbed that is not used any more, these systems are still there: {names}. {remedy}"
        )


def check_runs_keep_no_memory(subject: Subject) -> None:
    """Check that the number of Python's objects does not grow from one simulation to the next.

    A study simulates a hundred thousand times. What grows is a list or a dictionary outside of the Context: a log, a
    cache without a limit.
    """
    runner, count = subject.runner(1), len(subject.reference)
    subject.presuppose_simulation()
    counts = []
    for _ in range(4):
        _consume(trace(runner, subject.values), count)
        gc.collect()
        counts.append(len(gc.get_objects()))
    # The first runs fill caches.
    grown = [after - before for before, after in pairwise(counts[1:])]
    if min(grown) > _NOISE:
        raise CheckFailedError(
            f"every simulation of {count} samples leaves {min(grown)} objects of Python behind: something outside of "
            "the Context keeps them"
        )


def _compare(reference: Trace, repeated: Trace, where: str) -> None:
    difference = first_difference(reference, repeated)
    if difference is None:
        return
    t, parted = difference
    end = next((text for samples in (reference, repeated) for text in samples[-1][1].get("", ()) if _is_text(text)), "")
    verb = f"ends otherwise ({end})" if end else f"differs in {', '.join(path for path in parted if path)}"
    raise CheckFailedError(f"simulated {where}, it {verb}, from t = {t:g} s on")


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _consume(samples: Iterator[object], count: int) -> None:
    for _, _ in zip(range(count), samples, strict=False):
        pass


def _run(simulator: Simulator, subject: Subject) -> None:
    for instant in subject.instants[1:]:
        simulator.AdvanceTo(instant)


def _halfway(testbed: VirtualTestbed, subject: Subject) -> tuple[Context, Simulator, float]:
    """Return a simulation that has come to the middle of the instants: its context, it, and that time in s."""
    context = subject.started(testbed)
    simulator, instants = testbed.simulator(context), subject.instants
    middle = len(instants) // 2
    for instant in instants[1 : middle + 1]:
        simulator.AdvanceTo(instant)
    return context, simulator, float(instants[middle])


def _futures(testbed: VirtualTestbed, simulator: Simulator, subject: Subject) -> Trace:
    """Return the numbers of all systems at the remaining instants, of a simulation that has come to the middle."""
    context: Context = simulator.get_mutable_context()
    numbers, instants = Numbers(testbed, context), subject.instants
    samples: list[tuple[float, Any]] = []
    for instant in instants[len(instants) // 2 + 1 :]:
        simulator.AdvanceTo(instant)
        samples.append((float(instant), numbers.read(context)))
    return samples


def _functions_that_hold(systems: Mapping[int, System]) -> list[str]:
    """Return the functions with a system in their closure or among their defaults, and where they are in the code."""
    places = set()
    for function in gc.get_objects():
        if isinstance(function, FunctionType) and any(id(value) in systems for value in _values_held(function)):
            code = function.__code__
            place = f"{Path(code.co_filename).name}, line {code.co_firstlineno}"
            places.add(f"{function.__qualname__.replace('.<locals>', '')} ({place})")
    return sorted(places)


def _values_held(function: FunctionType) -> Iterator[object]:
    for cell in function.__closure__ or ():
        with suppress(ValueError):  # The cell is empty.
            yield cell.cell_contents
    yield from function.__defaults__ or ()


def _systems() -> dict[int, System]:
    """Return all systems that Python knows, by identity: those that are alive, and those not collected yet."""
    return {id(thing): thing for thing in gc.get_objects() if isinstance(thing, System)}
