"""Updates of several periods coincide at some instants: one program covers them all."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Sine, ZeroOrderHold

from vtbdrake.compiled import CompiledRollouts
from vtbdrake.state.systems import collect

# In s.
HORIZON = 0.1
SAMPLE_PERIOD = 0.05


def test_one_program_covers_all_that_coincides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounding lets 0.03 k and 0.01 m meet at some instants and miss each other at others."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    builder = DiagramBuilder()
    before = builder.AddNamedSystem("sine", Sine(1.0, 7.0, 0.3, 1))
    for k, (period, offset) in enumerate(product((0.01, 0.02, 0.03), (0.0, 0.005))):
        hold = builder.AddNamedSystem(f"hold{k}", ZeroOrderHold(period, 1, offset))
        builder.Connect(before.get_output_port(0), hold.get_input_port())
        before = hold
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    outputs = [f"hold{k}.y" for k in range(6)]
    rollouts = CompiledRollouts(
        diagram,
        collect(diagram),
        context,
        horizon=HORIZON,
        sample_period=SAMPLE_PERIOD,
        outputs=outputs,
        compile=True,
    )
    coincided = set()
    for t0 in np.arange(40) * 0.0075:
        context.SetTime(t0)
        instants = rollouts.schedule_at(t0)
        coincided |= {instant.updates for instant in instants}
        batch = rollouts(context=context)
        simulator = Simulator(diagram, context.Clone())
        for instant in instants:
            if instant.is_sample:
                simulator.AdvanceTo(instant.time)
        for address in outputs:
            hold = diagram.GetSubsystemByName(address.split(".")[0])
            expected = hold.get_output_port().Eval(hold.GetMyContextFromRoot(simulator.get_context()))
            np.testing.assert_allclose(batch.outputs[address][0, -1], expected, rtol=0, atol=1e-12)
    assert len(coincided) > 6
    assert len(list(tmp_path.rglob("*.so"))) == 1
