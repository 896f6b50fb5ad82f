"""A process of plain Drake that runs hardware_sim's loop on an LCM bus; `HardwareSim` starts it."""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm

from benchmarks import hardware_sim_loop
from tests.lcm.plain_drake import PlainDrake
from vtbdrake_diagrams.station import FILE

PERIOD = 0.005
"""The period in s in which Drake's driver of the arm publishes its status."""
STEP = 0.001
"""The time step of the plant, in s."""


class HardwareSim(PlainDrake):
    """The machine: hardware_sim with the station of a file, stepped by the test or in real time.

    Attributes:
        openings: The distance of the gripper's fingers at the end of each period, in m.

    Args:
        url: The URL of the LCM bus.
        key: The station.
        offset: How far all joints of the arm are from the file's positions at first, in rad.
        cameras: Whether the cameras send their images.
        real_time: Whether it runs by itself; else, `advance` steps it.
    """

    def __init__(
        self, url: str, key: str, *, offset: float = 0.0, cameras: bool = False, real_time: bool = False
    ) -> None:
        self.openings: list[float] = []
        options = json.dumps({"offset": offset, "cameras": cameras, "real_time": real_time})
        super().__init__(__name__, url, key, options)

    def advance(self, commands: int) -> dict[str, Any]:
        answer = super().advance(commands)
        self.openings.append(answer["opening"])
        return answer


def main(url: str, key: str, options: str) -> None:
    asked = json.loads(options)
    real_time = asked.pop("real_time")
    if real_time:
        urls = {"iiwa": url, "wsg": url}
        hardware_sim_loop.build(FILE, key, urls=urls, rate=1.0, **asked).simulator.AdvanceTo(np.inf)
    bus = DrakeLcm(url)
    heard: list[bytes] = []
    bus.Subscribe("IIWA_COMMAND", heard.append)
    sim = hardware_sim_loop.build(FILE, key, urls={}, bus=bus, **asked)
    plant, context = sim.plant, sim.plant.GetMyContextFromRoot(sim.simulator.get_context())
    arm, gripper = (plant.GetModelInstanceByName(name) for name in ("iiwa", "wsg"))
    sim.simulator.Initialize()
    steps = round(PERIOD / STEP)
    for number, line in enumerate(sys.stdin):
        while len(heard) < int(line):
            bus.HandleSubscriptions(100)
        actuation = []
        for k in range(steps):
            sim.simulator.AdvanceTo((number * steps + k + 1) * STEP)
            actuation.append(plant.get_actuation_input_port(arm).Eval(context).tolist())
        left, right = plant.GetPositions(context, gripper)
        answer = {
            "actuation": actuation,
            "position": plant.GetPositions(context, arm).tolist(),
            "opening": right - left,
        }
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
