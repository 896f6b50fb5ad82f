"""The part of a DPS that turns a plan, the knots of a spline, into a value over time."""

from __future__ import annotations

from math import inf, isfinite

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.common.argument_checks import as_array
from vtbdrake.common.spline import Spline
from vtbdrake.state import AddressedSystem, Quantity

# In seconds: a plan that begins at k * period begins at the sample of that number, however both are rounded.
_ROUNDING = 1e-9


class SplineCommand(AddressedSystem):
    """Follows a plan: a spline over time whose knots are decided while it runs.

    .. pydrake_system::

        name: SplineCommand
        input_ports:
        - plan
        output_ports:
        - value

    ``plan`` = [t_begin, w_0, ..., w_{n-1}] has 1 + n m entries: the time at which the plan begins, in seconds, and n
    knots of m entries each. At t = 0, T, 2 T, ... the system reads the plan, and its output, which is its state,
    becomes the spline's value at t - t_begin. So one vector is the whole plan, whether it is given by an operator (a
    command u), by a slow part or in a rollout; and a plan that arrives late is followed from its present value on.

    Before t_begin the value does not change. After the end of the plan it is the last one, or ``after``; or the plan
    begins again, if it is repeated.
    """

    def __init__(
        self,
        spline: Spline,
        *,
        period: float,
        size: int = 1,
        after: ArrayLike | None = None,
        repeat: bool = False,
        initial: ArrayLike = 0.0,
        unit: str = "1",
    ) -> None:
        """Declare the system.

        Args:
            spline: The curve that the knots define.
            period: Sample period T in seconds.
            size: Entries m of the value.
            after: The value after the end of the plan, a scalar or shape (m,), for example a force of 0 if nobody
                decides any more. None holds the last value of the plan.
            repeat: Whether the plan begins again at its end.
            initial: The value until the first plan begins, a scalar or shape (m,).
            unit: Unit of the value.

        Raises:
            ValueError: The period or the size is not positive, or ``after`` or ``initial`` is not finite or has another
                size.
        """
        super().__init__()
        if not 0.0 < period < inf:
            raise ValueError(f"SplineCommand: period is positive, in s, not {period}")
        if size < 1:
            raise ValueError(f"SplineCommand: a value has at least one entry, not {size}")
        self.spline, self._size, self.repeat = spline, int(size), bool(repeat)
        # Computed here, since it takes longer than a cycle of a loop.
        _ = spline.pieces
        self.after = None if after is None else _vector("after", after, self._size)
        self._plan = self.DeclareVectorInputPort("plan", 1 + spline.knots * self._size)
        first = _vector("initial", initial, self._size)
        self._value = self.declare_discrete_state(value=Quantity(first if size > 1 else first.item(), unit))
        self.DeclareStateOutputPort("value", self._value.index)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        plan, spline = self._plan.Eval(context), self.spline
        if not isfinite(plan @ plan):
            raise ValueError(f"SplineCommand: the plan is [t_begin, knots] in finite numbers, not {plan.tolist()}")
        t = context.get_time() - float(plan[0])
        if t < -_ROUNDING:
            return
        if self.repeat:
            # Rounded down a little before the end: the sample at the end is the first again.
            t = (t + _ROUNDING) % spline.duration - _ROUNDING
        value = self._value.mutable_array(state)
        if t > spline.duration + _ROUNDING and self.after is not None:
            value[:] = self.after
        else:
            spline.write_value(min(max(t, 0.0), spline.duration), plan[1:], value)


def _vector(name: str, value: ArrayLike, size: int) -> np.ndarray:
    array = as_array(f"SplineCommand: {name}", value)
    if array.shape not in ((), (size,)) or not np.isfinite(array).all():
        raise ValueError(f"SplineCommand: {name} is one finite number, or {size} of them, not {value!r}")
    return np.array(np.broadcast_to(array, (size,)))
