"""A policy in an ONNX file: its numbers against numpy's, its state in the Context, and what it refuses."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from pydrake.systems.analysis import Simulator

from vtbdrake.components.onnx_policy import OnnxPolicy

FLOAT = TensorProto.FLOAT
DOUBLE = TensorProto.DOUBLE
INT = TensorProto.INT64
Info = tuple[str, int, list[Any]]


def model(
    path: Path, nodes: Sequence[Any], takes: Sequence[Info], returns: Sequence[Info], **constants: np.ndarray
) -> Path:
    tensors = [[helper.make_tensor_value_info(*info) for info in infos] for infos in (takes, returns)]
    weights = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(list(nodes), "policy", *tensors, weights)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return path


WEIGHTS = np.random.default_rng(0).normal(size=(3, 2)).astype(np.float32)


@pytest.fixture
def gemm(tmp_path: Path) -> Path:
    """action (batch, 2) = tanh(obs (batch, 3) W)."""
    nodes = [helper.make_node("MatMul", ["obs", "W"], ["z"]), helper.make_node("Tanh", ["z"], ["action"])]
    return model(
        tmp_path / "gemm.onnx",
        nodes,
        [("obs", FLOAT, ["batch", 3])],
        [("action", FLOAT, ["batch", 2])],
        W=WEIGHTS,
    )


def leaky_sum(path: Path) -> Path:
    """h' (1, batch, 1) = obs + 0.9 h; action = h'."""
    nodes = [
        helper.make_node("Mul", ["h", "leak"], ["kept"]),
        helper.make_node("Add", ["obs", "kept"], ["h_next"]),
        helper.make_node("Reshape", ["h_next", "shape"], ["action"]),
    ]
    takes = [("obs", FLOAT, ["batch", 1]), ("h", FLOAT, [1, "batch", 1])]
    returns: list[Info] = [("action", FLOAT, ["batch", 1]), ("h_next", FLOAT, [1, "batch", 1])]
    return model(path, nodes, takes, returns, leak=np.float32([0.9]), shape=np.int64([1, 1]))


def recurrent(path: Path) -> OnnxPolicy:
    inputs, outputs = {"obs": {"obs": 1}}, {"action": {"action": 1}}
    return OnnxPolicy(leaky_sum(path), period=0.1, inputs=inputs, outputs=outputs, memory={"h": "h_next"})


def test_ports_are_parts_of_the_tensors_and_outputs_are_sampled(gemm: Path) -> None:
    policy = OnnxPolicy(
        gemm,
        period=0.1,
        inputs={"obs": {"q": 2, "v": 1}},
        outputs={"action": {"left": 1, "right": 1}},
        initial={"right": 0.5},
        units={"left": "N"},
    )
    assert [(v.name, v.unit) for v in policy.variables] == [("left", "N"), ("right", "1")]
    simulator = Simulator(policy)
    context = simulator.get_mutable_context()
    q, v = np.array([0.3, -1.2]), np.array([0.7])
    policy.GetInputPort("q").FixValue(context, q)
    policy.GetInputPort("v").FixValue(context, v)
    ports = [policy.GetOutputPort(name) for name in ("left", "right")]
    assert [port.Eval(context).item() for port in ports] == [0.0, 0.5]
    simulator.AdvanceTo(0.05)
    expected = np.tanh(np.concatenate([q, v]) @ WEIGHTS)
    np.testing.assert_allclose([port.Eval(context).item() for port in ports], expected, rtol=1e-6)
    policy.GetInputPort("q").FixValue(context, 2.0 * q)
    np.testing.assert_allclose([port.Eval(context).item() for port in ports], expected, rtol=1e-6)
    simulator.AdvanceTo(0.15)
    expected = np.tanh(np.concatenate([2.0 * q, v]) @ WEIGHTS)
    np.testing.assert_allclose([port.Eval(context).item() for port in ports], expected, rtol=1e-6)


def test_memory_is_in_the_context_so_that_a_fork_continues_alike(tmp_path: Path) -> None:
    policy = recurrent(tmp_path / "sum.onnx")
    simulator = Simulator(policy)
    context = simulator.get_mutable_context()
    policy.get_input_port().FixValue(context, [1.0])
    simulator.AdvanceTo(0.35)
    action, h = policy.get_output_port(), np.float32(0.0)
    for _ in range(4):
        h = np.float32(1.0) + h * np.float32(0.9)
    assert action.Eval(context) == h
    fork = context.Clone()
    simulator.AdvanceTo(0.95)
    other = Simulator(policy, fork)
    other.AdvanceTo(0.95)
    assert action.Eval(context) == action.Eval(fork) > h
    # Another context of the same system begins anew.
    fresh = policy.CreateDefaultContext()
    policy.get_input_port().FixValue(fresh, [1.0])
    Simulator(policy, fresh).AdvanceTo(0.05)
    assert action.Eval(fresh) == 1.0


def test_a_result_that_is_not_finite_is_an_error_and_leaves_the_state(tmp_path: Path) -> None:
    policy = recurrent(tmp_path / "sum.onnx")
    context = policy.CreateDefaultContext()
    state = context.Clone().get_mutable_discrete_state()
    policy.get_input_port().FixValue(context, [np.nan])
    simulator = Simulator(policy, context)
    with pytest.raises(ValueError, match="sum.onnx results in .*nan.*not finite"):
        simulator.AdvanceTo(0.05)
    for group in range(context.num_discrete_state_groups()):
        assert context.get_discrete_state(group).value() == state.value(group) == 0.0


def test_missing_extra_is_named(gemm: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ModuleNotFoundError, match=r"OnnxPolicy needs onnxruntime: pip install 'vtbdrake\[onnx\]'"):
        OnnxPolicy(gemm, period=0.1, inputs={"obs": {"q": 3}}, outputs={"action": {"u": 2}})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"inputs": {"observation": {"q": 3}}}, "has no input 'observation', but 'obs': name"),
        ({"outputs": {"force": {"u": 2}}}, "has no output 'force', but 'action'"),
        ({"inputs": {"obs": {"q": 2}}}, r"'obs' of gemm.onnx has 3 entries, in the shape \(1, 3\), .* q \(2\) have 2"),
        ({"outputs": {"action": {"u": 3}}}, r"'action' of gemm.onnx has 2 entries, .* u \(3\) have 3"),
        ({"inputs": {"obs": 3}}, "inputs must be {"),
        ({"inputs": {"obs": {"q": 3.5}}}, "the size of q must be a whole number, not 3.5"),
        ({"period": 0.0}, "period is positive and finite, in s, not 0.0"),
        ({"initial": {"v": 0.0}}, "initial names 'v', but the output ports are 'u'"),
        ({"initial": {"u": [np.nan, 0.0]}}, "initial of u is one finite number, or 2 of them"),
        ({"initial": {"u": ["1", "2"]}}, "initial of u must be a number or several, not .'1', '2'"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(gemm: Path, changes: dict[str, Any], message: str) -> None:
    arguments = {"period": 0.1, "inputs": {"obs": {"q": 3}}, "outputs": {"action": {"u": 2}}} | changes
    with pytest.raises(ValueError, match=message):
        OnnxPolicy(gemm, **arguments)


@pytest.mark.parametrize(
    ("takes", "returns", "message"),
    [
        ([("obs", FLOAT, ["batch", "length"])], FLOAT, r"shape \('batch', 'length'\), where more than the batch is op"),
        ([("obs", INT, [1, 3])], INT, r"'obs' of bad.onnx is a tensor\(int64\), not a tensor\(float\)"),
        ([("obs", FLOAT, [1, 3])], INT, r"'action' of bad.onnx is a tensor\(int64\)"),
        ([("obs", FLOAT, [1, 3]), ("h", FLOAT, [1])], FLOAT, "has the input 'h' beside 'obs': name its ports"),
    ],
)
def test_files_that_do_not_fit_are_refused(tmp_path: Path, takes: list[Info], returns: int, message: str) -> None:
    node = helper.make_node("Cast", ["obs"], ["action"], to=returns)
    path = model(tmp_path / "bad.onnx", [node], takes, [("action", returns, [1, 3])])
    with pytest.raises(ValueError, match=message):
        OnnxPolicy(path, period=0.1, inputs={"obs": {"q": 3}}, outputs={"action": {"u": 3}})


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"period": 0.1, "inputs": {"obs": {"q": 3}}, "outputs": {"action": {"u": 3}}}
    with pytest.raises(FileNotFoundError, match="there is no ONNX file .*none.onnx: export the policy"):
        OnnxPolicy(tmp_path / "none.onnx", **arguments)
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(ValueError, match="text.onnx is no policy that onnxruntime .* can load"):
        OnnxPolicy(tmp_path / "text.onnx", **arguments)


def test_double_precision_is_kept(tmp_path: Path) -> None:
    node = helper.make_node("Identity", ["obs"], ["action"])
    path = model(tmp_path / "same.onnx", [node], [("obs", DOUBLE, [1])], [("action", DOUBLE, [1])])
    policy = OnnxPolicy(path, period=0.1, inputs={"obs": {"q": 1}}, outputs={"action": {"u": 1}})
    context = policy.CreateDefaultContext()
    policy.get_input_port().FixValue(context, [1.0 / 3.0])
    Simulator(policy, context).AdvanceTo(0.0)
    Simulator(policy, context).AdvanceTo(0.05)
    assert policy.get_output_port().Eval(context) == 1.0 / 3.0
