"""Random Diagrams of systems that can be compiled."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi
import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia
from pydrake.symbolic import Variable, cos, sin
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import (
    Adder,
    AffineSystem,
    ConstantVectorSource,
    Demultiplexer,
    DiscreteDerivative,
    DiscreteTimeDelay,
    DiscreteTimeIntegrator,
    Gain,
    LinearSystem,
    MatrixGain,
    Multiplexer,
    PassThrough,
    Saturation,
    Sine,
    SymbolicVectorSystem,
    TrajectorySource,
    ZeroOrderHold,
)
from pydrake.trajectories import PiecewisePolynomial

from vtbdrake.common.spline import ORDERS, Spline
from vtbdrake.components.actuators import JointDrives
from vtbdrake.components.casadi_system import CasadiSystem
from vtbdrake.components.sensors import ErrorModel, JointEncoders, JointTachometers
from vtbdrake.components.spline_command import SplineCommand

PERIODS = (0.1, 0.02, 0.03, 0.05, 0.04)
OFFSETS = (0.0, 0.0, 0.01, 0.06, 0.07)


class RandomDiagram:
    """Makes a Diagram of holds that are fed at the end, sources, a plant with sensors and drives, and more.

    Attributes:
        diagram: The Diagram; its subsystems are named s0, s1, ...
        outputs: The addresses of all vector output ports.
    """

    def __init__(self, seed: int, *, systems: int = 12) -> None:
        self.random = np.random.default_rng(seed)
        self.builder = DiagramBuilder()
        self.ports: list[OutputPort] = []
        self.holds: list[System] = []
        self.count = 0
        for _ in range(2):  # Whatever is fed back goes through one of them.
            size = int(self.random.integers(1, 4))
            hold = ZeroOrderHold(self.period(), size, self.offset())
            self.holds.append(self.add(hold))
        self.add(ConstantVectorSource(self.random.standard_normal(2)))
        if self.random.random() < 0.6:
            self.add_arm()
        makers: Sequence[Callable[[], System]] = (
            lambda: Gain(self.random.standard_normal(), self.size()),
            lambda: MatrixGain(self.random.standard_normal((self.size(), self.size()))),
            lambda: Adder(2, self.size()),
            lambda: Multiplexer([self.size(), self.size()]),
            lambda: Demultiplexer([self.size(), self.size()]),
            lambda: Saturation(-self.random.random(2), self.random.random(2)),
            lambda: PassThrough(self.size()),
            lambda: Sine(self.random.random(), 3.0 * self.random.random(), self.random.random(), 1),
            self.linear,
            self.affine,
            lambda: DiscreteTimeDelay(self.period(), int(self.random.integers(1, 4)), self.size()),
            lambda: DiscreteTimeIntegrator(self.size(), self.period()),
            lambda: DiscreteDerivative(self.size(), self.period()),
            lambda: ZeroOrderHold(self.period(), self.size(), self.offset()),
            self.symbolic,
            self.casadi,
            self.spline,
            self.trajectory,
        )
        for _ in range(systems):
            self.add(makers[self.random.integers(len(makers))]())
        for hold in self.holds:
            self.connect(hold)
        self.diagram = self.builder.Build()
        self.outputs = [f"{port.get_system().get_name()}.{port.get_name()}" for port in self.ports]

    def size(self) -> int:
        return int(self.random.integers(1, 4))

    def period(self) -> float:
        return float(self.random.choice(PERIODS))

    def offset(self) -> float:
        return float(self.random.choice(OFFSETS))

    def add(self, system: System) -> System:
        """Add a system, and connect its inputs unless it is one of the holds of the begin."""
        self.builder.AddNamedSystem(f"s{self.count}", system)
        self.count += 1
        if self.count > 2:
            self.connect(system)
        self.ports += [system.get_output_port(i) for i in range(system.num_output_ports())]
        return system

    def connect(self, system: System) -> None:
        for i in range(system.num_input_ports()):
            self.feed(system.get_input_port(i))

    def feed(self, port) -> None:
        """Connect an input port to a random output, which a matrix brings to its size."""
        source = self.ports[self.random.integers(len(self.ports))]
        if source.size() != port.size():
            matrix = 0.5 * self.random.standard_normal((port.size(), source.size()))
            adapted = self.builder.AddNamedSystem(f"s{self.count}", MatrixGain(matrix))
            self.count += 1
            self.builder.Connect(source, adapted.get_input_port())
            source = adapted.get_output_port()
        self.builder.Connect(source, port)

    def trajectory(self) -> System:
        values = self.random.standard_normal((self.size(), 9))
        return TrajectorySource(PiecewisePolynomial.ZeroOrderHold(0.1 * np.arange(9), values))

    def linear(self) -> System:
        n, m = self.size(), self.size()
        A = 0.5 * self.random.standard_normal((n, n))
        return LinearSystem(
            A, self.random.standard_normal((n, m)), np.eye(n), self.random.standard_normal((n, m)), self.period()
        )

    def affine(self) -> System:
        n, m, r = self.size(), self.size(), self.random.standard_normal
        return AffineSystem(0.4 * r((n, n)), r((n, m)), r(n), r((2, n)), r((2, m)), r(2), self.period())

    def symbolic(self) -> System:
        x, u = Variable("x"), Variable("u")
        return SymbolicVectorSystem(
            state=[x], input=[u], dynamics=[0.5 * sin(x) + u / (2.0 + cos(u))], output=[x**2], time_period=self.period()
        )

    def casadi(self) -> System:
        x, u, k, t = (casadi.SX.sym(name, size) for name, size in (("x", 2), ("u", 2), ("k", 1), ("t", 1)))
        update = casadi.Function(
            "filter",
            [x, u, k, t],
            [x + k * (casadi.tanh(u) - x) + 0.1 * casadi.sin(t)],
            ["x", "u", "k", "t"],
            ["x_next"],
        )
        output = casadi.Function("law", [x, u, k], [casadi.fmax(x, k * u), u[0]], ["x", "u", "k"], ["y", "z"])
        return CasadiSystem(
            output,
            update=update,
            state={"x": self.random.standard_normal(2)},
            parameters={"k": 0.5},
            time="t",
            period=self.period(),
        )

    def spline(self) -> System:
        order = str(self.random.choice(ORDERS))
        spline = Spline(order, 5, 0.3)
        plan = np.concatenate([[0.1 * self.random.random()], self.random.standard_normal(10)])
        source = self.builder.AddNamedSystem(f"s{self.count}", ConstantVectorSource(plan))
        self.count += 1
        after = None if self.random.random() < 0.5 else 0.0
        follower = SplineCommand(
            spline, period=self.period(), size=2, after=after, repeat=bool(self.random.random() < 0.3)
        )
        self.builder.AddNamedSystem(f"s{self.count}", follower)
        self.count += 1
        self.builder.Connect(source.get_output_port(), follower.get_input_port())
        self.ports.append(follower.get_output_port())
        return PassThrough(self.size())

    def add_arm(self) -> None:
        """Add two links with sensors, some of them in error, and sometimes with drives."""
        step = float(self.random.choice([0.005, 0.01, 0.02]))
        plant = MultibodyPlant(step)
        plant.SetUseSampledOutputPorts(bool(self.random.random() < 0.5))
        arm = plant.AddModelInstance("arm")
        parent, joints = plant.world_frame(), []
        for k in range(2):
            link = plant.AddRigidBody(f"link{k}", arm, SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.5))
            damping = float(self.random.choice([0.0, 0.3]))
            joint = plant.AddJoint(RevoluteJoint(f"joint{k}", parent, link.body_frame(), [0, 1, 0], damping))
            plant.AddJointActuator(f"motor{k}", joint, effort_limit=5.0)
            joints.append(joint)
            parent = link.body_frame()
        plant.Finalize()
        self.builder.AddNamedSystem("arm", plant)
        errors = ErrorModel(
            noise=0.1,
            bias=0.2,
            drift=float(self.random.choice([0.0, 0.1])),
            quantization=float(self.random.choice([0.0, 0.03])),
            latency=int(self.random.integers(0, 3)),
            max_latency=3,
            dropout=float(self.random.choice([0.0, 0.3])),
            outlier_probability=float(self.random.choice([0.0, 0.3])),
            outlier_size=1.0,
            seed=int(self.random.integers(5)),
        )
        for name, kind in (("encoders", JointEncoders), ("tachometers", JointTachometers)):
            sensor = kind(plant, joints, period=self.period(), errors=errors if self.random.random() < 0.6 else None)
            self.builder.AddNamedSystem(name, sensor)
            self.builder.Connect(plant.get_state_output_port(), sensor.GetInputPort("state"))
            self.ports.append(sensor.get_output_port())
        if self.random.random() < 0.5:
            drives = JointDrives(
                plant,
                joints,
                period=self.period(),
                limit=3.0,
                rate=50.0,
                time_constant=0.02,
                viscous=0.1,
                coulomb=0.05,
                disturbance=float(self.random.choice([0.0, 0.2])),
                seed=int(self.random.integers(5)),
                delay=int(self.random.integers(0, 3)),
                max_delay=3,
            )
            self.builder.AddNamedSystem("drives", drives)
            self.builder.Connect(plant.get_state_output_port(), drives.GetInputPort("state"))
            self.feed(drives.GetInputPort("command"))
            self.builder.Connect(drives.get_output_port(), plant.get_actuation_input_port())
        else:
            self.feed(plant.get_actuation_input_port())
        self.ports.append(plant.get_state_output_port())


def build(seed: int) -> tuple[Diagram, list[str]]:
    """Return a random Diagram and the addresses of its output ports."""
    made = RandomDiagram(seed)
    return made.diagram, made.outputs
