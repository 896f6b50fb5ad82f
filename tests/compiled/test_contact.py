"""Compiled contact: against Drake's steps, against the laws of contact written again, and along rollouts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi
import numpy as np
import pytest
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddRigidHydroelasticProperties,
    Box,
    Capsule,
    Convex,
    Cylinder,
    HalfSpace,
    Mesh,
    ProximityProperties,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from tests.compiled.contact_agreement import outcome_shares, step_errors
from tests.compiled.contact_worlds import WORLDS
from tests.compiled.quadruped import HEIGHT, LEGS, POSTURE, inertia, quadruped, surface
from vtbdrake.compiled import CompiledRollouts, UnsupportedTestbedError
from vtbdrake.components.compiled_plant import PlantDynamics
from vtbdrake.components.compiled_plant.contact import PointContact, contact_pairs
from vtbdrake.components.compiled_plant.sap import Drive, SapSolver, stops
from vtbdrake.state.systems import collect
from vtbdrake_diagrams.manipulator import ManipulatorScenario

APPROXIMATIONS = ("sap", "lagged")


@dataclass
class Steps:
    """Single steps of a plant with contact, of Drake and compiled.

    The impulses at given velocities are computed by `impulse`, which is written after Drake's documentation, and knows
    nothing of the kernel in C.
    """

    diagram: Diagram
    plant: MultibodyPlant
    is_lagged: bool

    def __post_init__(self) -> None:
        plant = self.plant
        self.root = self.diagram.CreateDefaultContext()
        self.context: Context = plant.GetMyMutableContextFromRoot(self.root)
        model = PlantDynamics(plant, plant.CreateDefaultContext(), controllers=True)
        self.contact = PointContact(plant, model, contact_pairs(plant, self.context))
        drives = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
        self.drives = [Drive.of(actuator) for actuator in drives if actuator.has_controller()]
        solver = SapSolver(plant, model, self.contact, self.drives)
        q, v, u = model.symbols()
        tau = model.actuation(u)
        step = solver.step(q, v, tau, desired=self._desired(), feed_forward=u if self.drives else None)
        contacts = self.contact.contacts(q)
        jacobians = [
            model.point_jacobian(pair.second.body, contacts.points[:, i], q)
            - model.point_jacobian(pair.first.body, contacts.points[:, i], q)
            for i, pair in enumerate(self.contact.pairs)
        ]
        balance = model.momentum_balance(q, v, tau, plant.time_step())
        parts = [
            *balance,
            casadi.vertcat(*jacobians),
            contacts.normals,
            contacts.distances,
        ]
        options = {"cse": True}
        self._step = casadi.Function("step", [q, v, u], [casadi.densify(part) for part in step[:4]], options)
        self._parts = casadi.Function("parts", [q, v, u], [casadi.densify(part) for part in parts], options)

    def randomize(self, random: np.random.Generator) -> None:
        plant = self.plant
        for index in plant.GetFloatingBaseBodies():
            body = plant.get_body(index)
            low, high = ([0, 0, 0.2], [0, 0, 0.4]) if body.name() == "trunk" else ([-0.4, -0.3, 0.0], [0.5, 0.3, 0.2])
            turned = RollPitchYaw(0.3 * random.standard_normal(3))
            plant.SetFreeBodyPose(self.context, body, RigidTransform(turned, random.uniform(low, high)))
        for kind, angle in POSTURE.items():
            for leg in range(len(LEGS)):
                joint = plant.GetJointByName(f"{kind}_{leg}")
                joint.set_angle(self.context, angle + 0.4 * random.standard_normal())
        speed = random.choice([0.01, 1.0, 3.0])
        plant.SetVelocities(self.context, speed * random.standard_normal(plant.num_velocities()))

    def put(self, name: str, pose: RigidTransform, depth: float) -> None:
        """Set the pose of a body whose only contact is with the world, moved along the normal until it is that deep."""
        body = self.plant.GetBodyByName(name)
        into_other = 1.0 if self.contact.pairs[0].first.body == int(body.index()) else -1.0
        for _ in range(4):
            self.plant.SetFreeBodyPose(self.context, body, pose)
            _, _, _, normals, distances = self._parts(*self._arguments())
            shift = into_other * (float(distances[0]) + depth) * normals.full()[:, 0]
            pose = RigidTransform(pose.rotation(), pose.translation() + shift)
        self.plant.SetFreeBodyPose(self.context, body, pose)

    def drake(self) -> np.ndarray:
        """Return the velocities after Drake's step."""
        state = self.plant.get_state_output_port().Eval(self.context)
        following = self.plant.EvalUniquePeriodicDiscreteUpdate(self.context).value()
        assert following.size == state.size
        return np.array(following[self.plant.num_positions() :])

    def compiled(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the velocities after the compiled step, the contact forces, and the doubt."""
        v, forces, _, doubt = self._step(*self._arguments())
        return v.full().ravel(), forces.full().T, float(doubt)

    def efforts(self) -> np.ndarray:
        """Return the actuation of the drives in the compiled step."""
        return np.array(self._step(*self._arguments())[2]).ravel()

    def _desired(self) -> np.ndarray:
        """Return the desired positions and velocities, shape (nu, 2)."""
        port = self.plant.GetInputPort("DefaultModelInstance_desired_state")
        return port.Eval(self.context).reshape(2, -1).T if self.drives else np.zeros((0, 2))

    def residual(self, v: np.ndarray) -> float:
        """Return how far velocities are from a solution, relative to the momentum, as Drake measures it."""
        q, v0, u = self._arguments()
        A, p_star, J, normals, distances = (part.full() for part in self._parts(q, v0, u))
        scale, impulses = 1.0 / np.sqrt(np.diag(A)), np.zeros(v.size)
        for i, pair in enumerate(self.contact.pairs):
            if distances[i, 0] < 0.0:
                J_i = J[3 * i : 3 * i + 3]
                estimate = np.linalg.norm(J_i @ np.diag(scale**2) @ J_i.T) / 3.0
                material = pair.material(is_lagged=self.is_lagged)
                law = lagged_impulse if self.is_lagged else sap_impulse
                frame = normals[:, i], distances[i, 0], estimate, self.plant.time_step()
                impulses += J_i.T @ law(J_i @ v, J_i @ v0, *frame, *material)
        dt, v_star = self.plant.time_step(), np.linalg.solve(A, p_star).ravel()
        for stop in stops(self.plant):
            speed = max(abs(v0[stop.v]), abs(v_star[stop.v]))
            impulses[stop.v] += stop_impulse(v[stop.v], q[stop.q], speed, scale[stop.v] ** 2, dt, stop)
        for drive, (q_d, v_d), u_ff in zip(self.drives, self._desired(), u, strict=False):
            errors = q[drive.q] - q_d, v[drive.v] - v_d
            impulses[drive.v] += drive_impulse(v[drive.v], *errors, u_ff, scale[drive.v] ** 2, dt, drive)
        momentum = max(np.linalg.norm(scale * (A @ v)), np.linalg.norm(scale * impulses))
        return float(np.linalg.norm(scale * (A @ v - p_star.ravel() - impulses)) / momentum)

    def _arguments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        plant, context = self.plant, self.context
        u = plant.get_actuation_input_port().Eval(context)
        return plant.GetPositions(context), plant.GetVelocities(context), u


def sap_impulse(v_c, v_c0, n, distance, w, dt, stiffness, relaxation, friction):
    """Return the impulse of SAP's regularized friction (Castro, Permenter, Han 2022, eq. 17 to 22), in the world."""
    R_n = max(w / (4.0 * np.pi**2), 1.0 / (dt * stiffness * (dt + relaxation)))
    R_t = 1e-3 * w
    v_n = n @ v_c
    y_n = (-distance / (dt + relaxation) - v_n) / R_n
    y_t = -(v_c - v_n * n) / R_t
    y_r = np.linalg.norm(y_t)
    hat = friction * R_t / R_n
    if y_r <= friction * y_n:
        return y_n * n + y_t
    if y_n <= -hat * y_r:
        return np.zeros(3)
    g_n = (y_n + hat * y_r) / (1.0 + friction * hat)
    return g_n * (n + friction * y_t / y_r)


def lagged_impulse(v_c, v_c0, n, distance, w, dt, stiffness, dissipation, friction):
    """Return the impulse of Hunt and Crossley, with friction under the normal force before the step, in the world."""
    v_n = n @ v_c
    elastic = -stiffness * (distance + dt * v_n)
    g_n = dt * max(elastic, 0.0) * max(1.0 - dissipation * v_n, 0.0)
    before = -dt * stiffness * distance * max(1.0 - dissipation * (n @ v_c0), 0.0)
    slip = v_c - v_n * n
    return g_n * n - friction * before * slip / np.hypot(np.linalg.norm(slip), max(1e-4, friction * 1e-3 * w * before))


def stop_impulse(v, q, speed, w, dt, stop):
    """Return the impulse of Drake's SapLimitConstraint on a velocity, where the stop is within reach of a step."""
    total = 0.0
    for sign, distance in ((1.0, q - stop.lower), (-1.0, stop.upper - q)):
        if distance <= 2.0 * dt * speed:
            R = max(0.1**2 / (4.0 * np.pi**2) * w, 1.0 / (dt * 1e12 * 2.0 * dt))
            total += sign * max(0.0, (-distance / (2.0 * dt) - sign * v) / R)
    return total


def drive_impulse(v, q_error, v_error, u_ff, w, dt, drive):
    """Return the impulse of Drake's SapPdControllerConstraint, with its gains in the near-rigid regime."""
    p, d, R_near = drive.p, drive.d, 0.1**2 / (4.0 * np.pi**2) * w
    if 1.0 / (dt * (dt * p + d)) < R_near:
        p, d = p / (dt * (dt * p + d) * R_near), d / (dt * (dt * p + d) * R_near)
    return dt * np.clip(-p * (q_error + dt * v) - d * v_error + u_ff, -drive.effort_limit, drive.effort_limit)


@lru_cache
def steps_of(approximation: str, *, driven: bool = False) -> Steps:
    diagram, plant = quadruped(approximation, playground=True, stops=driven, drives=driven)
    return Steps(diagram, plant, approximation == "lagged")


@pytest.mark.slow_cases
@pytest.mark.parametrize("driven", [True, False], ids=["stops and drives", ""])
@pytest.mark.parametrize("approximation", APPROXIMATIONS)
def test_steps_are_drakes_on_a_playground(approximation: str, driven: bool) -> None:
    """Contact, joint stops, and PD controllers, some at their effort limits, some stiffer than a step resolves."""
    steps, random = steps_of(approximation, driven=driven), np.random.default_rng(0)
    touching = 0
    for _ in range(100):
        steps.randomize(random)
        expected = steps.drake()
        v, forces, doubt = steps.compiled()
        assert doubt == 0.0
        touching += np.count_nonzero(np.any(forces, axis=1))
        # The same problem, solved to 1e-6, where the iteration ends as in Drake.
        assert steps.residual(expected) < 1.1e-6
        assert steps.residual(v) < 1.1e-6
        np.testing.assert_allclose(v, expected, atol=1e-10 * max(1.0, np.abs(expected).max()))
        if driven:
            efforts = steps.plant.get_net_actuation_output_port().Eval(steps.context)
            np.testing.assert_allclose(steps.efforts(), efforts, atol=1e-7)
    assert touching > 200


@pytest.mark.parametrize("approximation", APPROXIMATIONS)
def test_forces_balance_the_momentum(approximation: str) -> None:
    """The forces that are returned change the momentum of a ball that nothing else touches as Newton says."""
    diagram, plant = ball_on(HalfSpace(), approximation)
    steps = Steps(diagram, plant, approximation == "lagged")
    ball = plant.GetBodyByName("ball")
    for height, v in ((0.0995, [0.3, -0.2, -0.1]), (0.098, [2.0, 0.0, -0.05]), (0.2, [0.0, 1.0, 0.0])):
        plant.SetFreeBodyPose(steps.context, ball, RigidTransform([0.0, 0.0, height]))
        plant.SetVelocities(steps.context, [0.1, 0.2, 0.3, *v])
        after, forces, _ = steps.compiled()
        # The sphere is the ball's; the forces are those on the ground.
        change = plant.time_step() * (np.array([0.0, 0.0, -9.81]) - forces.sum(axis=0) / 1.0)
        np.testing.assert_allclose(after[3:] - v, change, atol=1e-7)
        assert np.any(forces) == (height < 0.1)


@pytest.mark.parametrize("approximation", APPROXIMATIONS)
def test_rollouts_are_drakes(approximation: str) -> None:
    diagram, plant = quadruped(approximation)
    context = diagram.CreateDefaultContext()
    rollouts = CompiledRollouts(
        diagram, collect(diagram), context, horizon=1.0, sample_period=0.25, parameters=["plant.trunk.mass"]
    )
    batch = rollouts({"plant.trunk.mass": np.array([6.0, 7.5])})
    assert batch.valid.all()
    for mass, final in zip((6.0, 7.5), batch.final, strict=True):
        simulator = Simulator(diagram, context.Clone())
        own = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        trunk = plant.GetBodyByName("trunk")
        trunk.SetSpatialInertiaInBodyFrame(own, inertia(mass, 0.0, tuple(mass / 6.0 * np.array([0.02, 0.06, 0.07]))))
        simulator.AdvanceTo(1.0)
        expected = plant.GetPositionsAndVelocities(plant.GetMyContextFromRoot(simulator.get_context()))
        np.testing.assert_allclose(final[: expected.size], expected, atol=1e-6)
        assert 0.2 < expected[6] < HEIGHT  # It stands on its feet.


def ball_on(
    shape: Shape, approximation: str = "sap", *, contact_model: str = "point", of_ball: Shape | None = None
) -> tuple[Diagram, MultibodyPlant]:
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=0.002,
        contact_model=contact_model,
        discrete_contact_approximation=approximation,
        use_sampled_output_ports=False,
    )
    plant, _ = AddMultibodyPlant(config, builder)
    material: ProximityProperties = surface(0.5)
    ground: ProximityProperties = surface(0.5)
    if contact_model != "point":
        AddRigidHydroelasticProperties(ground)
        AddCompliantHydroelasticProperties(0.05, 1e7, material)
    ball = plant.AddRigidBody("ball", inertia(1.0, 0.0, (0.004, 0.004, 0.004)))
    plant.RegisterCollisionGeometry(ball, RigidTransform(), of_ball or Sphere(0.1), "ball", material)
    plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), shape, "ground", ground)
    plant.Finalize()
    actuation = builder.AddSystem(ConstantVectorSource(np.zeros(0)))
    builder.Connect(actuation.get_output_port(), plant.get_actuation_input_port())
    return builder.Build(), plant


def compiled(diagram: Diagram) -> CompiledRollouts:
    return CompiledRollouts(
        diagram, collect(diagram), diagram.CreateDefaultContext(), horizon=0.1, sample_period=0.1, check=False
    )


def test_a_ball_sinks_into_a_box_by_the_nearest_face() -> None:
    diagram, plant = ball_on(Box(1.0, 2.0, 3.0))
    steps, ball = Steps(diagram, plant, False), plant.GetBodyByName("ball")
    for place, normal in (([0.45, 0.3, 0.2], 0), ([0.1, -0.98, 0.2], 1), ([0.55, 0.0, 1.0], 0)):
        plant.SetFreeBodyPose(steps.context, ball, RigidTransform(place))
        expected, (v, forces, _) = steps.drake(), steps.compiled()
        assert np.argmax(np.abs(forces)) == normal
        np.testing.assert_allclose(v, expected, atol=1e-8)


@pytest.fixture(scope="module")
def wedge(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the file of a mesh whose convex hull has six vertices."""
    file = tmp_path_factory.mktemp("meshes") / "wedge.obj"
    corners = [(x, y, z) for x, z in ((-0.1, -0.05), (0.1, -0.04), (0.02, 0.12)) for y in (-0.08, 0.07)]
    faces = [(0, 2, 4), (1, 5, 3), (0, 1, 3), (0, 3, 2), (2, 3, 5), (2, 5, 4), (4, 5, 1), (4, 1, 0)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    file.write_text("\n".join(lines), encoding="utf-8")
    return str(file)


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("one", "other"),
    [
        (Sphere(0.1), Cylinder(0.2, 0.3)),
        (Sphere(0.1), Capsule(0.2, 0.3)),
        (Capsule(0.05, 0.2), Sphere(0.1)),
        (Box(0.1, 0.2, 0.3), HalfSpace()),
        (Capsule(0.05, 0.2), HalfSpace()),
        (Cylinder(0.05, 0.2), HalfSpace()),
        ("convex", HalfSpace()),
        ("mesh", HalfSpace()),
        ("convex", Sphere(0.2)),
        ("mesh", Sphere(0.05)),
        (Capsule(0.05, 0.2), Capsule(0.1, 0.3)),
    ],
    ids=lambda shape: shape if isinstance(shape, str) else type(shape).__name__,
)
def test_other_shapes_touch_as_in_drake(one: Shape | str, other: Shape, wedge: str) -> None:
    """Steps from random poses in contact are Drake's, and from poses in which a shape lies or stands almost flat."""
    if isinstance(one, str):
        one = (Convex if one == "convex" else Mesh)(wedge, 1.5)
    steps, random = Steps(*ball_on(other, of_ball=one), False), np.random.default_rng(0)
    touching, apart = 0, []
    for trial in range(60):
        angles = random.uniform(-np.pi, np.pi, 3)
        if trial < 20:
            angles = np.pi / 2 * random.integers(0, 4, 3) + 10.0 ** random.uniform(-9, -3) * random.uniform(-1, 1, 3)
        pose = RigidTransform(RollPitchYaw(angles), random.uniform(-0.15, 0.15, 3))
        if steps.contact.is_iterated():
            steps.plant.SetFreeBodyPose(steps.context, steps.plant.GetBodyByName("ball"), pose)
        else:
            steps.put("ball", pose, random.uniform(0.001, 0.02))
        steps.plant.SetVelocities(steps.context, random.standard_normal(6))
        expected, (v, forces, doubt) = steps.drake(), steps.compiled()
        assert doubt == 0.0
        touching += np.any(forces)
        apart.append(np.abs(v - expected).max() / max(1.0, np.abs(expected).max()))
    # Below the middle of what lies flat, the problem is nearly degenerate, and rounding grows in its iteration. Where
    # Drake iterates for the geometry, its end depends on rounding.
    assert np.max(apart) < (1e-3 if steps.contact.is_iterated() else 1e-6)
    assert np.median(apart) < 1e-9
    assert touching > 25


def test_other_shapes_are_refused_by_name() -> None:
    refusal = r"contact of .*ball of ball \(Box\) and .*ground of world \(Box\) is not compiled: let a Sphere"
    with pytest.raises(UnsupportedTestbedError, match=refusal):
        compiled(ball_on(Box(1.0, 1.0, 1.0), of_ball=Box(0.1, 0.1, 0.1))[0])


@pytest.mark.slow
def test_an_arm_presses_on_a_wall() -> None:
    """The whole testbed with sensors and DPS, and the reaction forces of its joints."""
    testbed = ManipulatorScenario(wall=True).build()
    rollouts = testbed.compiled(horizon=0.5, sample_period=0.1, outputs=["plant.state"])
    simulator = testbed.simulator()
    simulator.AdvanceTo(0.5)
    batch = rollouts({})
    assert batch.valid.all()
    state = testbed.plant.GetPositionsAndVelocities(testbed.plant.GetMyContextFromRoot(simulator.get_context()))
    np.testing.assert_allclose(batch.outputs["plant.state"][0, -1], state, atol=1e-6)


@pytest.mark.parametrize("sampled", [False, True])
def test_contact_sensors(sampled: bool) -> None:
    """Switches of the feet of a quadruped that lands, with two thresholds."""
    diagram, plant = quadruped("lagged", contact_period=0.01, sampled=sampled)
    variables, outputs = collect(diagram), ["switches.foot_contact"]
    options = {"horizon": 0.4, "sample_period": 0.01, "outputs": outputs}
    context = diagram.CreateDefaultContext()
    if sampled:
        with pytest.raises(UnsupportedTestbedError, match="contact_results, which shows its last step.*to False"):
            CompiledRollouts(diagram, variables, context, **options)
        return
    rollouts = CompiledRollouts(diagram, variables, context, **options)
    thresholds = np.array([5.0, 60.0])
    batch = rollouts({"switches.threshold": thresholds})
    for row, threshold in enumerate(thresholds):
        simulator = Simulator(diagram, context.Clone())
        variables.write(simulator.get_mutable_context(), {"switches.threshold": threshold})
        for k, time in enumerate(rollouts.times):
            simulator.AdvanceTo(time)
            expected = rollouts.read("switches.foot_contact", simulator.get_context())
            np.testing.assert_array_equal(batch.outputs["switches.foot_contact"][row, k], expected)
    closed = batch.outputs["switches.foot_contact"].mean(axis=(1, 2))
    assert 0.0 < closed[1] < closed[0] < 1.0


def test_other_approximations_and_models_are_refused_by_name() -> None:
    with pytest.raises(UnsupportedTestbedError, match="approximated as kSimilar is not compiled.*'sap' or 'lagged'"):
        compiled(ball_on(HalfSpace(), "similar")[0])
    hydroelastic = ball_on(HalfSpace(), contact_model="hydroelastic_with_fallback")[0]
    with pytest.raises(UnsupportedTestbedError, match="hydroelastic contact of ball of ball.*to 'point'"):
        compiled(hydroelastic)


def test_without_a_compiler_contact_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(UnsupportedTestbedError, match="solver is written in C: .*no-such-compiler.*install one"):
        compiled(ball_on(HalfSpace(), "sap")[0])


def test_a_step_that_does_not_converge_ends_its_rollout_with_reason_and_time() -> None:
    diagram, _ = ball_on(HalfSpace())
    rollouts = compiled(diagram)
    z = np.tile(rollouts.walker.read(diagram.CreateDefaultContext()), (4, 1))
    z[:, 6] = 0.05
    z[1, 6] = np.nan
    z[2, 12] = 1e200  # Its square is infinite.
    z[3, 6] = 10.0  # It flies.
    z[3, 12] = np.inf
    batch = rollouts.from_z(z, 0.5)
    assert batch.valid.tolist() == [True, False, False, False]
    solver = "plant: the solver of contact, stops and controllers did not converge at t = 0.5 s"
    infinite = "the state of plant is not finite at t = 0.5 s"
    assert batch.reasons == ("", infinite, solver, infinite)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(WORLDS.keys() - {"crater"}))
def test_outcomes_are_drakes(name: str) -> None:
    """Steps agree to rounding, and outcomes where Drake's do not depend on noise of 1e-9 at the begin."""
    world = WORLDS[name]("lagged")
    # On terrain, two steps of Drake whose states differ by rounding differ by up to 2e-4.
    assert step_errors(world, 100).max() < (1e-3 if name == "terrain" else 1e-9)
    shares = outcome_shares(world, 10, seed=1)
    assert shares.repeatable >= 8
    assert shares.alike == shares.repeatable
    assert 0 < shares.happened < shares.repeatable
