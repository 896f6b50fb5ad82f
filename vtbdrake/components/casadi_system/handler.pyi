from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

def handler(
    *,
    states: tuple[int, ...],
    updates: bool,
    clock: bool,
    parameters: Callable[[Any, int], Any] | None,
    inputs: tuple[Callable[[Any], Any], ...],
    state_value: Callable[[Any, int], Any],
    vector_value: Callable[[Any], Any],
    compute: Callable[[Sequence[ArrayLike]], Any],
    deliver: Callable[[Any, Any], None] | None,
) -> Callable[[Any, Any], None]:
    """Return a calculation for Drake: a function of a context and of the vector or discrete state to write.

    It collects blocks of numbers from the context (groups of discrete state, the time, the parameters, the inputs, in
    this order), calls ``compute`` with them, and writes the result by ``deliver``.

    Args:
        states: Indices of the groups of discrete state; each is a block.
        updates: True for a discrete update, False for an output.
        clock: True if the time is a block.
        parameters: Function of (context, index) that returns the group of numeric parameters; None without parameters.
        inputs: One function per input port, which returns its block from a context.
        state_value: Function of (discrete state, index) that returns the numbers of a group.
        vector_value: Function that returns the numbers of a group of parameters.
        compute: Function of the blocks that returns the result.
        deliver: Function of (vector or state, result) that writes the result. None writes it into the blocks of state,
            which are views of the state to update.
    """

def evaluator(buffers: Any) -> Callable[[Sequence[ArrayLike]], NDArray[np.float64]]:
    """Return a function that gathers blocks in z, evaluates and returns y; ``buffers.parts`` is (z, evaluate, y)."""

def gather(blocks: Sequence[ArrayLike], z: NDArray[np.float64]) -> None:
    """Copy the blocks, arrays of floats of shape (n_i,), one after the other into z of shape (n,).

    Blocks of another kind are left to `numpy.concatenate`.
    """

def scatter(y: NDArray[np.float64], blocks: list[NDArray[np.float64]]) -> None:
    """Copy y of shape (n,) into the blocks of shape (n_i,), one after the other: the reverse of `gather`.

    Raises:
        ValueError: y or a block is not a contiguous array of floats, a block is read-only, or y has too few entries.
    """
