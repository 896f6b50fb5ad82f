"""Reinforcement learning of the cart-pole: what is trained is what the DPS does, and a policy that fails is braked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

import vtbdrake as vtb
from tests.diagrams.cart_pole.test_policy import balance_on_machine
from vtbdrake_diagrams.cart_pole import policy, training
from vtbdrake_diagrams.cart_pole.policy import BALANCE_ONNX, STARTS, UPRIGHT, BalancedCartPole


def test_a_policy_acts_in_its_environment_as_in_the_dps_bit_for_bit() -> None:
    testbed = BalancedCartPole().build()
    context = testbed.default_context()
    testbed.write(context, STARTS[0])
    simulator = testbed.simulator(context)
    reward = vtb.Quality(policy.cost, of="plant.state", reading="integral", minimize=True)
    env = vtb.gymnasium_env(
        training.PushedCartPole(),
        action=["push"],
        observation=["joint_position", "joint_velocity"],
        reward=reward,
        period=0.02,
        horizon=4.0,
    )
    observed, _ = env.reset(options={"values": STARTS[0]})
    session = onnxruntime.InferenceSession(str(BALANCE_ONNX))
    for k in range(200):
        (force,) = session.run(None, {"state": observed[np.newaxis].astype(np.float32)})
        observed, *_ = env.step(np.clip(force[0].astype(float), -60.0, 60.0))
        simulator.AdvanceTo((k + 1) * 0.02)
        states = [each.read(of, "plant.state") for each, of in ((testbed, context), (env.testbed, env.context))]
        assert states[0].tobytes() == states[1].tobytes()
    np.testing.assert_allclose(states[0], UPRIGHT, atol=0.1)


@pytest.mark.slow
@pytest.mark.one_python
def test_what_is_trained_balances_on_a_machine_and_replays_bit_for_bit(tmp_path: Path) -> None:
    path = tmp_path / "trained.onnx"
    policy.write(training.train(), path)
    scenario = BalancedCartPole(policy=str(path), lock_step=True)
    states = balance_on_machine(scenario, seconds=6.0, record=tmp_path / "trained.lcm")
    np.testing.assert_allclose(states[-1], UPRIGHT, atol=0.02)
    assert vtb.replay(tmp_path / "trained.lcm").identical


def fragile_policy(path: Path, *, lean: float) -> None:
    """Write a policy that pushes by 5 N, and results in NaN where the pole leans by more than ``lean``, in rad."""
    nodes = [
        helper.make_node("Sub", ["state", "upright"], ["error"]),
        helper.make_node("MatMul", ["error", "angle"], ["leaning"]),
        helper.make_node("Abs", ["leaning"], ["lean"]),
        helper.make_node("Sub", ["most", "lean"], ["left"]),
        helper.make_node("Sqrt", ["left"], ["root"]),  # The root of a negative number is NaN.
        helper.make_node("Mul", ["root", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "push"], ["force"]),
    ]
    values = {"upright": UPRIGHT, "angle": np.eye(4)[:, 1:2], "most": [lean], "zero": [0.0], "push": [5.0]}
    constants = [numpy_helper.from_array(np.array(value, dtype=np.float64), name) for name, value in values.items()]
    ends = [helper.make_tensor_value_info(n, TensorProto.DOUBLE, ["batch", k]) for n, k in (("state", 4), ("force", 1))]
    graph = helper.make_graph(nodes, "fragile", ends[:1], ends[1:], constants)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)


@pytest.mark.slow
def test_a_policy_that_results_in_nan_latches_and_the_fallback_commands(tmp_path: Path) -> None:
    # At first it perceives zeros: a pole that hangs.
    fragile_policy(tmp_path / "fragile.onnx", lean=3.5)
    scenario = BalancedCartPole(policy=str(tmp_path / "fragile.onnx"), lock_step=True)
    sent: list[float] = []
    with (
        vtb.Hub(port=0) as hub,
        vtb.MachineProcess(scenario, hub.url, lock_step=True, values=STARTS[0]),
        scenario.deploy(hub.url, record=tmp_path / "fragile.lcm") as runtime,
    ):
        runtime.take_over(timeout=60.0)
        runtime.watch(lambda cycle: sent.append(float(cycle.verdict.actuation["force"][0])))
        runtime.run(cycles=500, until=lambda: bool(runtime.guards.latched))
        (fault,) = runtime.guards.latched
        runtime.run(cycles=5)
        assert runtime.guards.latched == (fault,)
    assert fault.kind == "raised" and "fragile.onnx results in" in fault.reason and "not finite" in fault.reason
    before = len(sent) - 6
    assert sent == [5.0] * before + [0.0] * 6 and before > 10
    assert vtb.replay(tmp_path / "fragile.lcm").identical
