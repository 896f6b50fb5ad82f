"""A process of plain Drake with its own driver of an iiwa on an LCM bus; `DrakeIiwa` starts it and steps it."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Self

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.manipulation import ApplyDriverConfigs, IiwaDriver
from pydrake.multibody.parsing import ModelDirectives, Parser, ProcessModelDirectives
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.lcm import LcmBuses, LcmInterfaceSystem

from tests.lcm.iiwa import HOME, PERIOD, directives

STEP = 0.001
"""The time step of the plant, in s."""


class DrakeIiwa:
    """The machine: it is stepped by the test, so that nothing depends on a clock.

    Attributes:
        actuation: The torques on the joints in each step of the plant, in N m.
        positions: The joint positions at the end of each period, in rad.

    Args:
        url: The URL of the LCM bus.
        mode: The control mode.
        offset: How far all joints are from `HOME` at first, in rad.
    """

    def __init__(self, url: str, mode: str, *, offset: float = 0.0) -> None:
        self.actuation: list[np.ndarray] = []
        self.positions: list[np.ndarray] = []
        command = [sys.executable, "-m", __name__, url, mode, str(offset)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def advance(self, commands: int) -> None:
        """Wait until so many commands have arrived in all, advance by a period, and publish the status."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(commands, file=self._process.stdin, flush=True)
        answer = json.loads(self._process.stdout.readline())
        self.actuation += map(np.array, answer["actuation"])
        self.positions.append(np.array(answer["position"]))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()


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
