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
from vtbdrake.components.compiled_plant.contact import Contacts, FixedPiece, PointContact, contact_pairs
from vtbdrake.components.compiled_plant.ground import SLOTS, Terrain
from vtbdrake.components.compiled_plant.sap import Drive, SapSolver, stops
from vtbdrake.state.multibody import POSE_ENTRIES, bodies, element_address, multibody_variables
from vtbdrake.state.variables import A, Variable

# What may act on a plant beside its actuation.
_ACTING = ("applied_generalized_force", "applied_spatial_force")
_NOT_ACTING = ("geometry_query",)
# The names of ports end so that the plant and its model instances have.
_TAKEN = ("actuation", "_desired_state")
# The names of output ports end so whose values belong to a step.
_OF_A_STEP = ("reaction_forces", "contact_results", "net_actuation")

TERRAIN = "terrain"
"""The name of the constant of a plant with ground that tells on which terrain it is, see `PlantEquations.terrain`."""

# The name of the present step, which several outputs share with the update.
_STEP = "step"
# Iterations take the same path as Drake's: with stops and drives, whose problem is linear in pieces, up to rounding.
_AGREEMENT_OF_SOLVER = 1e-10
# With contact, rounding grows on the path where the problem is nearly degenerate.
_AGREEMENT_IN_CONTACT = 1e-5
# The portals in which MPR ends differ with rounding, by 1e-7 m of depth and at a shallow depth by 1e-3 of the normal.
_AGREEMENT_OF_ITERATED_PAIRS = 1e-3


class _Step(NamedTuple):
    """One step of the plant, in terms of the model's inputs.

    Attributes:
        q: Positions before it.
        v: Velocities before it.
        vdot: The accelerations.
        v_next: Velocities after it.
        forces: The contact forces, see `SapSolver.step`.
        efforts: The actuation of the drives.
        doubt: Positive where the solver has not converged.
        contacts: The contacts of the step; None without a solver.
    """

    q: Expression
    v: Expression
    vdot: Expression
    v_next: Expression
    forces: Expression
    efforts: Expression
    doubt: Expression
    contacts: Contacts | None


class PlantEquations(Equations):
    """A discrete plant that SAP steps, with point contact, joint stops and PD controllers of actuators.

    The state, and a step's reaction forces, contact forces and net actuation are output. Without a C compiler, a step
    that feels a stop counts as doubtful.
    """

    doubtful = "the solver of contact, stops and controllers did not converge"

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
            self._model = PlantDynamics(system, bare, inputs=sorted(varied & self._inputs.keys()), controllers=True)
        with _noted(reasons):
            pairs = contact_pairs(system, context)
            self._has_contact = bool(pairs)
        if reasons:
            raise refusal(system, f"is refused: {'; '.join(reasons)}")
        try:
            self._contact = PointContact(system, self._model, pairs)
        except CompilerError as error:
            raise refusal(system, f"has contact, which is written in C: {error}") from None
        if self._contact.grounds:
            self.constants[TERRAIN] = 0.0
            self.doubtful += f", or a sphere touches more than {SLOTS} pieces of ground"
        self._drives = _drives(system, context)
        self._solver = self._new_solver()
        self.timing = Timing(system.time_step(), unrestricted=system.has_sampled_output_ports())
        self.extras = {address: self._inputs[address] for address in self._model.inputs}

    def _new_solver(self) -> SapSolver | None:
        """Return the solver, or None if the plant has nothing that needs it, or stops alone but no C compiler."""
        pairs, drives = self._has_contact, self._drives
        if not (pairs or drives or stops(self._plant)):
            return None
        try:
            solver = SapSolver(self._plant, self._model, self._contact, list(drives.values()))
        except CompilerError as error:
            if pairs or drives:
                part = "contact" if pairs else "PD controllers of actuators"
                raise refusal(self._plant, f"has {part}, whose solver is written in C: {error}") from None
            self.doubtful = "a joint reaches a stop, which is compiled only where there is a C compiler"
            return None
        self.agreement = _AGREEMENT_OF_SOLVER
        if pairs:
            self.agreement = _AGREEMENT_OF_ITERATED_PAIRS if self._contact.is_iterated() else _AGREEMENT_IN_CONTACT
        return solver

    def terrain(self, pieces: Sequence[FixedPiece]) -> Terrain:
        """Return another terrain than the one that is compiled in, see `PointContact.terrain`; `TERRAIN` names it.

        Args:
            pieces: Its pieces.
        """
        return self._contact.terrain(pieces)

    def output(self, port: str, at: At) -> Expression:
        x = at.state(0)
        if port == "state":
            return x
        for instance in _instances(self._plant):
            if port == f"{self._plant.GetModelInstanceName(instance)}_state":
                return _part_of_state(self._plant, instance, x)
        if port.endswith(_OF_A_STEP) and self._plant.has_sampled_output_ports():
            raise refusal(
                self._plant,
                f"has the output port {port}, which shows its last step and is not compiled: set "
                "use_sampled_output_ports to False, use its state, or keep it in Drake",
            )
        if port == "reaction_forces":
            return self._reactions(at)
        if port == "contact_results":
            return self._contact_load(at)
        if port.endswith("net_actuation"):
            return self._net_actuation(port, at)
        if port == "body_poses":
            return lambda body: self._of_body(body, at)[0]
        if port == "body_spatial_velocities":
            return lambda body: self._of_body(body, at)[1]
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

    def _of_body(self, body: int, at: At) -> tuple[tuple[Expression, Expression], Expression]:
        """Return the pose (R, p) and the velocity [angular; linear] of a body in the world, by its index."""
        q, v = casadi.vertsplit(at.state(0), [0, self._model.nq, self._model.nq + self._model.nv])
        motion = self._model.body_motion(body, q)
        R, p, V = self._substituted([motion.R, motion.p, casadi.densify(motion.J @ v)], at)
        return (R, p), V

    def _reactions(self, at: At) -> Callable[[int], Expression]:
        """Return the reaction forces of the present step, by the place of the joint among the plant's joints."""
        plant, step = self._plant, self._step(at)
        reaction = self._model.reactions(step.q, step.v, step.vdot, [*self._applied(at), *self._touching(step)])

        def at_place(place: int) -> Expression:
            (F,) = self._substituted([casadi.densify(reaction(plant.get_joint(plant.GetJointIndices()[place])))], at)
            return F

        return at_place

    def _contact_load(self, at: At) -> Callable[[int], Expression]:
        """Return the sum of the magnitudes of the present step's contact forces on a body, by its index, in N."""
        step = self._step(at)

        def on_body(body: int) -> Expression:
            forces = self._forces_on(body, step)
            (load,) = self._substituted([casadi.SX(sum(casadi.norm_2(force) for _, force in forces))], at)
            return load

        return on_body

    def _net_actuation(self, port: str, at: At) -> Expression:
        """Return the actuation within effort limits of the present step: the plant's, or a model instance's."""
        u = self._model.limited(self._actuation(at))
        u[[drive.u for drive in self._drives.values()]] = self._step(at).efforts
        (u,) = self._substituted([u], at)
        for instance in _instances(self._plant):
            if port == f"{self._plant.GetModelInstanceName(instance)}_net_actuation":
                indices = self._plant.GetJointActuatorIndices(instance)
                return u[[self._plant.get_joint_actuator(index).input_start() for index in indices]]
        return u

    def _step(self, at: At) -> _Step:
        """Return the present step, in terms of the model's inputs."""
        return at.shared(_STEP, lambda: self._new_step(at))

    def _new_step(self, at: At) -> _Step:
        model, period = self._model, self._plant.time_step()
        # Columns, also of a plant without positions.
        q, v = casadi.vertsplit(at.state(0), [0, model.nq, model.nq + model.nv])
        u = self._actuation(at)
        tau = self._torque(at, u)
        if self._solver is None:
            vdot = model.acceleration(q, v, tau, period=period)
            v_next = v + period * vdot
            overrun = casadi.SX(model.overrun(q, v_next, period))
            return _Step(q, v, vdot, v_next, casadi.SX(3, 0), casadi.SX(0, 1), overrun, None)
        places = [drive.u for drive in self._drives.values()]
        terrain = at.constant(TERRAIN) if self.constants else 0.0
        solution = self._solver.step(q, v, tau, desired=self._desired(at), feed_forward=u[places], terrain=terrain)
        return _Step(q, v, (solution.v_next - v) / period, *solution)

    def update(self, at: At) -> dict[int, Expression]:
        step = self._step(at)
        q_next = step.q + self._plant.time_step() * self._model.qdot(step.q, step.v_next)
        (x_next,) = self._substituted([casadi.densify(casadi.vertcat(q_next, step.v_next))], at)
        return {0: x_next}

    def doubt(self, at: At) -> Expression | None:
        """Return a positive number if the present step counts and its solver does not converge.

        Without a solver, it is the overrun of the joints' stops.
        """
        if not at.is_shared(_STEP):
            return None
        (doubt,) = self._substituted([self._step(at).doubt], at)
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
        for body in bodies(self._plant):
            R, p = self._model.pose(body, step.q)
            for point, force in self._forces_on(int(body.index()), step):
                yield AppliedForce(int(body.index()), R.T @ (point - p), casadi.vertcat(casadi.SX(3, 1), force))

    def _forces_on(self, body: int, step: _Step) -> Iterator[tuple[Expression, Expression]]:
        """Return the contact forces on a body, by its index: where they act, and what they are."""
        return iter(()) if step.contacts is None else self._contact.forces_on(body, step.forces, step.contacts)

    def _torque(self, at: At, u: Expression) -> Expression:
        """Return the generalized force of everything that is connected to the plant, without what the drives make."""
        tau = self._model.actuation(u)
        if at.is_connected("applied_generalized_force"):
            tau += at.input("applied_generalized_force")
        tau += self._model.generalized(at.state(0)[: self._model.nq], self._applied(at))
        for i in range(self._plant.num_input_ports()):
            name = self._plant.get_input_port(i).get_name()
            if at.is_connected(name) and not (name.endswith(_TAKEN) or name in (*_ACTING, *_NOT_ACTING)):
                raise refusal(self._plant, f"has the input port {name} connected, which is not compiled")
        return tau

    def _desired(self, at: At) -> Expression:
        """Return the desired positions and velocities of the drives, shape (m, 2)."""
        rows = []
        for port, number in self._drives:
            states = at.input(port)
            rows.append(casadi.horzcat(states[number], states[states.numel() // 2 + number]))
        return casadi.vertcat(casadi.SX(0, 2), *rows)

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


def _drives(plant: MultibodyPlant, context: Context) -> dict[tuple[str, int], Drive]:
    """Return the actuators with a controller that has a desired state, by input port, and place among its actuators."""
    drives = {}
    for instance in _instances(plant):
        port = f"{plant.GetModelInstanceName(instance)}_desired_state"
        actuators = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices(instance)]
        if actuators and plant.GetInputPort(port).HasValue(context):
            for number, actuator in enumerate(actuators):
                if actuator.has_controller():
                    drives[port, number] = Drive.of(actuator)
    return drives


def _instances(plant: MultibodyPlant) -> Iterator[ModelInstanceIndex]:
    return (ModelInstanceIndex(i) for i in range(plant.num_model_instances()))


def _part_of_state(plant: MultibodyPlant, instance: ModelInstanceIndex, x: Expression) -> Expression:
    nq, nv = plant.num_positions(), plant.num_velocities()
    q = plant.GetPositionsFromArray(instance, np.arange(nq, dtype=float)).astype(int).tolist()
    v = plant.GetVelocitiesFromArray(instance, np.arange(nv, dtype=float)).astype(int).tolist()
    return casadi.vertcat(x[q], x[[nq + i for i in v]])
