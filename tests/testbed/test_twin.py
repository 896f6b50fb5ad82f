"""T_act: who gets a command in each mode; abstract switches look at what is selected only; places give addresses."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import LeafSystem
from pydrake.systems.primitives import ConstantValueSource, PassThrough

from tests.testbeds import AcrobotScenario
from vtbdrake.testbed import ActuatorCommand, Interface, Signal, VirtualTestbedBuilder

SEEN = RigidTransform([1.0, 2.0, 3.0])
IDLE = RigidTransform([0.0, 0.0, 9.0])


class Pilot(LeafSystem):
    """Goes where it looks: commands the pose that it sees as an abstract signal, and its position as a vector."""

    def __init__(self):
        super().__init__()
        pose = self.DeclareAbstractInputPort("pose", Value(RigidTransform()))
        self.DeclareAbstractOutputPort("look", lambda: Value(RigidTransform()), lambda c, y: y.set_value(pose.Eval(c)))
        self.DeclareVectorOutputPort("speed", 3, lambda c, y: y.SetFromVector(pose.Eval(c).translation()))


class Silent(LeafSystem):
    """Has the Pilot's ports, but must not be asked."""

    def __init__(self):
        super().__init__()
        self.DeclareAbstractInputPort("pose", Value(RigidTransform()))
        self.DeclareAbstractOutputPort("look", lambda: Value(RigidTransform()), self._calc)
        self.DeclareVectorOutputPort("speed", 3, self._calc)

    def _calc(self, context, output):
        raise AssertionError("it was evaluated")


class Blind(LeafSystem):
    """A simulated sensor that must not be read."""

    def __init__(self):
        super().__init__()
        self.DeclareAbstractOutputPort("out", lambda: Value(RigidTransform()), self._calc)

    def _calc(self, context, output):
        raise AssertionError("it was evaluated")


def _testbed(mode, *, dps=Pilot, sensor=None):
    """A testbed whose simulated and real sensor see the same pose."""
    act = [Signal("look", model_value=RigidTransform(), idle=IDLE), Signal("speed", size=3, idle=[7.0, 8.0, 9.0])]
    builder = VirtualTestbedBuilder(Interface([Signal("pose", model_value=RigidTransform())], act))
    builder.set_dps(dps())
    camera = builder.add("sense", "pose", sensor or ConstantValueSource(Value(SEEN)))
    builder.sim_sensor("pose", camera.get_output_port())
    builder.sim_actuator("look", builder.add("act", "look", PassThrough(Value(RigidTransform()))).get_input_port())
    builder.sim_actuator("speed", builder.add("act", "speed", PassThrough(3)).get_input_port())
    testbed = builder.build()
    context = testbed.default_context()
    testbed.diagram.GetInputPort("real.sense.pose").FixValue(context, SEEN)
    testbed.switch(context, mode)
    return testbed, context


def _matrix(pose):
    return pose.GetAsMatrix34().tolist()


@pytest.mark.parametrize("mode", ["sim", "shadow", "real", "twin"])
def test_the_real_ports_carry_a_command_in_real_and_twin_only(mode):
    testbed, context = _testbed(mode)
    look, speed = testbed.read(context, "real.act.look"), testbed.read(context, "real.act.speed")
    assert isinstance(look, ActuatorCommand)
    if mode in ("real", "twin"):
        assert testbed.read(context, "real.act.active").tolist() == [1.0, 1.0]
        assert _matrix(look.value) == _matrix(SEEN)
        assert speed.tolist() == [1.0, 2.0, 3.0]
    else:
        assert testbed.read(context, "real.act.active").tolist() == [0.0, 0.0]
        assert look.value is None
        assert np.isnan(speed).all()


@pytest.mark.parametrize("mode", ["sim", "shadow", "real", "twin"])
def test_the_simulated_actuators_get_the_command_unless_the_real_ones_alone_do(mode):
    testbed, context = _testbed(mode)
    look, speed = testbed.read(context, "sim.act.look.y"), testbed.read(context, "sim.act.speed.y")
    if mode == "real":
        assert _matrix(look) == _matrix(IDLE)
        assert speed.tolist() == [7.0, 8.0, 9.0]
    else:
        assert _matrix(look) == _matrix(SEEN)
        assert speed.tolist() == [1.0, 2.0, 3.0]


def test_the_flags_are_those_of_each_signal():
    testbed, context = _testbed("sim")
    testbed.switch(context, act={"look": "twin"})
    assert testbed.read(context, "real.act.active").tolist() == [1.0, 0.0]
    testbed.switch(context, act={"look": "sim", "speed": "twin"})
    assert testbed.read(context, "real.act.active").tolist() == [0.0, 1.0]


def test_an_abstract_sensor_that_is_not_selected_is_not_evaluated():
    testbed, context = _testbed("real", sensor=Blind())
    assert _matrix(testbed.read(context, "dps.look")) == _matrix(SEEN)
    testbed.switch(context, "sim")
    with pytest.raises(AssertionError, match="it was evaluated"):
        testbed.read(context, "dps.look")


def test_an_abstract_command_that_is_not_selected_is_not_evaluated():
    testbed, context = _testbed("real", dps=Silent)
    assert _matrix(testbed.read(context, "sim.act.look.y")) == _matrix(IDLE)
    testbed.switch(context, act="sim")
    assert testbed.read(context, "real.act.look") == ActuatorCommand(None)
    with pytest.raises(AssertionError, match="it was evaluated"):
        testbed.read(context, "sim.act.look.y")


class PlacedScenario(AcrobotScenario):
    def add_world(self, builder):
        super().add_world(builder)
        builder.place("Acrobot", role="env")


def test_a_place_moves_the_addresses_of_a_model():
    usual, placed = AcrobotScenario().build(), PlacedScenario().build()
    of_acrobot = [address for address in usual.variables() if address.startswith("sim.sys.Acrobot.")]
    assert "sim.sys.Acrobot.shoulder.position" in of_acrobot
    assert not any(address.startswith("sim.sys.Acrobot.") for address in placed.variables())
    moved = {address.replace("sim.sys.", "sim.env.") for address in of_acrobot}
    assert moved == {address for address in placed.variables() if address.startswith("sim.env.Acrobot.")}
    context = placed.default_context()
    placed.write(context, {"sim.env.Acrobot.shoulder.position": 0.4})
    assert placed.plant.GetPositions(placed.plant.GetMyContextFromRoot(context))[0] == 0.4


@pytest.mark.parametrize(
    ("instance", "role", "message"),
    [
        ("Acrobat", "env", "the plant has no model instance Acrobat; it has: .*Acrobot"),
        ("Acrobot", "sense", "Acrobot belongs to sys or env, not to 'sense'"),
    ],
)
def test_a_place_that_is_none_is_refused(instance, role, message):
    class Misplaced(AcrobotScenario):
        def add_world(self, builder):
            super().add_world(builder)
            builder.place(instance, role=role)

    with pytest.raises(ValueError, match=message):
        Misplaced().build()
