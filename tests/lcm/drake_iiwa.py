"""A process of plain Drake with its own driver of an iiwa on an LCM bus; `DrakeIiwa` starts it and steps it."""

from __future__ import annotations

import json
import sys

from pydrake.lcm import DrakeLcm
from pydrake.manipulation import ApplyDriverConfigs, IiwaDriver
from pydrake.multibody.parsing import ModelDirectives, Parser, ProcessModelDirectives
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.lcm import LcmBuses, LcmInterfaceSystem

from tests.lcm.iiwa import HOME, PERIOD, directives
from tests.lcm.plain_drake import PlainDrake

STEP = 0.001
"""The time step of the plant, in s."""


class DrakeIiwa(PlainDrake):
    """The machine.

    Args:
        url: The URL of the LCM bus.
        mode: The control mode.
        offset: How far all joints are from `HOME` at first, in rad.
    """

    def __init__(self, url: str, mode: str, *, offset: float = 0.0) -> None:
        super().__init__(__name__, url, mode, str(offset))


def main(url: str, mode: str, offset: str) -> None:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=STEP), builder)
    models = ProcessModelDirectives(ModelDirectives(directives=directives()), Parser(plant))
    plant.Finalize()
    bus, buses = DrakeLcm(url), LcmBuses()
    builder.AddSystem(LcmInterfaceSystem(bus))
    buses.Add("default", bus)
    driver = IiwaDriver(control_mode=mode, hand_model_name="hand")
    ApplyDriverConfigs(
        driver_configs={"iiwa": driver},
        sim_plant=plant,
        models_from_directives=models,
        lcm_buses=buses,
        builder=builder,
    )
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    own, arm = plant.GetMyMutableContextFromRoot(context), plant.GetModelInstanceByName("iiwa")
    plant.SetPositions(own, arm, HOME + float(offset))

    heard: list[bytes] = []
    bus.Subscribe("IIWA_COMMAND", heard.append)
    simulator.Initialize()
    period = round(PERIOD / STEP)
    for number, line in enumerate(sys.stdin):
        while len(heard) < int(line):
            bus.HandleSubscriptions(100)
        actuation = []
        for k in range(period):
            simulator.AdvanceTo((number * period + k + 1) * STEP)
            actuation.append(plant.get_actuation_input_port(arm).Eval(own).tolist())
        print(json.dumps({"actuation": actuation, "position": plant.GetPositions(own, arm).tolist()}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
