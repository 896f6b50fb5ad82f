"""Scenarios travel as plain data, with other fields too; a file that does not fit is rejected."""

import os
import pickle
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import DiagramBuilder

from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.state import AddressError, Snapshot, SnapshotError
from vtbdrake.station import Station
from vtbdrake.testbed import DpsAlone, Scenario, ScenarioError, load_scenario
from vtbdrake.testbed.scenario_file import compose_yaml
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

ROOT = Path(__file__).resolve().parents[2]
NAME = "tests.testbeds:AcrobotScenario"
# Ten lines that stand for ten thousand million entries.
LAUGHS = "  x0: &x0 1\n" + "".join(f"  x{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 10)}]\n" for i in range(1, 11))


def test_a_scenario_survives_file_and_pickle(tmp_path):
    scenario = AcrobotScenario(period=0.05, simulator_config=SimulatorConfig(integration_scheme="cenic", accuracy=1e-3))
    scenario.save(tmp_path / "s.yaml")
    assert load_scenario(tmp_path / "s.yaml") == scenario
    assert pickle.loads(pickle.dumps(scenario)) == scenario


def test_a_file_names_its_class_and_what_differs(tmp_path):
    (tmp_path / "s.yaml").write_text(f"{NAME}:\n  period: 0.1\n  simulator_config:\n    accuracy: 1.0e-3\n")
    scenario = load_scenario(tmp_path / "s.yaml")
    assert isinstance(scenario, AcrobotScenario)
    assert (scenario.period, scenario.simulator_config.accuracy, scenario.time_step) == (0.1, 1e-3, 0.0)
    assert load_scenario(NAME) == AcrobotScenario()


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{NAME}:\n  perod: 0.1\n", "line 2: AcrobotScenario has no field 'perod'; did you mean period"),
        (
            f"{NAME}:\n  period: 0.1\n  simulator_config:\n    acuracy: 0.1\n",
            "line 4: SimulatorConfig has no field 'simulator_config.acuracy'; did you mean accuracy",
        ),
        (f"{NAME}:\n  zzz: 0.1\n", "no field 'zzz'; it has: simulator_config, pedigree, period, time_step"),
        (f"{NAME}:\n  simulator_config: &a\n    <<: {{acuracy: 0.1}}\n", "'simulator_config.acuracy'"),
        (f"{NAME}:\n  period: 0.1\n  period: 0.2\n", "the key 'period' twice"),
        (f"{NAME}:\n  period: 010\n", "s.yaml: line 2: 010 is a number to the base 8 in YAML: write it to the base 10"),
        (f"{NAME}:\n  time_step: 0.1\n  period: 1:30\n", "line 3: 1:30 is a number to the base 60 in YAML"),
        (f"{NAME}:\n  period: -1:30.5\n", "line 2: -1:30.5 is a number to the base 60 in YAML"),
        (f"{NAME}:\n  period: fast\n", "fast"),
        (f"{NAME}:\n  period: .nan\n", "period must be a finite number, not nan"),
        (f"{NAME}:\n  simulator_config:\n    integration_scheme: magic\n", "is one of bogacki_shampine3, cenic"),
        (f"{NAME}:\n  simulator_config:\n    accuracy: 0.0\n", "positive max_step_size and accuracy"),
        ("tests.testbeds:Nothing:\n  period: 0.1\n", "no scenario 'Nothing'; it has: .*AcrobotScenario"),
        ("nowhere.at.all:Nothing:\n  period: 0.1\n", "to import its module runs its code: .* nowhere.at.all:Nothing@"),
        ("a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n", "named package.module:Class"),
        ("a:\n" + LAUGHS, "more than 100000 entries"),
        ("[" * 5000, "is not YAML"),
        ("period: 0.1\nother: 1\n", "must have one key"),
        ("period: 0.1\n", "must have one key"),
        ("[1, 2", "is not YAML"),
        ("", "must have one key"),
    ],
)
def test_a_bad_file_is_refused(tmp_path, text, message):
    (tmp_path / "s.yaml").write_text(text)
    with pytest.raises(ScenarioError, match=message):
        load_scenario(tmp_path / "s.yaml")


@pytest.mark.parametrize("number", ["0", "0.0", "00.5", "10", "0e1", "'010'", "0x10"])
def test_numbers_that_mean_what_they_look_like_are_read(tmp_path, number):
    (tmp_path / "s.yaml").write_text(f"{NAME}:\n  period: {number}\n")
    node = compose_yaml(tmp_path / "s.yaml")
    assert node.value[0][1].value[0][1].value == number.strip("'")


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


@dataclass
class Rock:
    radius: float = 0.1


@dataclass
class Boulder:
    radius: float = 1.0
    cracks: list[Rock] = field(default_factory=list)


@dataclass
class RockyScenario(AcrobotScenario):
    rocks: list[Rock] = field(default_factory=list)
    named: dict[str, Rock] = field(default_factory=dict)
    largest: Rock | Boulder | None = None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rocks: [{radius: 0.1}, {radios: 0.2}]", "Rock has no field 'rocks.radios'; did you mean radius"),
        (
            "named: {one: {radius: 0.1}, two: {radios: 0.2}}",
            "Rock has no field 'named.two.radios'; did you mean radius",
        ),
        ("largest: !Boulder {cracks: [{radios: 0.2}]}", "Rock has no field 'largest.cracks.radios'"),
        ("largest: {cracks: []}", "Rock has no field 'largest.cracks'"),
    ],
)
def test_a_misspelt_key_is_found_at_every_level(tmp_path, text, message):
    (tmp_path / "s.yaml").write_text(f"{__name__}:RockyScenario:\n  {text}\n")
    with pytest.raises(ScenarioError, match=message):
        load_scenario(tmp_path / "s.yaml")


def test_what_is_spelt_right_at_every_level_is_read(tmp_path):
    text = "rocks: [{radius: 0.2}]\n  named: {one: {radius: 0.3}}\n  largest: !Boulder {cracks: [{radius: 0.4}]}"
    (tmp_path / "s.yaml").write_text(f"{__name__}:RockyScenario:\n  {text}\n")
    scenario = load_scenario(tmp_path / "s.yaml")
    assert scenario.rocks == [Rock(0.2)] and scenario.named == {"one": Rock(0.3)}
    assert scenario.largest == Boulder(1.0, [Rock(0.4)])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"period": "0.1"}, "AcrobotScenario.period must be a finite number, not '0.1'"),
        ({"period": [0.1]}, "AcrobotScenario.period must be a finite number, not .0.1."),
        ({"simulator_config": SimulatorConfig(integration_scheme="magic")}, "integration_scheme is one of"),
        ({"simulator_config": SimulatorConfig(start_time=1.0)}, "start_time must be 0, not 1.0 s"),
        ({"simulator_config": None}, "simulator_config is a SimulatorConfig of Drake, not None"),
    ],
)
def test_a_value_of_another_type_is_refused_at_build(values, message):
    with pytest.raises(ScenarioError, match=message):
        AcrobotScenario(**values).build()
    AcrobotScenario(period=np.float64(0.02)).validate()


class Undecorated(AcrobotScenario):
    extra: float = 1.0


def test_a_field_that_is_none_is_refused():
    with pytest.raises(ScenarioError, match="Undecorated.extra is no field: decorate Undecorated with @dataclass"):
        Undecorated().build()


def test_what_is_no_scenario_is_refused():
    for value in (None, AcrobotScenario, "acrobot"):
        with pytest.raises(ValueError, match="a scenario is an instance"):
            DpsAlone(value)


def test_a_failed_assertion_of_drake_does_not_end_the_process():
    with pytest.raises(RuntimeError, match=r"AcrobotScenario\(time_step=-0.1\) cannot be built: .* 'time_step >= 0'"):
        AcrobotScenario(time_step=-0.1).build()


def test_a_context_of_another_build_is_refused():
    scenario = PendulumScenario()
    testbed, other = scenario.build(), scenario.build()
    foreign = other.default_context()
    own = testbed.default_context()
    alone = DpsAlone(scenario)
    for use in (
        lambda context: testbed.read(context, "time"),
        lambda context: testbed.write(context, {"u.angle": 0.1}),
        testbed.snapshot,
        lambda context: testbed.restore(context, testbed.snapshot(own)),
        testbed.simulator,
        testbed.positions,
        lambda context: testbed.switch(context, "sim"),
        testbed.start_from_belief,
        lambda context: alone.restore(context, testbed.snapshot(own)),
    ):
        for context in (foreign, testbed.plant.GetMyContextFromRoot(own)):
            with pytest.raises(ValueError, match="no context of this testbed, but of another one"):
                use(context)


def test_a_testbed_works_inside_another_diagram():
    testbed, builder = PendulumScenario().build(), DiagramBuilder()
    builder.AddSystem(testbed.diagram)
    outer = builder.Build()
    context = outer.CreateDefaultContext()
    testbed.write(context, {"sim.sys.Pendulum.theta.position": 0.3, "u.angle": 0.1})
    np.testing.assert_array_equal(testbed.read(context, "plant.state"), [0.3, 0.0])
    np.testing.assert_array_equal(testbed.read(context, "real.sense.joint_state"), [np.nan, np.nan])
    with pytest.raises(ValueError, match="nothing feeds real.sense.joint_state"):
        testbed.switch(context, "real")
    own = testbed.diagram.GetMyMutableContextFromRoot(context)
    testbed.diagram.GetInputPort("real.sense.joint_state").FixValue(own, [7.0, 0.0])
    testbed.switch(context, "real")
    np.testing.assert_array_equal(testbed.read(context, "dps.error.sum"), [-6.9])
    with pytest.raises(ValueError, match="simulate that diagram"):
        testbed.simulator(context)


def test_values_that_are_no_mapping_are_refused():
    testbed = PendulumScenario().build()
    with pytest.raises(ValueError, match=r"by {address: value, ...}, not by \['u.angle', 0.1\]"):
        testbed.write(testbed.default_context(), ["u.angle", 0.1])


@pytest.mark.parametrize("at", [0.0, 0.1])
def test_cenic_is_not_asked_for_a_step_of_no_length(at):
    testbed = PendulumScenario(simulator_config=SimulatorConfig(integration_scheme="cenic", accuracy=1e-3)).build()
    simulator = testbed.simulator()
    if at:
        simulator.AdvanceTo(at)
    for step in (simulator.AdvancePendingEvents, lambda: simulator.AdvanceTo(at)):
        with pytest.raises(ValueError, match=f"at {at} s already, and CENIC takes no step of length zero"):
            step()
    simulator.AdvanceTo(at + 0.1)
    assert simulator.get_context().get_time() == at + 0.1


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
    with pytest.raises(AddressError, match="no variable and no port 'dps.torqe'; did you mean dps.torque"):
        testbed.read(context, "dps.torqe")


def test_what_is_fixed_to_the_world_is_environment():
    addresses = set(PendulumScenario().build().variables())
    assert "sim.sys.Pendulum.arm.mass" in addresses
    assert not any(address.startswith("plant") for address in addresses)


def test_cenic_without_error_control_gives_fresh_poses_or_is_refused():
    """Drake 1.51 leaves the poses of its fixed steps one step behind; what is accepted must be right."""
    fields = SimulatorConfig(integration_scheme="cenic", max_step_size=0.02, use_error_control=False)
    scenario = AcrobotScenario(simulator_config=fields)
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


def test_a_scenario_with_drake_configs_pickles():
    config = SimulatorConfig(integration_scheme="cenic", accuracy=1e-3)
    scenario = SpaceClimberScenario(simulator_config=config, gravity=3.71)
    copied = pickle.loads(pickle.dumps(scenario))
    assert copied == scenario
    assert copied.plant_config.contact_model == "point"


@pytest.mark.slow
def test_a_scenario_is_sent_to_a_process_pool_before_anything_else_was():
    program = (
        "from concurrent.futures import ProcessPoolExecutor as Pool; from multiprocessing import get_context\n"
        "from vtbdrake_diagrams.space_climber import SpaceClimberScenario as Scenario\n"
        "pool = Pool(1, mp_context=get_context('spawn'))\n"
        "print(pool.submit(Scenario.record, Scenario(gravity=3.71)).result() == Scenario(gravity=3.71).record())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert done.stdout == "True\n", done.stderr


def test_scenarios_that_differ_inside_a_config_are_unequal():
    assert AcrobotScenario() == AcrobotScenario()
    assert AcrobotScenario() != AcrobotScenario(simulator_config=SimulatorConfig(accuracy=1e-5))


def test_a_scenario_shows_what_differs_from_its_defaults():
    scenario = SpaceClimberScenario(gravity=3.71, simulator_config=SimulatorConfig(max_step_size=0.2))
    assert repr(scenario) == "SpaceClimberScenario(simulator_config=SimulatorConfig(max_step_size=0.2), gravity=3.71)"


def test_older_files_with_the_key_simulator_load(tmp_path):
    (tmp_path / "s.yaml").write_text(f"{NAME}:\n  simulator:\n    accuracy: 1.0e-3\n")
    assert load_scenario(tmp_path / "s.yaml").simulator_config.accuracy == 1e-3


def test_the_pace_of_a_simulation_does_not_identify_it():
    fields = {"accuracy": 1e-6, "max_step_size": 0.05, "target_realtime_rate": 1.0}
    paced = AcrobotScenario(simulator_config=SimulatorConfig(**fields))
    assert paced.record() == AcrobotScenario().record()
    assert paced.record()["simulator.accuracy"] == 1e-6


def test_a_key_chooses_one_of_several_scenarios_in_a_file(tmp_path):
    (tmp_path / "s.yaml").write_text("Slow:\n  period: 0.1\nFast:\n  period: 0.01\n")
    assert load_scenario(f"{NAME}@{tmp_path / 's.yaml'}#Fast").period == 0.01
    with pytest.raises(ScenarioError, match="has no key 'Medium'; it has: Slow, Fast"):
        load_scenario(f"{NAME}@{tmp_path / 's.yaml'}#Medium")


@dataclass
class Varied(AcrobotScenario):
    gait: str = "tripod"
    legs: int = 6
    stops: bool = False
    height: "float | None" = None
    places: list[float] = field(default_factory=lambda: [1.0, 2.0])

    def validate(self):
        super().validate()
        if self.legs < 4:
            raise ScenarioError(f"Varied.legs must be at least 4, not {self.legs}")


@dataclass
class Incomplete(AcrobotScenario):
    mass: float = field(kw_only=True)


def test_a_scenario_with_a_field_without_default_is_loaded_neither_by_name_nor_from_a_file(tmp_path):
    Incomplete(mass=1.0).save(tmp_path / "a.yaml")
    for source in (f"{__name__}:Incomplete", tmp_path / "a.yaml"):
        with pytest.raises(ScenarioError, match=r"Incomplete\.mass has no default: give it one"):
            load_scenario(source)


@dataclass
class Remembering(AcrobotScenario):
    extra: object = None


@pytest.mark.parametrize("extra", [np.int64(3), [np.float32(0.5)], Path("maps/a.csv")])
def test_a_snapshot_with_fields_of_numpy_and_paths_is_saved(extra):
    testbed = Remembering(extra=extra).build()
    context = testbed.default_context()
    testbed.restore(context, Snapshot.load(testbed.snapshot(context).to_bytes()))
    with pytest.raises(SnapshotError, match="of another scenario"):
        Remembering(extra=4).build().check_scenario(Snapshot.load(testbed.snapshot(context).to_bytes()))


def test_a_field_that_no_file_can_hold_is_named():
    testbed = Remembering(extra={"a": {1, 2}}).build()
    with pytest.raises(ValueError, match="the scenario's field extra.a is a set, which no file can hold"):
        testbed.snapshot(testbed.default_context()).to_bytes()


@dataclass
class Paired(AcrobotScenario):
    pair: tuple[float, ...] = (1.0, 2.0)


def test_a_field_that_no_yaml_can_hold_is_named(tmp_path):
    with pytest.raises(ScenarioError, match=r"no file can hold Paired.pair, a tuple\[float, ...\]: make it of"):
        Paired().save(tmp_path / "scenario.yaml")
    assert not list(tmp_path.iterdir())


def test_fields_are_set_in_a_copy_nested_ones_too():
    scenario = Varied()
    values = {
        "gait": "wave",
        "legs": 8,
        "stops": True,
        "height": 0.5,
        "period": 0.04,
        "simulator_config.accuracy": 1e-3,
    }
    changed = scenario.with_fields(values)
    expected = Varied(SimulatorConfig(accuracy=1e-3, max_step_size=0.05), 0.04, 0.0, "wave", 8, True, 0.5)
    assert changed == expected
    assert type(changed) is Varied
    assert scenario == Varied()
    assert changed.places is not scenario.places


@pytest.mark.parametrize(
    ("name", "given", "kept"),
    [
        ("period", 1, 1.0),
        ("period", np.float64(0.5), 0.5),
        ("period", np.int64(2), 2.0),
        ("period", np.array(0.5), 0.5),
        ("height", 2, 2.0),
        ("legs", np.int64(4), 4),
        ("stops", np.bool_(True), True),
        ("gait", np.str_("wave"), "wave"),
    ],
)
def test_what_is_meant_is_taken_as_pythons_own_type(name, given, kept):
    value = getattr(Varied().with_fields({name: given}), name)
    assert value == kept
    assert type(value) is type(kept)


@pytest.mark.parametrize(
    ("base", "field", "method"),
    [(Scenario, "name", "name"), (AcrobotScenario, "samples", "samples"), (Station, "signals", "signals")],
)
def test_a_field_under_the_name_of_a_method_is_refused(base, field, method):
    owner = next(kind.__name__ for kind in base.__mro__ if method in vars(kind))
    message = f"Robot.{field} would replace the method {method} of {owner}: give it another name, such as robot_{field}"
    with pytest.raises(ScenarioError, match=message):
        type("Robot", (base,), {"__annotations__": {field: str}, field: "a"})
    with pytest.raises(ScenarioError, match=message):
        type("Robot", (base,), {field: "a"})


def test_a_field_that_may_be_none_is_set_back_to_none():
    assert Varied(height=0.4).with_fields({"height": None}) == Varied()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"gaitt": "wave"}, "Varied has no field 'gaitt' .*did you mean gait"),
        (
            {"simulator_config.acuracy": 1.0},
            "did you mean simulator_config.accuracy",
        ),
        ({"simulator_config": SimulatorConfig()}, "no field 'simulator_config'"),
        ({"places": [1.0]}, "no field 'places'"),
        ({"legs": 6.0}, "Varied.legs must be a whole number, not 6.0"),
        ({"legs": True}, "legs must be a whole number, not True"),
        ({"period": True}, "period must be a finite number, not True"),
        ({"period": "fast"}, "a finite number, not 'fast'"),
        ({"period": [0.1]}, "a finite number, not .0.1."),
        ({"period": None}, "a finite number, not None"),
        ({"height": "low"}, "Varied.height must be a finite number, not 'low'"),
        ({"gait": 3}, "gait must be a text, not 3"),
        ({"stops": 1}, "stops must be True or False, not 1"),
        ({"legs": 3}, "must be at least 4, not 3"),
        ({"period": float("nan")}, "Varied.period must be a finite number, not nan"),
    ],
)
def test_what_does_not_fit_is_refused(values, message):
    with pytest.raises(ScenarioError, match=message):
        Varied().with_fields(values)
