"""A YAML file of Drake's hardware_sim describes the world of a testbed."""

import pickle
from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.manipulation import IiwaDriver
from pydrake.multibody.parsing import LoadModelDirectivesFromString
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import MatrixGain

from tests.lcm.iiwa import HOME, POSITION, TORQUE, IiwaScenario
from vtbdrake.rollout import RolloutRunner, RolloutTask
from vtbdrake.station.hardware_sim import HardwareSimScenario
from vtbdrake.testbed import Interface, ScenarioError, Signal, VirtualTestbedBuilder, load_scenario

# With all that the scenarios of Drake's examples/hardware_sim have, on models that come with Drake.
DEMO = """
Other:
  directives: []
Demo:
  simulator_config:
    max_step_size: 0.01
    target_realtime_rate: 1.0
  plant_config:
    time_step: 0.002
    contact_model: point
  scene_graph_config:
    default_proximity_properties:
      compliance_type: compliant
  directives:
  - add_model:
      name: table
      file: package://drake/examples/kuka_iiwa_arm/models/table/extra_heavy_duty_table_surface_only_collision.sdf
  - add_frame:
      name: table_on_world
      X_PF:
        base_frame: world
        translation: [0, -0.7, 0.1]
        rotation: !Rpy { deg: [0, 0, 90] }
  - add_weld:
      parent: table_on_world
      child: table::link
  - add_model:
      name: acrobot
      file: package://drake/examples/acrobot/Acrobot.urdf
      default_joint_positions:
        shoulder: [0.1]
        elbow: [0.2]
  lcm_buses:
    driver_traffic:
      lcm_url: udpm://239.241.129.92:20185?ttl=0
  cameras:
    oracular_view:
      name: camera_0
      width: 64
      height: 48
      X_PB:
        translation: [1.5, 0.8, 1.25]
        rotation: !Rpy { deg: [-120, 5, 125] }
  model_drivers:
    acrobot: !ZeroForceDriver {}
  initial_position:
    acrobot:
      shoulder: [0.5]
"""


@dataclass
class Station(HardwareSimScenario):
    def interface(self) -> Interface:
        return Interface(sense=[Signal("state", size=4)], act=[Signal("torque", size=1, idle=0.0)])

    def make_dps(self) -> Diagram:
        builder = DiagramBuilder()
        gain = builder.AddNamedSystem("gain", MatrixGain(np.zeros((1, 4))))
        builder.ExportInput(gain.get_input_port(), "state")
        builder.ExportOutput(gain.get_output_port(), "torque")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        self.add_models(builder)
        self.add_cameras(builder)
        plant = builder.plant
        builder.sim_sensor("state", plant.get_state_output_port(plant.GetModelInstanceByName("acrobot")))
        builder.sim_actuator("torque", plant.get_actuation_input_port())


def load(folder, text=DEMO):
    (folder / "scenarios.yaml").write_text(text)
    return load_scenario(f"{__name__}:Station@{folder / 'scenarios.yaml'}#Demo")


def test_models_start_at_their_initial_positions(tmp_path):
    testbed = load(tmp_path).build()
    context = testbed.default_context()
    assert testbed.read(context, "sim.sys.acrobot.shoulder.position") == 0.5
    assert testbed.read(context, "sim.sys.acrobot.elbow.position") == 0.2
    table = testbed.plant.GetBodyByName("link", testbed.plant.GetModelInstanceByName("table"))
    X_WT = table.EvalPoseInWorld(testbed.plant.GetMyContextFromRoot(context))
    np.testing.assert_allclose(X_WT.translation(), [0.0, -0.7, 0.1])
    assert testbed.plant.time_step() == 0.002


@pytest.mark.parametrize(("driver", "warns"), [("ZeroForceDriver", False), ("SchunkWsgDriver", True)])
def test_a_driver_that_is_not_simulated_is_told(tmp_path, caplog, driver, warns):
    load(tmp_path, DEMO.replace("ZeroForceDriver", driver)).build()
    warning = "the model_drivers of acrobot are not simulated: call add_drivers, or connect an actuator signal to these"
    assert [f"{warning} models"] * warns == [
        record.getMessage() for record in caplog.records if "driver" in record.getMessage()
    ]


def test_a_camera_sees_the_world(tmp_path):
    testbed = load(tmp_path).build()
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(0.01)
    image = testbed.read(context, "sim.sense.camera_0.color_image")
    assert (image.width(), image.height()) == (64, 48)
    background = np.array([204, 229, 255])
    seen = np.abs(image.data[:, :, :3].astype(int) - background).max(axis=2) > 2
    assert 0.01 < seen.mean() < 0.99


def test_the_scenario_survives_pickle_and_file(tmp_path):
    scenario = load(tmp_path)
    assert pickle.loads(pickle.dumps(scenario)) == scenario
    scenario.save(tmp_path / "saved.yaml")
    assert load_scenario(tmp_path / "saved.yaml") == scenario


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("add_weld:\n      parent", "add_weld:\n      parrent", "AddWeld has no field .*parrent"),
        ("child: table::link", "child: table::leg", "the models cannot be added: .*leg"),
        ("shoulder: [0.5]", "shoulder: [0.5, 0.6]", "the models cannot be added: .*shoulder"),
        ("name: camera_0", "name: camera_0\n      output_delay: 0.1", "oracular_view has a capture_offset or output"),
        ("name: camera_0", "name: camera_0\n      renderer_class: Magic", "Magic"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, old, new, message):
    with pytest.raises(ScenarioError, match=message):
        load(tmp_path, DEMO.replace(old, new)).build()


ELBOW = "sim.sys.iiwa.iiwa_joint_4.position"


@pytest.mark.parametrize("mode", [TORQUE, POSITION])
def test_rollout_with_drakes_driver_of_an_iiwa_is_the_future(mode):
    scenario = IiwaScenario(mode=mode)
    testbed = scenario.build()
    simulator = testbed.simulator()
    context = simulator.get_mutable_context()
    testbed.write(context, {"u.target": HOME + 0.1})
    simulator.AdvanceTo(0.2)
    task = RolloutTask(scenario, 0.2, record=[ELBOW], sample_period=0.05, start=testbed.fork(simulator))
    forecast = RolloutRunner(task).run({}).record[ELBOW]
    future = [testbed.read(context, ELBOW)]
    for instant in task.instants(0.2, testbed.event_timings())[1:]:
        simulator.AdvanceTo(instant)
        future.append(testbed.read(context, ELBOW))
    np.testing.assert_array_equal(forecast, future)
    assert np.ptp(forecast) > 0.01


def test_two_iiwas_have_a_driver_each(caplog):
    scenario = IiwaScenario()
    other = scenario.directives[0].add_model
    scenario.directives += LoadModelDirectivesFromString(f"""
directives:
- add_model: {{ name: left, file: "{other.file}" }}
- add_weld: {{ parent: world, child: "left::iiwa_link_0", X_PC: {{ translation: [0, 1, 0] }} }}
""").directives
    scenario.model_drivers["left"] = IiwaDriver(control_mode=POSITION)
    builder = VirtualTestbedBuilder(scenario.interface())
    drivers = scenario.add_drivers(builder, scenario.add_models(builder))
    assert {name: driver.get_name() for name, driver in drivers.items()} == {
        "iiwa": "sim.act.iiwa",
        "left": "sim.act.left",
    }
    assert drivers["iiwa"].HasInputPort("torque") and drivers["left"].HasInputPort("position")
    assert "not simulated" not in caplog.text


def test_driver_of_an_iiwa_that_does_not_fit_is_named():
    scenario = IiwaScenario()
    scenario.model_drivers["iiwa"] = IiwaDriver(hand_model_name="gripper")
    with pytest.raises(ScenarioError, match=r"iiwa.hand_model_name: .*'gripper', which no add_model .*: iiwa, hand"):
        scenario.build()
