"""The servicer's inertial navigation against a known motion."""

from __future__ import annotations

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from vtbdrake_diagrams.satellite.estimation import BaseEstimator, pose_at

T = 0.02
AXIS = np.array([1.0, 2.0, -1.0]) / np.sqrt(6.0)
RATE, PUSH = 0.2, np.array([0.01, -0.02, 0.03])


def truth(time: float) -> RigidTransform:
    """Turns at a constant rate while it accelerates along a direction that is fixed in I."""
    return RigidTransform(RotationMatrix(AngleAxis(RATE * time, AXIS)), PUSH * time**2 / 2)


def test_follows_a_turning_accelerated_base() -> None:
    def sample(k: int) -> np.ndarray:
        """The mean over the interval that ended at k T, as an Imu measures it."""
        middle = truth((k - 0.5) * T).rotation()
        return np.concatenate([RATE * AXIS, middle.inverse() @ PUSH]) if k > 0 else np.zeros(6)

    builder = DiagramBuilder()
    # A sampled sensor shows at the k-th update what it measured one period before.
    values = np.array([sample(k - 1) for k in range(202)]).T
    steps = PiecewisePolynomial.ZeroOrderHold(T * (np.arange(202) - 0.5), values)
    source = builder.AddSystem(TrajectorySource(steps))
    estimator = builder.AddSystem(BaseEstimator(period=T))
    builder.Connect(source.get_output_port(), estimator.get_input_port())
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(3.999)
    context = estimator.GetMyContextFromRoot(simulator.get_context())
    base = estimator.GetOutputPort("base").Eval(context)
    history = estimator.GetOutputPort("history").Eval(context)
    time = base[0]
    assert abs(time - (3.98 - T)) < 1e-9
    np.testing.assert_allclose(base[8:11], RATE * AXIS, atol=1e-9)
    np.testing.assert_allclose(base[11:], PUSH * time, atol=1e-6)
    for moment in (time, time - 0.5, time - 0.513):
        error = truth(moment).InvertAndCompose(pose_at(history, moment))
        assert abs(error.rotation().ToAngleAxis().angle()) < 1e-6
        assert np.linalg.norm(error.translation()) < 3e-6
