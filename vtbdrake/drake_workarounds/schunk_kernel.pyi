import numpy as np
from numpy.typing import NDArray

def errors(motion: NDArray[np.float64], state: NDArray[np.float64], *, time: float) -> NDArray[np.float64]:
    """Return the errors of mean and grip, in m, and of their rates, in m/s, shape (4,).

    Args:
        motion: The ramp as numbers, shape (19,), in the order in which `SchunkWsgControl` declares its state.
        state: Positions and velocities of the fingers, in m and m/s, shape (4,).
        time: The time in s.
    """

def actuation(
    motion: NDArray[np.float64],
    state: NDArray[np.float64],
    output: NDArray[np.float64],
    *,
    time: float,
    gains: tuple[float, float, float],
    integrals: tuple[float, float],
) -> None:
    """Write the forces on the fingers to ``output``, in N, shape (2,).

    Args:
        motion: As in `errors`.
        state: As in `errors`.
        output: The result.
        time: The time in s.
        gains: kp, ki and kd.
        integrals: The integrals of the errors of mean and grip, in m s.
    """
