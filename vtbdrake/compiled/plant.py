"""The equations of a discrete MultibodyPlant."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import casadi
import numpy as np
from pydrake.multibody.plant import DiscreteContactSolver, ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context

from vtbdrake.compiled.equations import At, Equations, Expression, Timing, refusal, zeros
from vtbdrake.components.casadi_system.compiler import CompilerError
from vtbdrake.components.casadi_system.rotations import roll_pitch_yaw_angles
from vtbdrake.components.compiled_plant import AppliedForce, PlantDynamics, UnsupportedPlantError
from vtbdrake.components.compiled_plant.contact import PointContact, contact_pairs
from vtbdrake.state.multibody import POSE_ENTRIES, bodies, element_address, multibody_variables
from vtbdrake.state.variables import A, Variable

# What may act on a plant beside its actuation.
_ACTING = ("applied_generalized_force", "applied_spatial_force")
_NOT_ACTING = ("geometry_query",)

# The name of the present step, which several outputs share with the update.
_STEP = "step"
# Drake ends its iteration at an error of 1e-6 of the momentum, in which some velocities weigh little.
_AGREEMENT_IN_CONTACT = 1e-4


class _Step(NamedTuple):
    """One step of the plant, in terms of the model's inputs.

    Attributes:
        q: Positions before it.
        v: Velocities before it.
        vdot: The accelerations.
        v_next: Velocities after it.
        forces: The contact forces, see `PointContact.step`; None without contact.
        doubt: Positive where contact has not converged.
    """

    q: Expression
    v: Expression
    vdot: Expression
    v_next: Expression
    forces: Expression | None
    doubt: Expression


class PlantEquations(Equations):
    """A discrete plant that SAP steps, with point contact, and with its ports of state and reaction forces."""

    def __init__(self, system: MultibodyPlant, context: Context, varied: frozenset[str]) -> None:
        super().__init__(system, context, varied)
        if system.time_step() <= 0.0:
            raise refusal(system, "is continuous: give it a time_step")
        if system.get_discrete_contact_solver() != DiscreteContactSolver.kSap:
            raise refusal(system, "uses the solver TAMSI: set discrete_contact_approximation to 'sap'")
        self._plant = system
        # Without connections: what is connected is read from the Diagram.
        bare = system.CreateDefaultContext()
        bare.SetTimeStateAndParametersFrom(context)
        self._inputs = {v.address: int(np.prod(v.shape)) for v in _inputs(system)}
        reasons: list[str] = []
        with _noted(reasons):
            self._model = PlantDynamics(system, bare, inputs=sorted(varied & self._inputs.keys()))
        with _noted(reasons):
            pairs = contact_pairs(system, context)
        if reasons:
            raise refusal(system, f"is refused: {'; '.join(reasons)}")
        self._contact: PointContact | None = None
        if pairs:
            self.agreement = _AGREEMENT_IN_CONTACT
            try:
                self._contact = PointContact(system, self._model, pairs)
            except CompilerError as error:
                raise refusal(system, f"has contact, whose solver is written in C: {error}") from None
        self.timing = Timing(system.time_step(), unrestricted=system.has_sampled_output_ports())
        self.extras = {address: self._inputs[address] for address in self._model.inputs}

    def output(self, port: str, at: At) -> Expression:
        x = at.state(0)
        if port == "state":
            return x
        for instance in _instances(self._plant):
            if port == f"{self._plant.GetModelInstanceName(instance)}_state":
                return _part_of_state(self._plant, instance, x)
        if port == "reaction_forces" and not self._plant.has_sampled_output_ports():
            return self._reactions(at)
        raise refusal(
            self._plant, f"has the output port {port}, which is not compiled: use its state, or keep it in Drake"
        )

    def derived(self, name: str, at: At) -> Expression | None:
        address, _, entry = name.rpartition(".")
        addressed = {element_address(self._plant, body): body for body in bodies(self._plant)}
        body = addressed.get(address)
        if body is None or entry not in POSE_ENTRIES:
            return None
        R, p = self._model.pose(body, at.state(0)[: self._model.nq])
        pose = casadi.vertcat(p, roll_pitch_yaw_angles(R))
        (value,) = self._substituted([pose[list(POSE_ENTRIES).index(entry)]], at)
        return value

    def _reactions(self, at: At) -> Callable[[int], Expression]:
        """Return the reaction forces of the present step, by the place of the joint among the plant's joints."""
        plant, step = self._plant, self._step(at)
        reaction = self._model.reactions(step.q, step.v, step.vdot, [*self._applied(at), *self._touching(step)])

        def at_place(place: int) -> Expression:
            (F,) = self._substituted([casadi.densify(reaction(plant.get_joint(plant.GetJointIndices()[place])))], at)
            return F

        return at_place

    def _step(self, at: At) -> _Step:
        """Return the present step, in terms of the model's inputs."""
        return at.shared(_STEP, lambda: self._new_step(at))

    def _new_step(self, at: At) -> _Step:
        model, period = self._model, self._plant.time_step()
        # Columns, also of a plant without positions.
        q, v = casadi.vertsplit(at.state(0), [0, model.nq, model.nq + model.nv])
        tau = self._torque(at)
        if self._contact is None:
            vdot = model.acceleration(q, v, tau, period=period)
            return _Step(q, v, vdot, v + period * vdot, None, casadi.SX(-1))
        v_next, forces, doubt = self._contact.step(q, v, tau)
        return _Step(q, v, (v_next - v) / period, v_next, forces, doubt)

    def update(self, at: At) -> dict[int, Expression]:
        step = self._step(at)
        q_next = step.q + self._plant.time_step() * self._model.qdot(step.q, step.v_next)
        (x_next,) = self._substituted([casadi.densify(casadi.vertcat(q_next, step.v_next))], at)
        return {0: x_next}

    def doubt(self, at: At) -> Expression | None:
        """Return a positive number if the present step counts and its contact does not converge, or a stop is felt.

        Joints' stops are not compiled: it is the overrun.
        """
        if not at.is_shared(_STEP):
            return None
        step = self._step(at)
        overrun = self._model.overrun(step.q, step.v_next, self._plant.time_step())
        (doubt,) = self._substituted([casadi.SX(casadi.fmax(overrun, step.doubt))], at)
        return doubt

    def compiled_in(self, context: Context) -> bytes:
        groups = (context.get_numeric_parameter(i).value() for i in range(context.num_numeric_parameter_groups()))
        joints = (self._plant.get_joint(index) for index in self._plant.GetJointIndices())
        return np.concatenate([*groups, [joint.is_locked(context) for joint in joints]]).tobytes()

    def refused(self, name: str) -> str:
        if name in self._inputs:
            return "it is compiled in: name it in parameters="
        return "it is no input of a compiled plant"

    def _substituted(self, results: Sequence[Expression], at: At) -> list[Expression]:
        return self._model.substituted(results, {address: at.extra(address) for address in self.extras})

    def _applied(self, at: At) -> list[AppliedForce]:
        """Return the forces in the world that act on bodies."""
        port = "applied_spatial_force"
        return [_force(force) for force in at.input(port)] if at.is_connected(port) else []

    def _touching(self, step: _Step) -> Iterator[AppliedForce]:
        """Yield the contact forces on bodies."""
        if self._contact is not None:
            for body in bodies(self._plant):
                R, p = self._model.pose(body, step.q)
                for point, force in self._contact.forces_on(int(body.index()), step.forces, step.q):
                    yield AppliedForce(int(body.index()), R.T @ (point - p), casadi.vertcat(casadi.SX(3, 1), force))

    def _torque(self, at: At) -> Expression:
        """Return the generalized force of everything that is connected to the plant."""
        tau = self._model.actuation(self._actuation(at))
        if at.is_connected("applied_generalized_force"):
            tau += at.input("applied_generalized_force")
        tau += self._model.generalized(at.state(0)[: self._model.nq], self._applied(at))
        for i in range(self._plant.num_input_ports()):
            name = self._plant.get_input_port(i).get_name()
            if at.is_connected(name) and not (name.endswith("actuation") or name in (*_ACTING, *_NOT_ACTING)):
                raise refusal(self._plant, f"has the input port {name} connected, which is not compiled")
        return tau

    def _actuation(self, at: At) -> Expression:
        """Return the actuation: the ports of the plant and of its model instances add up."""
        u = casadi.SX(at.input("actuation")) if at.is_connected("actuation") else zeros(self._model.nu)
        for instance in _instances(self._plant):
            port = f"{self._plant.GetModelInstanceName(instance)}_actuation"
            indices = self._plant.GetJointActuatorIndices(instance)
            if len(indices) and at.is_connected(port):
                starts = [self._plant.get_joint_actuator(index).input_start() for index in indices]
                u[starts] += at.input(port)
        return u


@contextmanager
def _noted(reasons: list[str]) -> Iterator[None]:
    """Add the reason of a refusal to the others."""
    try:
        yield
    except (UnsupportedPlantError, ValueError) as error:
        reasons.append(str(error))


def _force(force: AppliedForce | ExternallyAppliedSpatialForce) -> AppliedForce:
    if isinstance(force, AppliedForce):
        return force
    F_Bq_W = force.F_Bq_W.get_coeffs()
    return AppliedForce(int(force.body_index), casadi.DM(force.p_BoBq_B), casadi.DM(F_Bq_W))


def _inputs(plant: MultibodyPlant) -> Iterator[Variable]:
    """Yield the variables of a plant that can be inputs of its compiled step, with their addresses within it."""
    for variable in multibody_variables(plant):
        if variable.kind == A and not variable.hidden:
            yield variable


def _instances(plant: MultibodyPlant) -> Iterator[ModelInstanceIndex]:
    return (ModelInstanceIndex(i) for i in range(plant.num_model_instances()))


def _part_of_state(plant: MultibodyPlant, instance: ModelInstanceIndex, x: Expression) -> Expression:
    nq, nv = plant.num_positions(), plant.num_velocities()
    q = plant.GetPositionsFromArray(instance, np.arange(nq, dtype=float)).astype(int).tolist()
    v = plant.GetVelocitiesFromArray(instance, np.arange(nv, dtype=float)).astype(int).tolist()
    return casadi.vertcat(x[q], x[[nq + i for i in v]])
