"""Cost of a cycle of a policy in an ONNX file, against the session of onnxruntime alone."""

from __future__ import annotations

import tempfile
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper
from pydrake.systems.analysis import Simulator

from benchmarks.measure import LOWER, Benchmark, interleaved, ratio
from vtbdrake.components.onnx_policy import OnnxPolicy

PERIOD = 0.02
# Name of the row -> sizes of the layers: the policy of a quadruped, and a small one.
NETWORKS = {"policy_cycle": (48, 512, 256, 128, 12), "policy_cycle_small": (4, 16, 1)}


def policy_cycle(repeats: int = 41, cycles: int = 200) -> list[Benchmark]:
    """Time per cycle: Drake's event, reading the port, the network, writing the state; the session runs the network."""
    results = []
    for name, sizes in NETWORKS.items():
        with tempfile.TemporaryDirectory() as folder:
            path = write_network(Path(folder) / "policy.onnx", sizes)
            cycle = _Cycles(path, sizes, cycles)
            session = _session(path)
            inputs = {"obs": np.ones((1, sizes[0]), dtype=np.float32)}
            cycle()
            (expected,) = session.run(None, inputs)
            if not np.array_equal(cycle.action(), expected[0]):
                raise ArithmeticError(f"{name}: the policy and the session differ")
            times, bare = interleaved(cycle, partial(_run, session, inputs, cycles), repeats=repeats)
        micros = [f"{1e6 * np.median(t) / cycles:.1f}" for t in (times, bare)]
        results.append(
            Benchmark(
                name=name,
                value=ratio(times, bare),
                unit="1",
                goal=None if results else 1.2,
                better=LOWER,
                against="session.run of the same network, of the layers " + ", ".join(map(str, sizes)),
                note=f"{micros[0]} and {micros[1]} us per cycle, n = {repeats}; the same bits",
            )
        )
    return results


class _Cycles:
    """Simulates some cycles more in each call."""

    def __init__(self, path: Path, sizes: tuple[int, ...], cycles: int) -> None:
        self._policy = OnnxPolicy(
            path, period=PERIOD, inputs={"obs": {"obs": sizes[0]}}, outputs={"action": {"action": sizes[-1]}}
        )
        self._simulator = Simulator(self._policy)
        self._policy.get_input_port().FixValue(self._simulator.get_mutable_context(), np.ones(sizes[0]))
        self._simulator.Initialize()
        self._cycles, self._done = cycles, 0

    def __call__(self) -> None:
        self._done += self._cycles
        self._simulator.AdvanceTo(self._done * PERIOD)

    def action(self) -> np.ndarray:
        return np.array(self._policy.get_output_port().Eval(self._simulator.get_context()))


def _session(path: Path) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def _run(session: Any, inputs: dict[str, np.ndarray], cycles: int) -> None:
    for _ in range(cycles):
        session.run(None, inputs)


def write_network(path: Path, sizes: tuple[int, ...]) -> Path:
    """Write layers with random weights and ELU between them: obs (batch, n) -> action (batch, m)."""
    rng = np.random.default_rng(0)
    nodes, weights, flow = [], [], "obs"
    for layer, (rows, columns) in enumerate(pairwise(sizes)):
        is_last = layer == len(sizes) - 2
        weight, bias = rng.normal(size=(rows, columns)) / np.sqrt(rows), rng.normal(size=columns)
        named = {f"W{layer}": weight, f"b{layer}": bias}
        weights += [numpy_helper.from_array(value.astype(np.float32), name) for name, value in named.items()]
        result = "action" if is_last else f"z{layer}"
        nodes.append(helper.make_node("Gemm", [flow, *named], [result]))
        if not is_last:
            flow = f"h{layer}"
            nodes.append(helper.make_node("Elu", [result], [flow]))
    takes, returns = (
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
        for name, size in (("obs", sizes[0]), ("action", sizes[-1]))
    )
    graph = helper.make_graph(nodes, "policy", [takes], [returns], weights)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return path
