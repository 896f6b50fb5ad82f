"""The equations of the arm's environment, for compiled testbeds."""

from __future__ import annotations

from typing import Any

import casadi

from vtbdrake.compiled import At, Equations
from vtbdrake.components.compiled_plant import AppliedForce


class PushEquations(Equations):
    """A `Push`: a constant wrench on a body."""

    def output(self, port: str, at: At) -> list[AppliedForce]:
        push: Any = self.system
        return [AppliedForce(int(push.body), casadi.SX(push.p_BoBq_B), at.parameter(0))]
