"""Systems whose state and parameters have names: declared once, read and written by name, freed when dropped."""

import gc
import weakref

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.state import AddressedSystem, NamedVector, Quantity, collect

POSE = NamedVector(time=Quantity(unit="s"), position=Quantity([1.0, 2.0], unit="m"), turn=Quantity(np.eye(2)))


class Counter(AddressedSystem):
    """count += step and direction = 2 direction in every second; the output is gain * count."""

    def __init__(self):
        super().__init__()
        self.settings = self.declare_parameters(
            gain=Quantity([1.0, 3.0], unit="N", bounds=(0.0, 10.0)),
            step=Quantity(2.0, addressed=False),
            factor=Quantity(0.5),
        )
        self.memory = self.declare_discrete_state(count=Quantity(0.0, unit="s"), direction=Quantity([[1.0, 2.0]]))
        self.doubled = self.declare_cache("2 gain", self._calc_doubled, {self.all_parameters_ticket()})
        self.DeclareVectorOutputPort("force", 2, self._calc_force)
        self.DeclarePeriodicDiscreteUpdateEvent(1.0, 0.0, self._update)

    def _calc_doubled(self, context):
        return 2.0 * self.settings.view(context).gain

    def _calc_force(self, context, output):
        output.SetFromVector(self.doubled(context) / 2.0 * self.memory.view(context).count)

    def _update(self, context, state):
        memory = self.memory.mutable(state)
        memory.count += self.settings.view(context).step
        memory.direction = 2.0 * memory.direction


def counting():
    builder = DiagramBuilder()
    system = builder.AddNamedSystem("counter", Counter())
    return builder.Build(), system


def test_quantities_are_variables_at_their_entries():
    diagram, system = counting()
    context = diagram.CreateDefaultContext()
    variables = collect(diagram)
    assert [(v.address, v.kind, v.shape, v.unit) for v in variables.values()] == [
        ("counter.gain", "a", (2,), "N"),
        ("counter.factor", "a", (), "1"),
        ("counter.count", "x", (), "s"),
        ("counter.direction", "x", (1, 2), "1"),
    ]
    assert variables["counter.gain"].bounds == (0.0, 10.0)
    variables.write(context, {"counter.factor": 0.25, "counter.direction": [[5.0, 6.0]]})
    leaf_context = system.GetMyContextFromRoot(context)
    np.testing.assert_array_equal(leaf_context.get_numeric_parameter(0).value(), [1.0, 3.0, 2.0, 0.25])
    np.testing.assert_array_equal(leaf_context.get_discrete_state(0).value(), [0.0, 5.0, 6.0])


def test_updates_read_and_write_by_name():
    diagram, system = counting()
    simulator = Simulator(diagram)
    system.settings.mutable(system.GetMyMutableContextFromRoot(simulator.get_mutable_context())).step = 4.0
    simulator.AdvanceTo(2.5)
    context = system.GetMyContextFromRoot(simulator.get_context())
    np.testing.assert_array_equal(context.get_discrete_state(0).value(), [12.0, 8.0, 16.0])
    np.testing.assert_array_equal(system.get_output_port().Eval(context), [12.0, 36.0])


def test_a_vector_is_laid_out_in_the_order_of_its_names():
    array = POSE.array(time=3.0, turn=[[5.0, 6.0], [7.0, 8.0]])
    np.testing.assert_array_equal(array, [3.0, 1.0, 2.0, 5.0, 6.0, 7.0, 8.0])
    view = POSE.view(array)
    assert isinstance(view.time, float)
    view.position[1] = 9.0
    view.turn = 0.0
    np.testing.assert_array_equal(view, [3.0, 1.0, 9.0, 0.0, 0.0, 0.0, 0.0])
    assert POSE.slice_of("position") == slice(1, 3)


def test_a_name_that_does_not_exist_is_an_error():
    view = POSE.view(POSE.array())
    with pytest.raises(AttributeError, match="no 'positon' among time, position, turn; did you mean position"):
        view.positon  # noqa: B018
    with pytest.raises(AttributeError, match="speed"):
        view.speed = 1.0


def test_values_of_another_shape_are_refused():
    with pytest.raises(ValueError, match="broadcast"):
        POSE.array(position=[1.0, 2.0, 3.0])


def test_second_vector_of_continuous_state_is_refused():
    system = AddressedSystem()
    angle = system.declare_continuous_state(angle=Quantity(0.5, unit="rad"))
    assert angle.view(system.CreateDefaultContext()).angle == 0.5
    with pytest.raises(ValueError, match="one vector of continuous state: declare all of it at once"):
        system.declare_continuous_state(rate=Quantity(0.0))


def test_a_system_whose_methods_compute_its_outputs_is_freed():
    diagram, system = counting()
    system.diagram = diagram  # A cycle, which only the collector frees.
    Simulator(diagram).AdvanceTo(0.5)
    reference = weakref.ref(system)
    del diagram, system
    gc.collect()
    assert reference() is None


@pytest.mark.parametrize(
    ("quantity", "message"),
    [
        (1.0, r"declare gain as gain=Quantity\(default, unit\), not as gain=1.0"),
        (Quantity("1.5"), "the default of gain must be a number or several, not '1.5'"),
        (Quantity(5.0, bounds=(0.0, 1.0)), r"the default of gain, 5.0, lies outside its bounds \(0.0, 1.0\)"),
        (Quantity([0.5, 2.0], bounds=([0.0, 0.0], [1.0, 1.0])), "the default of gain, .* lies outside"),
        (Quantity(0.5, bounds=(1.0, 0.0)), r"the bounds of gain are \(lower, upper\), not \(1.0, 0.0\)"),
        (Quantity(0.5, bounds=(0.0, np.nan)), r"the bounds of gain are \(lower, upper\), not \(0.0, nan\)"),
        (Quantity(0.5, bounds=(0.0, 0.5, 1.0)), r"the bounds of gain are \(lower, upper\), not \(0.0, 0.5, 1.0\)"),
        (Quantity(0.5, bounds=("0", 1.0)), "each of the bounds of gain must be a number or several, not '0'"),
        (Quantity([0.5, 0.5], bounds=(0.0, [1.0])), r"numbers or have its shape \(2,\), not \(1,\)"),
    ],
)
def test_a_quantity_that_is_not_possible_is_refused_by_its_name(quantity, message):
    with pytest.raises(ValueError, match=message):
        AddressedSystem().declare_parameters(gain=quantity)


def test_no_value_and_the_bounds_themselves_are_possible_defaults():
    vector = NamedVector(force=Quantity(np.nan, bounds=(0.0, 1.0)), gain=Quantity([0.0, 1.0], bounds=(0.0, 1.0)))
    np.testing.assert_array_equal(vector.array(), [np.nan, 0.0, 1.0])
