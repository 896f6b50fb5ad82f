"""A policy that balances the pole: trained in the testbed, written as an ONNX file, and run as the DPS.

``python -m vtbdrake_diagrams.cart_pole.policy`` trains it again, and rewrites the file in ``models/``.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import casadi
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Diagram, System

import vtbdrake as vtb
from vtbdrake.common.settings import setting
from vtbdrake.components.casadi_system import CasadiSystem
from vtbdrake.components.onnx_policy import OnnxPolicy
from vtbdrake.testbed import Signal
from vtbdrake_diagrams.cart_pole.dps import make_policy_dps
from vtbdrake_diagrams.cart_pole.scenario import CartPoleScenario

BALANCE_ONNX = Path(__file__).parent / "models" / "balance.onnx"
UPRIGHT = np.array([0.0, np.pi, 0.0, 0.0])
"""The state [x, theta, x', theta'] that the policy keeps, in m and rad."""

# Address of the gains that are trained, in N/m, N/rad, N s/m and N s/rad, and the largest of each.
_GAINS = "dps.impl.gains"
_LARGEST_GAINS = (100.0, 1000.0, 100.0, 200.0)
_CART = "sim.sys.cart_pole.cart_slider"
_POLE = "sim.sys.cart_pole.pole_pin"
STARTS = (
    {f"{_POLE}.position": np.pi + 0.2},
    {f"{_POLE}.position": np.pi - 0.1, f"{_CART}.position": 0.5, f"{_CART}.velocity": -0.3},
)
"""States in which the training begins, address -> value."""


@dataclass
class BalancedCartPole(CartPoleScenario):
    """The cart-pole whose DPS is a policy in an ONNX file, which keeps the pole upright."""

    policy: str = setting("", "The ONNX file of the policy; empty for the one that comes with the cart-pole.")

    def _commands(self) -> list[Signal]:
        return []

    @property
    def force_address(self) -> str:
        return "dps.impl.force"

    def make_dps(self) -> Diagram:
        return make_policy_dps(self._make_policy(), period=self.period, force_limit=self.force_limit)

    def _make_policy(self) -> System:
        return OnnxPolicy(
            self.policy or BALANCE_ONNX,
            period=self.period,
            inputs={"state": {"state": 4}},
            outputs={"force": {"force": 1}},
            units={"force": "N"},
        )


@dataclass
class TrainedCartPole(BalancedCartPole):
    """The same cart-pole with a policy whose gains are a variable, and which is compiled with the testbed."""

    def _make_policy(self) -> System:
        state, gains, force = casadi.SX.sym("state", 4), casadi.SX.sym("gains", 4), casadi.SX.sym("force")
        law = casadi.dot(gains, state - UPRIGHT)
        names = ["state", "gains", "force"], ["force_next"]
        return CasadiSystem(
            update=casadi.Function("law", [state, gains, force], [law], *names),
            state={"force": [0.0]},
            parameters={"gains": np.zeros(4)},
            period=self.period,
        )


def cost(state: NDArray[np.float64]) -> float:
    """Return the cost of a state [x, theta, x', theta']: 0 where the pole stands still in the middle of the rail."""
    error = state - UPRIGHT
    value: float = error @ error
    return value


def train(*, rollouts: int = 1500, seed: int = 0) -> NDArray[np.float64]:
    """Return the gains (4,) that the cross-entropy method finds by rollouts of the testbed.

    Args:
        rollouts: The number of rollouts, of one start each.
        seed: The seed of the method.
    """
    problem = vtb.Problem(
        scenario=TrainedCartPole(),
        parameters=[vtb.Parameter(f"{_GAINS}[{i}]", -most, most) for i, most in enumerate(_LARGEST_GAINS)],
        quality=vtb.Quality(cost, of="plant.state", reading="integral", minimize=True),
        conditions=STARTS,
        horizon=4.0,
    )
    study = problem.study(solver="CEM", seed=seed).run(rollouts=rollouts, progress=False)
    return np.array(list(study.best.parameters.values()))


def write(gains: NDArray[np.float64], path: str | os.PathLike[str] = BALANCE_ONNX) -> None:
    """Write the policy force = gains' (state - UPRIGHT) as an ONNX file, in single precision.

    Args:
        gains: The gains, shape (4,), in N/m, N/rad, N s/m and N s/rad.
        path: The file.
    """
    # Imported here: only the training needs it.
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    weights = np.asarray(gains, dtype=np.float32)
    constants = {"gains": weights[:, np.newaxis], "bias": np.array([-gains @ UPRIGHT], dtype=np.float32)}
    graph = helper.make_graph(
        [helper.make_node("Gemm", ["state", "gains", "bias"], ["force"])],
        "balance",
        [helper.make_tensor_value_info("state", TensorProto.FLOAT, ["batch", 4])],
        [helper.make_tensor_value_info("force", TensorProto.FLOAT, ["batch", 1])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    # An opset and a version of the format that older versions of onnxruntime know, too.
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, path)


if __name__ == "__main__":
    write(train())
