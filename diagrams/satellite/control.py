"""Resolved-rate control of the gripper along the moving target."""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from vtbdrake.components.perception.estimate import cross_matrix, rotation_vector
from vtbdrake.state import discrete_state, parameter
from vtbdrake.state.declarations import NO_DICT
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, JOINT_NAMES, Servicer
from vtbdrake_diagrams.satellite.kinematics import joint_rates
from vtbdrake_diagrams.satellite.relative_motion import RELATIVE, Relative
from vtbdrake_diagrams.satellite.supervisor import ABORT, GUIDANCE, HOLD, RETREAT, Guidance

Array = NDArray[np.float64]

# Share of their opening from which on the fingers release the bar.
_OPEN = 0.9


class ArmController(LeafSystem):
    r"""Resolved-rate control of the gripper, with the base's motion subtracted, and of the fingers.

    .. pydrake_system::

        name: ArmController
        input_ports:
        - relative
        - guidance
        - joint_position
        output_ports:
        - joint_position

    While the supervisor lets it follow, the gripper is to be at D, at ``distance`` before the fixture H along its z
    axis (turned by pi about it if ``flip``). With the errors e of position and orientation in B,

        V_BG = V_BD + [K_R e_R; K_p e_p],   |K_R e_R| <= turn_rate,   |K_p e_p| <= speed,
        qdot = J+ V_BG + (1 - J+ J) k (rest - q),   J+ = J' (J J' + damping^2)^-1,

    where V_BD is the velocity of D against the base, in which the base's own motion is subtracted already. All rates
    are scaled down together if one exceeds ``joint_rate``. The output integrates qdot, and stays within ``lead`` of the
    measured positions.

    Otherwise the rates decay (time constant ``brake_time``). After an abort, when the fingers are open, the gripper
    backs off along its z axis for ``back_off`` seconds, and the arm returns to where it was stowed. The fingers follow
    the guidance's opening with ``finger_rate``.
    """

    __slots__ = NO_DICT

    def __init__(self, *, period: float) -> None:
        super().__init__()
        self._period = period
        servicer = Servicer()
        self._rates = joint_rates()
        self._lower, self._upper = servicer.lower + 0.02, servicer.upper - 0.02
        self._stowed = np.array(servicer.stowed)
        self._relative = self.DeclareVectorInputPort("relative", RELATIVE)
        self._guidance = self.DeclareVectorInputPort("guidance", GUIDANCE)
        self._joints = self.DeclareVectorInputPort("joint_position", len(JOINT_NAMES))
        command = self.DeclareDiscreteState(servicer.home)
        self.DeclareStateOutputPort("joint_position", command)
        # The rates of the arm's joints, for how long an abort has lasted, and the positions measured last.
        memory = self.DeclareDiscreteState(np.concatenate((np.zeros(ARM_JOINTS + 1), servicer.home)))
        self._command, self._memory = int(command), int(memory)
        declared = {
            "position_gain": (1.0, "1/s"),
            "orientation_gain": (1.0, "1/s"),
            "speed": (0.12, "m/s"),
            "turn_rate": (0.25, "rad/s"),
            "joint_rate": (0.4, "rad/s"),
            "posture_gain": (0.3, "1/s"),
            "damping": (0.05, "1"),
            "lead": (0.2, "rad"),
            "brake_time": (1.5, "s"),
            "finger_rate": (0.03, "m/s"),
            "back_off": (4.0, "s"),
            "back_off_speed": (0.08, "m/s"),
        }
        self.DeclareNumericParameter(BasicVector([value for value, _ in declared.values()]))
        self.variables = (
            discrete_state("joint_position", self._command, shape=(len(JOINT_NAMES),), unit="rad, m"),
            discrete_state("joint_rate_command", self._memory, shape=(ARM_JOINTS,), unit="rad/s"),
            discrete_state("aborted_for", self._memory, start=ARM_JOINTS, unit="s"),
            discrete_state(
                "measured_position", self._memory, start=ARM_JOINTS + 1, shape=(len(JOINT_NAMES),), unit="rad, m"
            ),
            *(
                parameter(name, 0, start=k, unit=unit, bounds=(0.0, inf))
                for k, (name, (_, unit)) in enumerate(declared.items())
            ),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        T = self._period
        p = context.get_numeric_parameter(0).value()
        k_p, k_R, speed, turn, limit, posture, damping, lead, brake, finger_rate, back_off, back_speed = p.tolist()
        guidance = Guidance.of(self._guidance.Eval(context))
        relative, measured = Relative.of(self._relative.Eval(context)), self._joints.Eval(context)
        command, memory = context.get_discrete_state(self._command).value(), context.get_discrete_state(1).value()
        q, rates, aborted = measured[:ARM_JOINTS], memory[:ARM_JOINTS], memory[ARM_JOINTS]
        mode = guidance.mode
        if mode == ABORT and measured[ARM_JOINTS:].min() > _OPEN * guidance.opening:
            aborted += T
            if aborted < back_off:
                away = np.concatenate((np.zeros(3), -back_speed * relative.R_BG[:, 2]))
                rates = self._rates.value((q, away, [0.0, damping])).copy()
            else:
                rates = np.clip(self._stowed - command[:ARM_JOINTS], -0.5 * limit, 0.5 * limit)
        elif guidance.follows:
            twist = self._twist(relative, guidance, k_p, k_R, speed, turn)
            rates = self._rates.value((q, twist, [posture, damping])).copy()
        elif mode in (RETREAT, HOLD, ABORT):
            rates = rates * np.exp(-T / max(brake, T))
        else:
            rates = np.zeros(ARM_JOINTS)
        rates *= min(1.0, limit / max(float(np.abs(rates).max()), 1e-9))
        following = np.clip(command[:ARM_JOINTS] + T * rates, q - lead, q + lead)
        following = np.clip(following, self._lower, self._upper)
        fingers = command[ARM_JOINTS:]
        fingers = fingers + np.clip(guidance.opening - fingers, -T * finger_rate, T * finger_rate)
        state.set_value(self._command, np.concatenate((following, fingers)))
        state.set_value(self._memory, np.concatenate((rates, (aborted,), measured)))

    @staticmethod
    def _twist(relative: Relative, guidance: Guidance, k_p: float, k_R: float, speed: float, turn: float) -> Array:
        """Return V_BG as it should be, [angular; linear] in B."""
        axis = relative.R_BH[:, 2]
        offset = -guidance.distance * axis
        R_BD = guidance.turned(relative.R_BH)
        e_p = relative.p_BH + offset - relative.p_BG
        e_R = rotation_vector(R_BD @ relative.R_BG.T)
        v_BD = relative.v_BH + cross_matrix(relative.w_BH) @ offset - guidance.rate * axis
        return np.concatenate((relative.w_BH + _limited(k_R * e_R, turn), v_BD + _limited(k_p * e_p, speed)))


def _limited(vector: Array, length: float) -> Array:
    norm = float(np.linalg.norm(vector))
    return vector if norm <= length else vector * (length / norm)
