import numpy as np
from numpy.typing import NDArray

def weights_at(pieces: NDArray[np.float64], step: float, t: float, derivative: int) -> NDArray[np.float64]:
    """Return the weights of the knots at one time, or their derivative, shape (n,).

    Args:
        pieces: Pieces of the curve, see `Spline.pieces`, shape (pieces, 4, n).
        step: The length of a piece in s.
        t: From the beginning of the curve to its end, in s.
        derivative: 0, 1, 2 or 3.
    """

def value_at(
    pieces: NDArray[np.float64], step: float, t: float, knots: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    """Write the value of a curve at one time into ``out``.

    Args:
        pieces: Pieces of the curve, see `Spline.pieces`, shape (pieces, 4, n).
        step: The length of a piece in s.
        t: From the beginning of the curve to its end, in s.
        knots: Shape (n m,), knot by knot.
        out: The value, shape (m,).
    """
