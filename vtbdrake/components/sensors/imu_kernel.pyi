import numpy as np
from numpy.typing import NDArray

def sample(
    state: NDArray[np.float64],
    *,
    orientation: int,
    velocity: int,
    mount: NDArray[np.float64],
    g_W: NDArray[np.float64],
    memory: NDArray[np.float64],
    period: float,
) -> NDArray[np.float64]:
    """Return the measurement of an IMU: [angular velocity, specific force] in its frame F, in rad/s and m/s^2.

    Args:
        state: Numbers that hold the motion of the body B.
        orientation: Index in ``state`` of the first of four: q_WB (wxyz), not necessarily of unit length.
        velocity: Index in ``state`` of the first of six: w_WB in rad/s, then v_WB in m/s.
        mount: The pose of F in B: [x, y, z, roll, pitch, yaw], in m and rad.
        g_W: The acceleration of free fall in m/s^2, shape (3,).
        memory: The memory of the last sample, overwritten: [1 if there was one, v_WF (3), q_WF (4)].
        period: The sample period in s.
    """

def specific_force_at_rest(q_WF: NDArray[np.float64], g_W: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return -R_WF' g in m/s^2, shape (3,), for the unit quaternion q_WF (wxyz)."""
