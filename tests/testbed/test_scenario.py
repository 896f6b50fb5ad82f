"""Scenarios travel as plain data; a file that does not fit is refused with the reason."""

import os
import pickle

import numpy as np
import pytest

from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.state import AddressError
from vtbdrake.testbed import ScenarioError, SimulatorFields, load_scenario

NAME = "tests.testbeds:AcrobotScenario"
# Ten lines that stand for ten thousand million entries.
LAUGHS = "  x0: &x0 1\n" + "".join(f"  x{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 10)}]\n" for i in range(1, 11))


def test_a_scenario_survives_file_and_pickle(tmp_path):
    scenario = AcrobotScenario(period=0.05, simulator=SimulatorFields(integration_scheme="cenic", accuracy=1e-3))
    scenario.save(tmp_path / "s.yaml")
    assert load_scenario(tmp_path / "s.yaml") == scenario
    assert pickle.loads(pickle.dumps(scenario)) == scenario


def test_a_file_names_its_class_and_what_differs(tmp_path):
    (tmp_path / "s.yaml").write_text(f"{NAME}:\n  period: 0.1\n  simulator:\n    accuracy: 1.0e-3\n")
    scenario = load_scenario(tmp_path / "s.yaml")
    assert isinstance(scenario, AcrobotScenario)
    assert (scenario.period, scenario.simulator.accuracy, scenario.time_step) == (0.1, 1e-3, 0.0)
    assert load_scenario(NAME) == AcrobotScenario()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{NAME}:\n  perod: 0.1\n", "perod"),
        (f"{NAME}:\n  simulator:\n    acuracy: 0.1\n", "acuracy"),
        (f"{NAME}:\n  period: 0.1\n  period: 0.2\n", "the key 'period' twice"),
        (f"{NAME}:\n  period: fast\n", "fast"),
        (f"{NAME}:\n  period: .nan\n", "period must be finite"),
        (f"{NAME}:\n  simulator:\n    integration_scheme: magic\n", "is one of bogacki_shampine3, cenic"),
        (f"{NAME}:\n  simulator:\n    accuracy: 0.0\n", "positive max_step_size and accuracy"),
        ("tests.testbeds:Nothing:\n  period: 0.1\n", "no scenario 'Nothing'; it has: .*AcrobotScenario"),
        ("nowhere.at.all:Nothing:\n  period: 0.1\n", "to import its module runs its code: .* nowhere.at.all:Nothing@"),
        ("a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n", "named package.module:Class"),
        ("a:\n" + LAUGHS, "more than 100000 entries"),
        ("[" * 5000, "is not YAML"),
        ("period: 0.1\nother: 1\n", "must have one key"),
        ("[1, 2", "is not YAML"),
        ("", "must have one key"),
    ],
)
def test_a_bad_file_is_refused(tmp_path, text, message):
    (tmp_path / "s.yaml").write_text(text)
    with pytest.raises(ScenarioError, match=message):
        load_scenario(tmp_path / "s.yaml")


def test_the_user_may_name_the_class_of_a_file(tmp_path):
    AcrobotScenario(period=0.05).save(tmp_path / "s.yaml")
    assert load_scenario(f"{NAME}@{tmp_path / 's.yaml'}") == AcrobotScenario(period=0.05)
    with pytest.raises(ScenarioError, match="not of tests.testbeds:PendulumScenario"):
        load_scenario(f"tests.testbeds:PendulumScenario@{tmp_path / 's.yaml'}")


def test_a_class_may_be_named_by_any_module_that_has_it(tmp_path):
    AcrobotScenario(period=0.05).save(tmp_path / "s.yaml")
    assert load_scenario(f"{__name__}:AcrobotScenario@{tmp_path / 's.yaml'}") == AcrobotScenario(period=0.05)


def test_a_module_that_cannot_be_imported_is_named(tmp_path, monkeypatch):
    (tmp_path / "broken_module.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ScenarioError, match="cannot import broken_module, .*ZeroDivisionError"):
        load_scenario("broken_module:Scenario")


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "s.yaml")
    with pytest.raises(ScenarioError, match="no file of YAML"):
        load_scenario(tmp_path / "s.yaml")


def test_a_scenario_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ScenarioError, match="there is no scenario file"):
        load_scenario(tmp_path / "missing.yaml")
    with pytest.raises(ScenarioError, match=r"named package.module:Class"):
        load_scenario("AcrobotScenario")


def test_ports_and_variables_are_read_by_address():
    testbed = PendulumScenario(stiffness=2.0).build()
    context = testbed.default_context()
    testbed.write(context, {"u.angle": 0.25})
    assert testbed.read(context, "dps.torque") == pytest.approx([0.5])
    assert testbed.read(context, "plant.state").tolist() == [0.0, 0.0]
    assert testbed.read(context, "time") == 0.0
    with pytest.raises(AddressError, match="no variable and no output port 'dps.torqe'; did you mean dps.torque"):
        testbed.read(context, "dps.torqe")


def test_what_is_fixed_to_the_world_is_environment():
    addresses = set(PendulumScenario().build().variables())
    assert "sim.sys.Pendulum.arm.mass" in addresses
    assert not any(address.startswith("plant") for address in addresses)


def test_cenic_without_error_control_gives_fresh_poses_or_is_refused():
    """Drake 1.51 leaves the poses of its fixed steps one step behind; what is accepted must be right."""
    fields = SimulatorFields("cenic", max_step_size=0.02, use_error_control=False)
    scenario = AcrobotScenario(simulator=fields)
    try:
        testbed = scenario.build()
    except ScenarioError as error:
        assert "poses one step behind" in str(error)
        return
    context = testbed.default_context()
    testbed.write(context, {"sim.sys.Acrobot.shoulder.position": 1.0})
    testbed.simulator(context).AdvanceTo(0.5)
    height = testbed.read(context, "sim.sys.Acrobot.lower_link.height")
    shoulder = testbed.read(context, "sim.sys.Acrobot.shoulder.position")
    # The upper link is 1 m long.
    assert height == pytest.approx(-np.cos(shoulder), abs=1e-9)
