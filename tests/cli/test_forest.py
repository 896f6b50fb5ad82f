"""The programs of the localization unit: machine, loop and the driver's display, each in a process of its own."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import dataclass, replace
from math import inf

import numpy as np
import pytest
from click.testing import CliRunner
from tornado.websocket import websocket_connect

from tests.cli.program import ROOT
from tests.diagrams.forest.riding import RidingScenario, motion
from tests.visualization.meshcat_page import decoded
from tests.web.serving.entrance import entered
from vtbdrake.components.localization.landmarks import map_landmarks
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.hub import Hub
from vtbdrake.testbed import Interface
from vtbdrake_diagrams.forest.pictures.display import main, program

SCENARIO = "tests.cli.test_forest:PatientScenario"
SEED = 4
TIMEOUT = 120.0  # s; for a computer that is busy with other things


@dataclass
class PatientScenario(RidingScenario):
    """A ride on which no delay of a busy computer is a fault."""

    localizer_latency: float = 0.5

    def interface(self) -> Interface:
        declared = super().interface()
        return replace(declared, sense=[replace(signal, max_age=TIMEOUT) for signal in declared.sense])

    def deployment(self) -> Deployment:
        deployment = super().deployment()
        return replace(deployment, guards={**deployment.guards, "max_missed": inf})


def start(module: str, *arguments: object) -> subprocess.Popen[str]:
    fields = ("--field", f"seed={SEED}", "--field", f"stand_seed={SEED}")
    command = [sys.executable, "-u", "-m", module, *map(str, arguments), *fields]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


async def drawn_with_carrier(url: str) -> dict[str, np.ndarray]:
    """Return the first picture with a carrier that a display shows: matrices (4, 4) by path below ``display``."""
    matrices: dict[str, np.ndarray] = {}
    has_carrier = False
    page = await websocket_connect(entered(url).replace("http", "ws", 1))
    while not (has_carrier and "" in matrices):
        message = decoded(await page.read_message())
        path = message.get("path", "").removeprefix("/drake/display").removeprefix("/")
        if message["type"] == "set_transform":
            matrices[path] = np.reshape(message["matrix"], (4, 4)).T
        elif path == "carrier" and message.get("property") == "visible":
            has_carrier = message["value"]
            matrices.pop("", None)  # The last transform of a picture.
    page.close()
    return matrices


@pytest.mark.slow
def test_display_shows_what_another_process_knows() -> None:
    with Hub(port=0) as hub, ExitStack() as stack:
        common = (SCENARIO, "--url", hub.url)
        programs = [
            stack.enter_context(start(*arguments))
            for arguments in (
                ("vtbdrake_diagrams.forest.pictures.display", *common, "--timeout", TIMEOUT),
                ("vtbdrake.cli", "run", *common, "--pace", "imu", "--priority", 0),
                ("vtbdrake.cli", "machine", *common, "--period", 0.02, "--brake", "idle"),
            )
        ]
        stack.callback(lambda: [program.kill() for program in programs])
        assert programs[0].stdout is not None
        url = programs[0].stdout.readline().removeprefix("the display is at ").strip()
        try:
            drawn = asyncio.run(asyncio.wait_for(drawn_with_carrier(url), TIMEOUT))
        finally:
            for program in programs:
                program.send_signal(signal.SIGINT)
                _, errors = program.communicate(timeout=TIMEOUT)
                assert program.returncode == 0, errors

    scenario = PatientScenario(seed=SEED, stand_seed=SEED)
    places = {
        kind: np.array([matrix[:2, 3] for path, matrix in drawn.items() if path.startswith(kind)])
        for kind in ("carrier", "landmarks", "map/tree")
    }
    np.testing.assert_allclose(
        sorted(places["map/tree"].tolist()), sorted(scenario.global_map().positions()[:, :2].tolist())
    )
    # When it is seen is not known, but the way of the carrier is.
    assert np.linalg.norm(motion()[:, :2] - drawn["carrier"][:2, 3], axis=1).min() < 0.1
    trees = map_landmarks(scenario.truth()).positions
    nearest = np.linalg.norm(places["landmarks"][:, None] - trees, axis=2).min(axis=1)
    assert len(nearest) > 10
    assert np.quantile(nearest, 0.9) < 0.4


def test_display_without_a_scenario_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for arguments in ([f"{SCENARIO}@none.yaml"], [SCENARIO, "--field", "length=-1"]):
        monkeypatch.setattr(sys, "argv", ["display", *arguments, "--url", "tcpq://127.0.0.1:1"])
        with pytest.raises(SystemExit, match=r"^Error: [^\n]+$"):
            program()


def test_display_without_a_loop_is_one_line() -> None:
    with Hub(port=0) as hub:
        result = CliRunner().invoke(main, [SCENARIO, "--url", hub.url, "--timeout", "0.1"])
    assert result.exit_code == 2
    assert result.stderr.startswith("Error: ") and result.stderr.count("\n") == 1
    assert "does a DPS run there" in result.stderr
