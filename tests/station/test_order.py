"""The order of a station's commands and drivers survives a file, a log and a snapshot: signals follow it."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.yaml import yaml_dump_typed
from pydrake.systems.framework import System

import vtbdrake as vtb
from tests.cli.program import error_of, run
from tests.control.scripted import ScriptedBridge
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.recording.recorder import Recorder
from vtbdrake.state import SnapshotError
from vtbdrake.testbed.scenario_text import scenario_text
from vtbdrake_diagrams.station import FILE

STATION = "vtbdrake.station.station:Station"
ORDER = ["target", "opening", "a_last"]
# The DPS of a user: the module is imported as its own here.
MODULE = '''
import numpy as np
from pydrake.systems.framework import LeafSystem

class Steps(LeafSystem):
    """Commands what its commands u say."""

    def __init__(self, station):
        super().__init__()
        target = self.DeclareVectorInputPort("target", 7)
        opening, last = (self.DeclareVectorInputPort(name, 1) for name in ("opening", "a_last"))
        torque, grip = (self.DeclareDiscreteState(size) for size in (7, 1))

        def update(context, state):
            state.set_value(torque, target.Eval(context) + last.Eval(context))
            state.set_value(grip, opening.Eval(context))

        self.DeclarePeriodicDiscreteUpdateEvent(0.005, 0.0, update)
        self.DeclareStateOutputPort("iiwa_torque", torque)
        self.DeclareStateOutputPort("wsg_position", grip)
'''


def steps() -> Callable[[vtb.Station], System]:
    """Return the class of the user's DPS."""
    made: Callable[[vtb.Station], System] = importlib.import_module("user_of_stations").Steps
    return made


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Iterator[vtb.Station]:
    folder = tmp_path_factory.mktemp("user")
    (folder / "user_of_stations.py").write_text(MODULE)
    sys.path.insert(0, str(folder))
    sizes = {"target": 7, "opening": 1, "a_last": 1}
    commands = {name: vtb.StationCommand([0.01 * (k + 1)] * sizes[name]) for k, name in enumerate(ORDER)}
    yield vtb.Station(f"{FILE}#Torque", dps=steps(), commands=commands)
    sys.path.remove(str(folder))
    del sys.modules["user_of_stations"]


@pytest.fixture(scope="module")
def log(station: vtb.Station, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path, clock, target = tmp_path_factory.mktemp("log") / "station.lcm", SimulatedClock(), vtb.DpsAlone(station)
    sensors = {signal.name: np.zeros(signal.size or 1) for signal in target.interface.sense}
    bridge = ScriptedBridge(target.interface, clock, lambda t: sensors)
    with (
        vtb.Deployment.of(station, pace="").runtime(target, bridge, clock=clock) as runtime,
        Recorder(runtime, path),
    ):
        runtime.run(cycles=5)
        runtime.switch("real")
        runtime.write({"u.opening": 0.05, "u.a_last": 0.02})
        runtime.run(cycles=5)
    return path


def names(station: vtb.Station) -> list[str]:
    return [signal.name for signal in station.interface().commands]


def test_saved_station_has_the_same_order(station: vtb.Station, tmp_path: Path) -> None:
    mixed = replace_drivers(station)
    for each, drivers in ((station, ["iiwa", "wsg"]), (mixed, ["wsg", "iiwa"])):
        each.save(tmp_path / "station.yaml")
        loaded = vtb.load_scenario(f"{STATION}@{tmp_path / 'station.yaml'}")
        assert isinstance(loaded, vtb.Station)
        assert list(loaded.record().items()) == list(each.record().items())
        assert (names(loaded), list(loaded.model_drivers)) == (ORDER, drivers)
        assert repr(loaded.interface()) == repr(each.interface())


def replace_drivers(station: vtb.Station) -> vtb.Station:
    """Return the station with its drivers the other way round."""
    changed = vtb.Station(f"{FILE}#Torque", dps=steps(), commands=station.commands)
    changed.model_drivers = dict(reversed(changed.model_drivers.items()))
    return changed


def test_log_of_a_station_is_replayed_from_the_log(log: Path) -> None:
    report = vtb.replay(log)
    assert report.identical, report
    np.testing.assert_array_equal(report.actuation["wsg_position"][-1], [0.05])
    np.testing.assert_allclose(report.actuation["iiwa_torque"][-1], 0.03)


@pytest.mark.slow
def test_log_of_a_version_that_sorted_is_replayed(log: Path) -> None:
    opened = vtb.read_log(log)
    scenario = opened.header.make_scenario()
    text = yaml_dump_typed(scenario, child_name=scenario.name())  # as it was written then
    assert text.index("a_last:") < text.index("opening:") < text.index("target:")
    older = replace(opened, header=replace(opened.header, scenario=text))
    assert names(older.header.make_scenario()) == ORDER  # type: ignore[arg-type]
    assert vtb.replay(older).identical


def test_state_of_another_order_is_refused(station: vtb.Station) -> None:
    commands = {name: station.commands[name] for name in ("target", "a_last", "opening")}  # two of one size exchanged
    other = vtb.Station(f"{FILE}#Torque", dps=steps(), commands=commands)
    ours, theirs = vtb.DpsAlone(station), vtb.DpsAlone(other)
    snapshot = ours.snapshot(ours.default_context())
    message = "commands: target, opening, a_last there, target, a_last, opening here"
    with pytest.raises(SnapshotError, match=message):
        theirs.restore(theirs.default_context(), snapshot)


def test_command_line_names_what_a_person_there_can_do(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "user_of_stations")
    told = error_of("replay", log, "--scenario", STATION)
    assert "Error: Station.dps names the function user_of_stations:Steps" in told
    assert "add --trust user_of_stations on the command line" in told
    assert "cannot import no_module" in error_of("replay", log, "--scenario", STATION, "--trust", "no_module")
    result = run("replay", log, "--scenario", STATION, "--trust", "user_of_stations")
    assert result.exit_code == 0, result.output
    assert "identical" in result.stdout


@pytest.mark.parametrize(
    "source", ["manipulator:ManipulatorScenario", "station:ArmStation", "cart_pole:CartPoleScenario"]
)
def test_text_of_a_scenario_in_alphabetical_order_is_that_of_drake(source: str) -> None:
    scenario = vtb.load_scenario(f"vtbdrake_diagrams.{source}")
    scenario.pedigree.domain = "with all lines"
    if isinstance(scenario, vtb.Station):
        scenario.commands = dict(sorted(scenario.commands.items()))
    assert scenario_text(scenario) == yaml_dump_typed(scenario, child_name=scenario.name())
