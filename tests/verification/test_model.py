"""The model: accelerations, poses, torques and readings at a state, against published values and closed forms.

Nothing is integrated here: errors are of rounding, or of the one sample period over which a sensor takes its mean.
"""

from __future__ import annotations

import casadi
import numpy as np
import pytest
from pydrake.math import RotationMatrix
from pydrake.multibody.plant import MultibodyPlant

from tests.verification.conftest import Verify
from tests.verification.worlds import DoublePendulum, Encoders, FreeBody, G, Iiwa, ImuWorld, Run
from vtbdrake.components.compiled_plant import PlantDynamics, plant_dynamics
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.rollout import RolloutTask, SerialExecutor
from vtbdrake.rollout.executor import run_rollouts

MOTION_GENESIS = {
    "position": (0.2970356451892219, 0.1727696964662286, 1.154681973689345),
    "rotation": (
        (-0.5939002959880226, 0.8043869080239553, -0.015625),
        (-0.8043869080239555, -0.5932991120359339, 0.03094940802395567),
        (0.015625, 0.03094940802395569, 0.9993988160479113),
    ),
    "angular_velocity": (0.3884055139592793, -0.1990885898562859, 1.341085522179648),
    "velocity": (0.1372721470600132, -0.002318736162907997, -0.1192205632579836),
    "angular_acceleration": (0.3385891910402382, 0.2166638958380828, 0.8640119311549731),
    "acceleration": (0.2947399991496308, 0.4695144068476197, -0.3745794147088281),
    "torque": (
        0.8848188219902586,
        -30.31957093303907,
        -4.260770502657786,
        -5.11286815690344,
        0.3271237385627989,
        -0.05536385268411531,
        0.0008649076642538979,
    ),
}
"""Values for the benchmark's third state, from code that MotionGenesis 5.9 generated and Drake's benchmark compiles."""
Q = np.radians([60.0, 30.0, 60.0, 30.0, 60.0, 30.0, 60.0])
V = np.arange(1, 8) / 10.0
A = np.arange(7, 0, -1) / 10.0
# MotionGenesis gives 16 digits; a chain of seven rotations loses some ulp.
ROUNDING = 1e-13


def _iiwa() -> Run:
    """Return the arm at the state Q, V, under the torques that MotionGenesis has computed for the accelerations A."""
    start: dict[str, object] = {"u.force": MOTION_GENESIS["torque"]}
    for k in range(7):
        start |= {f"joint_{k + 1}.position": Q[k], f"joint_{k + 1}.velocity": V[k]}
    return Run(Iiwa(), start)


def test_iiwa_moves_as_motion_genesis_computes(verify: Verify) -> None:
    """Flange of an iiwa: pose, velocity and acceleration at q = (60, 30, 60, 30, 60, 30, 60) deg.

        p(q), R(q);  w = J_w(q) v,  v = J_v(q) v;  a = J vdot + Jdot v

    Reference: MotionGenesis 5.9, from Drake's benchmark `kuka_iiwa_robot`, with v = 0.1 ... 0.7 rad/s and
    vdot = 0.7 ... 0.1 rad/s^2. The accelerations come from the testbed whose DPS commands the published torques.
    Tolerance: rounding.
    """
    run = _iiwa()
    plant = run.testbed.plant
    context = plant.GetMyContextFromRoot(run.context)
    pose = run.pose("link_7")
    A_WG = plant.get_body_spatial_accelerations_output_port().Eval(context)[int(plant.GetBodyByName("link_7").index())]
    values = {
        "position": pose.translation(),
        "rotation": pose.rotation().matrix(),
        "angular_velocity": run.angular_velocity("link_7"),
        "velocity": run.velocity("link_7"),
        "angular_acceleration": A_WG.rotational(),
        "acceleration": A_WG.translational(),
    }
    units = ("m", "1", "rad/s", "m/s", "rad/s^2", "m/s^2")
    for (name, value), unit in zip(values.items(), units, strict=True):
        # Forward dynamics divide the rounding of torques of 30 N m by the inertia of the last link, 1e-3 kg m^2.
        tolerance = 1e-10 if "acceleration" in name else ROUNDING
        verify(name.replace("_", " "), value, MOTION_GENESIS[name], tolerance=tolerance, unit=unit)


def test_compiled_iiwa_moves_as_motion_genesis_computes(verify: Verify) -> None:
    """Compiled iiwa: its kinematics, and inverse dynamics by the recursive Newton-Euler algorithm.

        tau = M(q) vdot + C(q, v) v - g(q)

    Reference: MotionGenesis 5.9, the state of the testbed's case. Tolerance: rounding.
    """
    plant = _iiwa().testbed.plant
    model = PlantDynamics(plant, plant.CreateDefaultContext())
    q, v, _ = model.symbols()
    vdot = casadi.SX.sym("vdot", 7)
    frame = plant.GetFrameByName("link_7")
    motion = model.frame(frame, q)
    V_WG = motion.J @ v
    A_WG = motion.J @ vdot + model.frame_bias(frame, q, v)
    values = {
        "position": motion.p,
        "rotation": motion.R,
        "angular_velocity": V_WG[:3],
        "velocity": V_WG[3:],
        "angular_acceleration": A_WG[:3],
        "acceleration": A_WG[3:],
        "torque": model.inverse_dynamics(q, v, vdot),
    }
    results = casadi.Function("iiwa", [q, v, vdot], list(values.values()))(Q, V, A)
    units = ("m", "1", "rad/s", "m/s", "rad/s^2", "m/s^2", "N m")
    for name, value, unit in zip(values, results, units, strict=True):
        reference = np.array(MOTION_GENESIS[name])
        value = value.full().reshape(reference.shape)
        # Torques reach 30 N m.
        tolerance = 100 * ROUNDING if name == "torque" else ROUNDING
        verify(name.replace("_", " "), value, reference, tolerance=tolerance, unit=unit)


def test_torques_of_the_straight_iiwa(verify: Verify) -> None:
    """Straight iiwa: the torques that hold it and turn its last joint with 1000 rad/s^2.

        tau = I_7zz 1000 (1, 0, 1, 0, 1, 0, 1) + g (0, 0.0003 m_2 + 0.0001 m_5, 0, -0.0001 m_5, 0, 0, 0)

    Reference: the hand calculation in Drake's benchmark `kuka_iiwa_robot`; the testbed accelerates as asked under these
    torques. Tolerance: 1e-10 of 1000 rad/s^2, rounding.
    """
    m_2, m_5, g = 6.35, 3.5, 9.8
    tau = [1.0, g * (0.0003 * m_2 + 0.0001 * m_5), 1.0, -g * 0.0001 * m_5, 1.0, 0.0, 1.0]
    run = Run(Iiwa(), {"u.force": tau})
    accelerations = [run.derivative(f"joint_{k}") for k in range(1, 8)]
    verify("accelerations", accelerations, [0, 0, 0, 0, 0, 0, 1000.0], tolerance=1e-7, unit="rad/s^2")


def test_accelerations_of_the_double_pendulum(verify: Verify) -> None:
    """Accelerations of a double pendulum: m = 1 kg, l = 1 m, absolute angles a and b.

        2 a'' + b'' cos(a - b) + b'^2 sin(a - b) + 2 g sin a = 0
        b'' + a'' cos(a - b) - a'^2 sin(a - b) + g sin b = 0

    Reference: Lagrange's equations above, solved at five random states. Tolerance: rounding.
    """
    random = np.random.default_rng(0)
    scenario = DoublePendulum()
    for a, b, da, db in random.uniform(-3.0, 3.0, (5, 4)):
        run = Run(
            scenario,
            {
                "shoulder.position": a,
                "elbow.position": b - a,
                "shoulder.velocity": da,
                "elbow.velocity": db - da,
            },
        )
        c, s = np.cos(a - b), np.sin(a - b)
        expected = np.linalg.solve([[2.0, c], [c, 1.0]], [-(db**2) * s - 2 * G * np.sin(a), da**2 * s - G * np.sin(b)])
        upper = run.derivative("shoulder")
        verify("a'', b''", [upper, upper + run.derivative("elbow")], expected, tolerance=1e-11, unit="rad/s^2")


@pytest.mark.parametrize("compiled", [False, True], ids=["plant", "compiled"])
def test_eulers_equations_of_a_free_body(verify: Verify, compiled: bool) -> None:
    """Euler's equations of a free body: in its principal axes, I = (1, 2, 3) kg m^2.

        I_1 w_1' = (I_2 - I_3) w_2 w_3, and so on in turn;  v' = -g z

    Reference: these equations at w = (0.3, -0.7, 1.1) rad/s in a rotated pose. Tolerance: rounding.
    """
    w = np.array([0.3, -0.7, 1.1])
    inertia = np.array([1.0, 2.0, 3.0])
    q = np.array([0.5, -0.1, 0.7, 0.4])
    q /= np.linalg.norm(q)
    run = Run(FreeBody(), {"body.position": [*q, 1.0, 2.0, 3.0]})
    R_WB = run.pose("body").rotation().matrix()
    run = Run(FreeBody(), {"body.position": [*q, 1.0, 2.0, 3.0], "body.velocity": [*(R_WB @ w), 0.5, 0.0, -0.2]})
    plant: MultibodyPlant = run.testbed.plant
    context = plant.GetMyContextFromRoot(run.context)
    if compiled:
        state = plant.GetPositionsAndVelocities(context)
        derivatives = plant_dynamics(plant, context)(state, []).full().ravel()
    else:
        derivatives = plant.EvalTimeDerivatives(context).CopyToVector()
    # The world's and the body's derivatives of w are the same vector.
    expected = np.array([inertia[k - 2] - inertia[k - 1] for k in range(3)]) / inertia
    expected *= [w[k - 2] * w[k - 1] for k in range(3)]
    verify("angular acceleration", R_WB.T @ derivatives[7:10], expected, tolerance=1e-14, unit="rad/s^2")
    verify("acceleration", derivatives[10:], [0.0, 0.0, -G], tolerance=1e-14, unit="m/s^2")


def test_imu_on_a_turning_link(verify: Verify) -> None:
    """IMU on a turning link: at r, about the world's y with the rate w = 2 rad/s, in gravity.

        gyro = R_FB w,   accelerometer = R_FB (sinc(w T / 2) w x (w x r) - R_BW(t - T/2) g)

    sinc(x) = sin(x) / x is the mean of the centripetal acceleration over the sample period T, seen from its middle.
    Reference: this closed form. Tolerance: rounding, 1e-11 of a velocity over T = 0.01 s.
    """
    scenario = ImuWorld()
    run = Run(scenario, {"hinge.velocity": 2.0})
    R_FB = scenario.mount().rotation().matrix().T
    w, r = np.array([0.0, 2.0, 0.0]), scenario.mount().translation()
    half = 2.0 * scenario.period / 2.0
    for k in (1, 7, 40):
        run.to((k + 0.5) * scenario.period)
        R_WB = RotationMatrix.MakeYRotation(2.0 * (k - 0.5) * scenario.period).matrix()
        f_B = np.sin(half) / half * np.cross(w, np.cross(w, r)) + R_WB.T @ [0.0, 0.0, G]
        reading = run.testbed.read(run.context, "sim.sense.imu.imu")
        verify("angular velocity", reading[:3], R_FB @ w, tolerance=1e-9, unit="rad/s")
        verify("specific force", reading[3:], R_FB @ f_B, tolerance=1e-8, unit="m/s^2")


@pytest.mark.parametrize(
    "w", [(0.5, -1.0, 2.0), (-2.0, 0.0, 0.0), (0.0, -2.0, 0.0), (0.0, 0.0, -2.0)], ids=["skew", "-x", "-y", "-z"]
)
def test_imu_in_free_fall(verify: Verify, w: tuple[float, float, float]) -> None:
    """IMU in free fall: at the centre of a ball that spins, it feels no force.

        gyro = R_FB w,   accelerometer = R' ((v(t) - v(t - T)) / T - g) = 0

    Reference: zero, and the constant w. Tolerance: rounding, 1e-11 of a velocity over T = 0.01 s.
    """
    scenario = ImuWorld(hinged=False)
    # The ball's inertia is the same about all axes.
    run = Run(scenario, {"body.velocity": [*w, 1.0, 2.0, 3.0]}).to(20.5 * scenario.period)
    reading = run.testbed.read(run.context, "sim.sense.imu.imu")
    verify("angular velocity", reading[:3], scenario.mount().rotation().matrix().T @ w, tolerance=1e-9, unit="rad/s")
    verify("specific force", reading[3:], np.zeros(3), tolerance=1e-8, unit="m/s^2")


def allan_variance(y: np.ndarray, n: int) -> float:
    """Return the overlapping Allan variance of the columns of y, for averages over n samples."""
    means = np.cumsum(np.vstack([np.zeros(y.shape[1]), y]), axis=0)
    means = (means[n:] - means[:-n]) / n
    return float(np.mean((means[n:] - means[:-n]) ** 2) / 2.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["white noise", "random walk"])
def test_allan_deviation(verify: Verify, kind: str) -> None:
    """Allan deviation: encoders at rest, averaged over n samples of the period T.

        white noise s:    sigma(n) = s / sqrt(n),  slope -1/2
        random walk K:    sigma(n) = K sqrt(T (2 n^2 + 1) / (6 n)),  slope +1/2 for large n

    Reference: IEEE Std 952, annex C, with the sums over discrete steps instead of integrals. 64 encoders are read
    4000 times. Tolerance: four standard deviations of the estimate, 4 sqrt(n / 256000), for a variance's half.
    """
    level = 0.02
    errors = ErrorModel(noise=level, seed=1) if kind == "white noise" else ErrorModel(drift=level, seed=1)
    scenario = Encoders(errors=errors)
    samples = 4000
    reading = "sim.sense.encoders.joint_encoders"
    task = RolloutTask(scenario, samples * scenario.period, sample_period=scenario.period, record=[reading])
    y = run_rollouts(SerialExecutor(), task, [{}], progress=False)[0].record[reading]
    # The sample at t = 0 is shown from then on; the record shows the state before the update of its instant.
    y = np.array(y)[1:]
    logarithms = []
    for n in (1, 4, 16, 64):
        deviation = np.sqrt(allan_variance(y, n))
        expected = level / np.sqrt(n)
        if kind == "random walk":
            expected = level * np.sqrt(scenario.period * (2 * n**2 + 1) / (6 * n))
        verify(f"deviation, n = {n}", deviation, expected, tolerance=4.0 * np.sqrt(n / y.size), relative=True)
        logarithms.append(np.log(deviation))
    slope = (logarithms[3] - logarithms[1]) / np.log(16.0)
    verify("slope", slope, -0.5 if kind == "white noise" else 0.5, tolerance=0.03)
