"""The fixture by which a case states what it verifies; `python -m tests.verification` prints what it has stated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import ArrayLike

Verify = Callable[..., None]


@pytest.fixture
def verify(record_property: Callable[[str, object], None]) -> Verify:
    """Return the function that compares a quantity with its reference, and notes both for the table.

    Its arguments are the quantity in words, the value, the reference, the largest ``tolerance`` of the absolute error
    of all entries, and the ``unit``. With ``relative=True`` the error is divided by the largest entry of the reference.
    """

    def compare(
        quantity: str,
        value: ArrayLike,
        reference: ArrayLike,
        *,
        tolerance: float,
        unit: str = "1",
        relative: bool = False,
    ) -> None:
        expected = np.asarray(reference, dtype=float)
        error = float(np.max(np.abs(np.asarray(value, dtype=float) - expected)))
        if relative:
            error, unit = error / float(np.max(np.abs(expected))), "of the value"
        record_property(
            "verification", {"quantity": quantity, "unit": unit, "error": error, "tolerance": float(tolerance)}
        )
        # Not `error > tolerance`: NaN fails, too.
        assert error <= tolerance, f"{quantity}: {value}, not {reference}; error {error:.3g} > {tolerance:.3g} ({unit})"

    return compare
