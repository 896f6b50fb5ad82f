"""Testbeds that cannot be compiled are refused by name, and wrong compilations are noticed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from pydrake.symbolic import Expression, Variable, uninterpreted_function
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    LeafSystem_,
    System,
)
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    Gain,
    Integrator,
    SymbolicVectorSystem,
    TrajectorySource,
    ZeroOrderHold,
)
from pydrake.systems.scalar_conversion import TemplateSystem
from pydrake.trajectories import PiecewisePolynomial

from vtbdrake.compiled import (
    EQUATIONS,
    At,
    CompiledDifferenceError,
    CompiledRollouts,
    Equations,
    UnsupportedTestbedError,
)
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.state.systems import collect
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario


class Squares(AddressedSystem):
    """A system in Python: x becomes x^2 + 1 / 10."""

    def __init__(self) -> None:
        super().__init__()
        self._x = self.declare_discrete_state(x=Quantity(0.5))
        self.DeclareStateOutputPort("x", self._x.index)
        self.DeclarePeriodicDiscreteUpdateEvent(0.1, 0.0, self._update)

    def _update(self, context: Context, state) -> None:
        self._x.mutable_array(state)[0] = self._x.array(context)[0] ** 2 + 0.1


class SquaresEquations(Equations):
    def output(self, port: str, at: At):
        return at.state(0)

    def update(self, at: At):
        return {0: at.state(0) ** 2 + 0.1}


class WrongEquations(SquaresEquations):
    def update(self, at: At):
        return {0: at.state(0) ** 2 + 0.1000001}


def alone(*systems: System) -> Diagram:
    builder = DiagramBuilder()
    for k, system in enumerate(systems):
        builder.AddNamedSystem(f"part{k}", system)
        if k:
            builder.Connect(systems[k - 1].get_output_port(), system.get_input_port())
    return builder.Build()


def compiled(diagram: Diagram, outputs: tuple[str, ...] = (), **options) -> CompiledRollouts:
    return CompiledRollouts(
        diagram,
        collect(diagram),
        options.pop("context", None) or diagram.CreateDefaultContext(),
        horizon=1.0,
        sample_period=0.1,
        outputs=outputs,
        **{"compile": False, **options},
    )


@pytest.mark.parametrize(
    ("diagram", "reason"),
    [
        (lambda: alone(Squares()), "part0: Squares is a LeafSystem in Python: write its equation as a casadi.Function"),
        (lambda: alone(ConstantVectorSource([1.0]), Integrator(1)), "part1: Integrator has continuous state"),
    ],
)
def test_names_the_system(diagram: Callable[[], Diagram], reason: str) -> None:
    with pytest.raises(UnsupportedTestbedError, match=reason):
        compiled(diagram())


def test_of_a_continuous_world_the_plant_alone_is_named() -> None:
    with pytest.raises(UnsupportedTestbedError) as told:
        DoublePendulumScenario().build().compiled(horizon=0.1, compile=False)
    assert str(told.value) == (
        "the testbed cannot be compiled: plant: MultibodyPlant has continuous state, and a compiled rollout has steps: "
        "give it a time step (MultibodyPlantConfig(time_step=0.001)), or take another executor"
    )


def test_unconnected_inputs_are_named() -> None:
    with pytest.raises(UnsupportedTestbedError, match="part0: nothing is connected to the input port u"):
        compiled(alone(ZeroOrderHold(0.1, 1)))


def test_what_drake_cannot_write_down_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(EQUATIONS, TrajectorySource)
    trajectory = TrajectorySource(PiecewisePolynomial.ZeroOrderHold([0.0, 1.0], [[1.0, 2.0]]))
    x = Variable("x")
    unknown = SymbolicVectorSystem(input=[x], output=[uninterpreted_function("f", [Expression(x)])])
    for source, reason in {
        trajectory: "TrajectorySource has no equations that Drake can write down .*symbolic time",
        unknown: r"SymbolicVectorSystem has no equations that Drake can write down \(there is no expression of CasADi",
    }.items():
        systems = [ConstantVectorSource([1.0])] if source is unknown else []
        with pytest.raises(UnsupportedTestbedError, match=reason):
            compiled(alone(*systems, source, ZeroOrderHold(0.1, 1)))


class Loop(LeafSystem):
    """Claims that its output does not depend on its input, which Drake believes."""

    def __init__(self) -> None:
        super().__init__()
        self.DeclareVectorInputPort("u", 1)
        self.DeclareVectorOutputPort("y", 1, lambda c, y: None, prerequisites_of_calc={self.nothing_ticket()})


class LoopEquations(Equations):
    def output(self, port: str, at: At):
        return at.input("u")


def test_algebraic_loops_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EQUATIONS, Loop, LoopEquations)
    builder = DiagramBuilder()
    loop, gain = builder.AddNamedSystem("loop", Loop()), builder.AddNamedSystem("gain", Gain(2.0, 1))
    builder.Connect(loop.get_output_port(), gain.get_input_port())
    builder.Connect(gain.get_output_port(), loop.get_input_port())
    with pytest.raises(UnsupportedTestbedError, match="algebraic loop.*gain -> loop -> gain"):
        compiled(builder.Build(), outputs=("gain.y0",))


def test_equations_can_be_added(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EQUATIONS, Squares, SquaresEquations)
    x = compiled(alone(Squares()), outputs=("part0.x",))().outputs["part0.x"][0]
    assert x[1] == 0.5**2 + 0.1
    assert x.shape == (11,)


def test_wrong_equations_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EQUATIONS, Squares, WrongEquations)
    with pytest.raises(CompiledDifferenceError, match=r"state of part0 differs .* by 1e-07 at t = 0.1 s"):
        compiled(alone(Squares()))
    compiled(alone(Squares()), check=False)


class Logistic(AddressedSystem):
    """The logistic map: what rounding makes doubles in each step, and becomes as large as the state."""

    def __init__(self) -> None:
        super().__init__()
        self._x = self.declare_discrete_state(x=Quantity(0.3))
        self.DeclareStateOutputPort("x", self._x.index)
        self.DeclarePeriodicDiscreteUpdateEvent(0.02, 0.0, self._update)

    def _update(self, context: Context, state) -> None:
        x = self._x.array(context)[0]
        self._x.mutable_array(state)[0] = 3.999 * x * (1.0 - x)


class LogisticEquations(Equations):
    """The same, rounded in another way."""

    def output(self, port: str, at: At):
        return at.state(0)

    def update(self, at: At):
        return {0: 3.999 * at.state(0) - 3.999 * at.state(0) ** 2}


def test_a_chaotic_diagram_is_not_taken_for_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EQUATIONS, Logistic, LogisticEquations)
    diagram = alone(Logistic())
    rollouts = compiled(diagram, outputs=("part0.x",))
    simulator = Simulator(diagram)
    simulator.AdvanceTo(1.0)
    apart = rollouts().outputs["part0.x"][0, -1] - simulator.get_context().get_discrete_state_vector().CopyToVector()
    assert abs(apart[0]) > 1e-6


class MoreSquares(Squares):
    """Computes something else than its base class, as the equations of that cannot tell."""


def test_a_subclass_is_not_its_base(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EQUATIONS, Squares, SquaresEquations)
    with pytest.raises(UnsupportedTestbedError, match="part0: MoreSquares is a LeafSystem in Python"):
        compiled(alone(MoreSquares()))


class Watchdog(LeafSystem):
    """Has no state, but may end a simulation."""

    def __init__(self) -> None:
        super().__init__()
        self.DeclarePeriodicPublishEvent(0.1, 0.0, lambda context: EventStatus.ReachedTermination(self, "over"))


def test_what_may_end_a_simulation_is_named() -> None:
    with pytest.raises(UnsupportedTestbedError, match="part0: Watchdog is a LeafSystem in Python"):
        compiled(alone(Watchdog()))


@TemplateSystem.define("Counter_")
def Counter_(T: type) -> type:
    """Count in a way of its own, which Drake converts to symbolic expressions; ``periods`` are its updates'."""

    class Impl(LeafSystem_[T]):
        def _construct(self, periods=(), per_step=False, most=np.inf, converter=None) -> None:
            LeafSystem_[T].__init__(self, converter=converter)
            self.arguments = periods, per_step, most
            self.DeclareStateOutputPort("x", self.DeclareDiscreteState(1))
            for period in periods:
                self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self.update)
            if per_step:
                self.DeclarePerStepDiscreteUpdateEvent(self.update)
            self.DeclarePerStepPublishEvent(self.watch)

        def _construct_copy(self, other, converter=None) -> None:
            Impl._construct(self, *other.arguments, converter=converter)

        def update(self, context, state) -> None:
            state.get_mutable_vector().SetFromVector(context.get_discrete_state_vector().CopyToVector() + 1.0)

        def watch(self, context) -> EventStatus:
            if context.get_discrete_state_vector()[0] >= self.arguments[2]:
                return EventStatus.ReachedTermination(self, "that is enough")
            return EventStatus.DidNothing()

    return Impl


@pytest.mark.parametrize("events", [{"periods": (0.1, 0.3)}, {"per_step": True}, {}])
def test_state_that_is_updated_otherwise_is_named(events: dict) -> None:
    with pytest.raises(UnsupportedTestbedError, match="part0: Counter has state beside one periodic"):
        compiled(alone(Counter_[float](**events)), check=False)


def test_an_end_of_the_simulation_is_noticed() -> None:
    assert compiled(alone(Counter_[float](periods=(0.1,))), ("part0.x",))().outputs["part0.x"][0, -1] == 10.0
    message = "ends its simulation, and what is compiled does not: .*that is enough"
    with pytest.raises(CompiledDifferenceError, match=message):
        compiled(alone(Counter_[float](periods=(0.1,), most=3.0)))


class OwnSquares(Squares):
    def compiled_equations(self, context: Context, varied: frozenset[str]) -> Equations:
        return SquaresEquations(self, context, varied)


def test_a_system_may_have_its_equations() -> None:
    assert compiled(alone(OwnSquares()), outputs=("part0.x",))().outputs["part0.x"][0, 1] == 0.5**2 + 0.1


def test_a_value_fixed_at_an_input_is_compiled_in() -> None:
    diagram = alone(ZeroOrderHold(0.1, 1))
    hold = diagram.GetSubsystemByName("part0")
    contexts = [diagram.CreateDefaultContext() for _ in range(4)]
    for value, context in zip((3.0, 3.0, 4.0), contexts, strict=False):
        hold.get_input_port().FixValue(hold.GetMyContextFromRoot(context), [value])
    rollouts = compiled(diagram, ("part0.y",), context=contexts[0])
    for context in contexts[:2]:
        assert rollouts(context=context).outputs["part0.y"][0, -1, 0] == 3.0
    for context in contexts[2:]:  # another value, and none
        with pytest.raises(UnsupportedTestbedError, match="the value fixed at the input port u of part0 differs"):
            rollouts(context=context)


class Started(Squares):
    """Sets its state when a simulation begins."""

    def __init__(self) -> None:
        super().__init__()
        self.DeclareInitializationDiscreteUpdateEvent(lambda context, state: state.set_value(0, [0.2]))


def test_initialization_events_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EQUATIONS, Started, SquaresEquations)
    with pytest.raises(UnsupportedTestbedError, match="part0 is changed by an initialization event"):
        compiled(alone(Started()))


def test_without_a_compiler_it_is_interpreted(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    diagram = alone(ConstantVectorSource([0.3]), ZeroOrderHold(0.1, 1), Gain(3.0, 1))
    batch = compiled(diagram, outputs=("part2.y0",), compile=None)()
    assert "the testbed is interpreted by CasADi, several times more slowly" in caplog.text
    np.testing.assert_array_equal(batch.outputs["part2.y0"][0].ravel(), [0.0] + 10 * [3.0 * 0.3])


def test_sums_of_what_is_compiled_need_no_state() -> None:
    builder = DiagramBuilder()
    source, adder = (
        builder.AddNamedSystem("source", ConstantVectorSource([1.0])),
        builder.AddNamedSystem("sum", Adder(2, 1)),
    )
    builder.Connect(source.get_output_port(), adder.get_input_port(0))
    builder.Connect(source.get_output_port(), adder.get_input_port(1))
    rollouts = compiled(builder.Build(), outputs=("sum.sum",))
    np.testing.assert_array_equal(rollouts({"source.value": [[2.0], [3.0]]}).outputs["sum.sum"][:, -1, 0], [4.0, 6.0])


def test_ports_of_systems_with_dots_in_their_names() -> None:
    builder = DiagramBuilder()
    inner = DiagramBuilder()
    inner.ExportOutput(inner.AddNamedSystem("x.y", ConstantVectorSource([2.0])).get_output_port(), "out")
    builder.AddNamedSystem("sim.sense", inner.Build())
    outputs = compiled(builder.Build(), outputs=("sim.sense.out", "sim.sense.x.y.y0"))().outputs
    assert [values[0, -1, 0] for values in outputs.values()] == [2.0, 2.0]


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("a", "part0.value must be a number or several, not 'a'"),
        (np.empty((0, 1)), "there are no values of part0.value"),
    ],
)
def test_values_that_are_none_are_named(value: object, reason: str) -> None:
    rollouts = compiled(alone(ConstantVectorSource([1.0]), ZeroOrderHold(0.1, 1)))
    with pytest.raises(ValueError, match=reason):
        rollouts({"part0.value": value})
