"""An extended Kalman filter of a vehicle among landmarks, once in numpy and once in CasADi.

State (x, y, heading, speed, yaw rate), constant but for noise over a period; measured are range and bearing of each
landmark, and the yaw rate.
"""

from __future__ import annotations

from math import cos, remainder, sin, tau

import casadi
import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from vtbdrake.components.casadi_system import CasadiSystem

PERIOD = 0.01
LANDMARKS = np.array([[4.0, 1.0], [-1.0, 5.0]])
Q = np.diag([1e-6, 1e-6, 1e-7, 1e-4, 1e-4])
R = np.diag([1e-2, 1e-3, 1e-2, 1e-3, 1e-4])
X0 = np.array([0.1, -0.1, 0.05, 0.4, 0.0])
P0 = np.diag([0.1, 0.1, 0.01, 0.1, 0.01])


def measurements(steps: int) -> np.ndarray:
    """Return measurements of a vehicle on a circle, (5, steps), without noise."""
    t = PERIOD * np.arange(steps)
    speed, rate = 0.5, 0.3
    position = speed / rate * np.array([np.sin(rate * t), 1.0 - np.cos(rate * t)])
    offsets = LANDMARKS[:, :, None] - position
    ranges = np.hypot(offsets[:, 0], offsets[:, 1])
    bearings = np.arctan2(offsets[:, 1], offsets[:, 0]) - rate * t
    return np.stack([ranges[0], bearings[0], ranges[1], bearings[1], np.full(steps, rate)])


class NumpyFilter(LeafSystem):
    """The filter in numpy.

    .. pydrake_system::

        name: NumpyFilter
        input_ports:
        - z
        output_ports:
        - x
    """

    def __init__(self) -> None:
        super().__init__()
        self._z = self.DeclareVectorInputPort("z", 5)
        self.DeclareStateOutputPort("x", self.DeclareDiscreteState(X0))
        self.DeclareDiscreteState(P0.ravel())
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        x, y, heading, speed, rate = context.get_discrete_state(0).value().tolist()
        P = context.get_discrete_state(1).value().reshape(5, 5)
        c, s = PERIOD * cos(heading), PERIOD * sin(heading)
        F = np.array(
            [
                [1.0, 0.0, -s * speed, c, 0.0],
                [0.0, 1.0, c * speed, s, 0.0],
                [0.0, 0.0, 1.0, 0.0, PERIOD],
                [0.0, 0.0, 0.0, 1.0, 0.0],
                [0.0, 0.0, 0.0, 0.0, 1.0],
            ]
        )
        predicted = np.array([x + c * speed, y + s * speed, heading + PERIOD * rate, speed, rate])
        P = F @ P @ F.T + Q
        H = np.zeros((5, 5))
        H[4, 4] = 1.0
        z = self._z.Eval(context).tolist()
        innovation = np.empty(5)
        innovation[4] = z[4] - rate
        for k, (dx, dy) in enumerate((LANDMARKS - predicted[:2]).tolist()):
            square = dx * dx + dy * dy
            r = square**0.5
            H[2 * k, :2] = -dx / r, -dy / r
            H[2 * k + 1, :3] = dy / square, -dx / square, -1.0
            innovation[2 * k] = z[2 * k] - r
            innovation[2 * k + 1] = remainder(z[2 * k + 1] - (np.arctan2(dy, dx) - predicted[2]), tau)
        HP = H @ P
        K = np.linalg.solve(HP @ H.T + R, HP).T
        P = P - K @ HP
        state.set_value(0, predicted + K @ innovation)
        state.set_value(1, (0.5 * (P + P.T)).ravel())


def casadi_filter(*, compile: bool) -> CasadiSystem:
    """The filter in CasADi, whose Jacobians are CasADi's."""
    x, P, z = casadi.SX.sym("x", 5), casadi.SX.sym("P", 5, 5), casadi.SX.sym("z", 5)
    heading, speed, rate = x[2], x[3], x[4]
    predicted = x + PERIOD * casadi.vertcat(casadi.cos(heading) * speed, casadi.sin(heading) * speed, rate, 0, 0)
    F = casadi.jacobian(predicted, x)
    p = casadi.SX.sym("p", 5)
    measured = []
    for landmark in LANDMARKS:
        dx, dy = landmark[0] - p[0], landmark[1] - p[1]
        measured += [casadi.sqrt(dx**2 + dy**2), casadi.atan2(dy, dx) - p[2]]
    h = casadi.vertcat(*measured, p[4])
    H, h = casadi.substitute([casadi.jacobian(h, p), h], [p], [predicted])
    innovation = z - h
    innovation[[1, 3]] = casadi.remainder(innovation[[1, 3]], tau)
    P_next = F @ P @ F.T + Q
    HP = H @ P_next
    K = casadi.solve(HP @ H.T + R, HP).T
    P_next = P_next - K @ HP
    results = [predicted + K @ innovation, (P_next + P_next.T) / 2]
    update = casadi.Function("filter", [x, P, z], results, ["x", "P", "z"], ["x_next", "P_next"], {"cse": True})
    return CasadiSystem(update=update, state={"x": X0, "P": P0}, period=PERIOD, compile=compile)
