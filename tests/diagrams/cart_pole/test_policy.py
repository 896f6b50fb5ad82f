"""The policy that balances the cart-pole: trained, in simulation, and on a machine."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

import vtbdrake as vtb
from vtbdrake.visualization import log_motion
from vtbdrake_diagrams.cart_pole import policy
from vtbdrake_diagrams.cart_pole.dps import PERCEIVED
from vtbdrake_diagrams.cart_pole.policy import BALANCE_ONNX, STARTS, UPRIGHT, BalancedCartPole


def gains_of(path: Path) -> np.ndarray:
    (gains,) = (w for w in onnx.load(path).graph.initializer if w.name == "gains")
    return numpy_helper.to_array(gains)[:, 0]


@pytest.mark.parametrize("start", STARTS)
def test_the_pole_is_balanced_and_the_force_is_that_of_the_gains(start: dict[str, float]) -> None:
    testbed = BalancedCartPole().build()
    context = testbed.default_context()
    testbed.write(context, start)
    simulator, state = testbed.simulator(context), testbed.reader("plant.state")
    simulator.AdvanceTo(0.25)
    # It is sampled at the same instants as what is perceived.
    expected = gains_of(BALANCE_ONNX) @ (testbed.read(context, PERCEIVED) - UPRIGHT)
    assert testbed.read(context, "dps.impl.force") == pytest.approx(expected, rel=1e-4, abs=1e-3)
    simulator.AdvanceTo(8.0)
    np.testing.assert_allclose(state(context), UPRIGHT, atol=0.02)


@pytest.mark.slow
@pytest.mark.one_python
def test_the_shipped_policy_is_what_the_training_finds(tmp_path: Path) -> None:
    policy.write(policy.train(), tmp_path / "balance.onnx")
    np.testing.assert_allclose(gains_of(tmp_path / "balance.onnx"), gains_of(BALANCE_ONNX), rtol=1e-3)


@pytest.mark.slow
def test_on_a_machine_it_balances_and_replays_bit_for_bit(tmp_path: Path) -> None:
    states = balance_on_machine(BalancedCartPole(lock_step=True), seconds=6.0, record=tmp_path / "balance.lcm")
    np.testing.assert_allclose(states[-1], UPRIGHT, atol=0.02)
    assert vtb.replay(tmp_path / "balance.lcm").identical
    # A film of the log shows what the DPS believed: the pole leans, and then it stands.
    angles = log_motion(tmp_path / "balance.lcm").states[:, 1]
    assert angles.max() == pytest.approx(STARTS[0]["sim.sys.cart_pole.pole_pin.position"], abs=0.15)
    assert angles[-1] == pytest.approx(np.pi, abs=0.02)


def balance_on_machine(scenario: BalancedCartPole, *, seconds: float, record: Path) -> np.ndarray:
    """Return the states that the DPS perceives in each cycle, shape (n, 4)."""
    with (
        vtb.Hub(port=0) as hub,
        vtb.MachineProcess(scenario, hub.url, lock_step=scenario.lock_step, values=STARTS[0]),
        scenario.deploy(hub.url, record=record) as runtime,
    ):
        perceived, states = runtime.target.reader(PERCEIVED), []
        runtime.take_over(timeout=60.0)
        runtime.run(
            cycles=round(seconds / scenario.period),
            until=lambda: states.append(np.array(perceived(runtime.context))) or False,
        )
    return np.array(states)
