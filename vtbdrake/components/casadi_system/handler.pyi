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
    """What Drake calls with a context and a vector, or the discrete state if it ``updates`` that: it hands the blocks
    that are told here to ``compute`` and the result to ``deliver``, which writes to the vector or the state.

    Args:
        states: the numbers of the groups of discrete state, each a block, read by ``state_value``.
        updates: whether the state is what is written to.
        clock: whether the time is a block.
        parameters: gives a context's group of numeric parameters, which is a block, read by ``vector_value``; or None.
        inputs: each gives a block from the context.
        deliver: None writes the result into the blocks of state, which are views of what is updated.
    """

def evaluator(buffers: Any) -> Callable[[Sequence[ArrayLike]], NDArray[np.float64]]:
    """What gathers blocks in z, evaluates and returns y, of ``buffers.parts``: z, what evaluates, y."""

def gather(blocks: Sequence[ArrayLike], z: NDArray[np.float64]) -> None:
    """The blocks one after the other, of floats of shape (n_i,), into z of shape (n,): as `numpy.concatenate`, which
    does what is no array like that."""

def scatter(y: NDArray[np.float64], blocks: list[NDArray[np.float64]]) -> None:
    """y of shape (n,) into the blocks of shape (n_i,), one after the other: the reverse of `gather`.

    Raises:
        ValueError: y or a block is no contiguous array of floats, a block is read-only, or y has too few.
    """
