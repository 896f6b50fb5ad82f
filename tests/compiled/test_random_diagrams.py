"""Random Diagrams, compiled, do what Drake's Simulator does."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from tests.compiled.random_diagrams import build
from vtbdrake.compiled import CompiledRollouts
from vtbdrake.state.systems import collect

HORIZON, SAMPLE_PERIOD = 0.6, 0.05


def difference(seed: int, *, t0: float = 0.0, compile: bool = False) -> float:
    """The largest difference of a Diagram's outputs and of its state at the end, relative to the largest value or 1."""
    diagram, outputs = build(seed)
    context = diagram.CreateDefaultContext()
    rollouts = CompiledRollouts(
        diagram,
        collect(diagram),
        context,
        horizon=HORIZON,
        sample_period=SAMPLE_PERIOD,
        outputs=outputs,
        compile=compile,
        check=False,
    )
    context.SetTime(t0)
    batch = rollouts(context=context)
    simulator = Simulator(diagram, context)
    simulator.Initialize()
    largest = 0.0
    for k, instant in enumerate(instant for instant in rollouts.schedule_at(t0) if instant.is_sample):
        if k:
            simulator.AdvanceTo(instant.time)
        for address, values in batch.outputs.items():
            system, port = address.split(".")
            subsystem = diagram.GetSubsystemByName(system)
            expected = subsystem.GetOutputPort(port).Eval(subsystem.GetMyContextFromRoot(context))
            largest = max(largest, np.max(np.abs(values[0, k] - expected)) / max(1.0, np.max(np.abs(expected))))
    expected = rollouts.walker.read(context)
    state = np.isfinite(expected)
    apart = np.abs(batch.final[0][state] - expected[state])
    return max(largest, np.max(apart) / max(1.0, np.max(np.abs(expected[state]))))


@pytest.mark.slow_cases
@pytest.mark.parametrize("seed", range(20))
def test_is_the_diagram(seed: int) -> None:
    assert difference(seed) <= 1e-11


@pytest.mark.slow_cases
@pytest.mark.parametrize("seed", range(3))
def test_machine_code_is_the_diagram(seed: int) -> None:
    assert difference(100 + seed, compile=True) <= 1e-11


@pytest.mark.slow_cases
@pytest.mark.parametrize("t0", [0.02, 0.3, 0.055, 1.2])
def test_begins_at_any_time(t0: float) -> None:
    assert difference(7, t0=t0) <= 1e-11


@pytest.mark.slow
@pytest.mark.one_python
def test_twenty_others_are_the_diagram() -> None:
    differences = {seed: difference(seed, t0=float(seed % 3) * 0.05) for seed in range(1000, 1020)}
    assert max(differences.values()) <= 1e-11
