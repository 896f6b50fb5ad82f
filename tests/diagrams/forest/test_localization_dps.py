"""The DPS of the localization unit: simulated, beside a machine, and replayed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context

from tests.diagrams.forest.riding import SCAN_PERIOD, RidingScenario, pose
from tests.diagrams.lock_step_loop import TIMEOUT, deployed, run_all
from tests.visualization.meshcat_page import messages
from vtbdrake.common.scan import Scan
from vtbdrake.components.localization.dead_reckoning import DeadReckoning
from vtbdrake.components.localization.landmarks import map_landmarks
from vtbdrake.components.localization.planar import wrap
from vtbdrake.components.localization.unit import LOST, SEARCHING, TRACKING
from vtbdrake.components.world_model import (
    AttributeValue,
    LocalFrame,
    WorldModel,
    WorldObject,
    position_estimate,
    save_geojson,
)
from vtbdrake.monitoring.live.client import LiveWatch
from vtbdrake.recording import read_log
from vtbdrake.recording.replay import replay
from vtbdrake.testbed import DpsAlone, VirtualTestbed
from vtbdrake.visualization import make_meshcat
from vtbdrake_diagrams.forest.dps import AXLE, PERIOD
from vtbdrake_diagrams.forest.perception import Localizer
from vtbdrake_diagrams.forest.pictures.display import STATUS, WATCHED, DriverDisplay, main, status_text
from vtbdrake_diagrams.forest.scenario import CarrierScenario, ForestScenario
from vtbdrake_diagrams.forest.world.carrier import Carrier
from vtbdrake_diagrams.plain.scenario import PlainScenario

POSE, LOCALIZER = "dps.env.pose", "dps.env.localizer"
CYCLES = 150


@cache
def built(**fields: float) -> VirtualTestbed:
    return RidingScenario(**fields).build()


def error(system: VirtualTestbed | DpsAlone, context: Context) -> tuple[float, float]:
    """Return by how much position (m) and heading (rad) of the present pose are off."""
    truth = pose(float(system.read(context, f"{POSE}.time")))
    heading = float(system.read(context, f"{POSE}.heading"))
    return float(np.linalg.norm(system.read(context, f"{POSE}.position") - truth[:2])), abs(wrap(heading - truth[2]))


def test_pose_is_found_without_a_guess_and_followed() -> None:
    testbed = built()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(SCAN_PERIOD + PERIOD)
    assert testbed.read(context, f"{POSE}.status") == SEARCHING
    assert np.isnan(testbed.read(context, f"{POSE}.position")).all()
    assert np.isinf(np.diag(testbed.read(context, f"{POSE}.covariance"))).all()
    errors = []
    while context.get_time() < 6.0:
        simulator.AdvanceTo(context.get_time() + 0.25)
        if testbed.read(context, f"{POSE}.status") == TRACKING:
            errors.append(error(testbed, context))
            deviations = np.sqrt(np.diag(testbed.read(context, f"{POSE}.covariance")))
            assert errors[-1][0] < 4.0 * np.hypot(*deviations[:2])
    assert len(errors) > 15
    position, heading = np.sqrt(np.mean(np.square(errors), axis=0))
    assert position < 0.05
    assert heading < np.radians(0.2)
    assert testbed.read(context, f"{LOCALIZER}.matched") > 20.0


SMALL = {"seed": 1, "length": 50.0, "width": 50.0, "start": 12.0}


@pytest.mark.slow_cases
@pytest.mark.parametrize("scenario", [ForestScenario(**SMALL), PlainScenario(**SMALL, abundance=0.1)])
def test_carrier_localizes_itself_among_landmarks(scenario: CarrierScenario) -> None:
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(1.7)
    assert testbed.read(context, f"{POSE}.status") == TRACKING
    x, y, _, *_, yaw = testbed.read(context, "sim.sys.carrier.base.pose")
    assert np.linalg.norm(testbed.read(context, f"{POSE}.position") - [x, y]) < 0.08
    assert abs(wrap(float(testbed.read(context, f"{POSE}.heading")) - yaw)) < np.radians(0.4)


def test_dps_has_the_axle_of_the_carrier() -> None:
    assert Carrier().wheel_base / 2.0 == -AXLE


def test_pose_is_of_the_present() -> None:
    testbed = built()
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(4.005)
    assert testbed.read(context, f"{POSE}.time") == 4.0
    # The last scan is older, and was seen from a place some decimetres behind.
    found = testbed.read(context, f"{LOCALIZER}.time")
    assert 4.0 - found > 0.15
    assert np.linalg.norm(testbed.read(context, f"{POSE}.position") - pose(float(found))[:2]) > 0.15
    assert error(testbed, context)[0] < 0.05


def test_without_trees_in_sight_the_unit_is_lost_and_recovers() -> None:
    testbed = built(blind_from=3.0, blind_until=7.0)
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    seen = {}
    for time in (2.9, 6.9, 10.0):
        simulator.AdvanceTo(time)
        seen[time] = int(testbed.read(context, f"{POSE}.status"))
    assert (seen[2.9], seen[10.0]) == (TRACKING, TRACKING)
    assert seen[6.9] in (TRACKING, LOST)
    assert error(testbed, context)[0] < 0.1


def test_when_the_scanner_is_silent_the_unit_is_lost() -> None:
    testbed = built(dead_from=2.0)
    context = testbed.default_context()
    testbed.write(context, {f"{POSE}.patience": 1.0})
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(2.7)
    assert testbed.read(context, f"{POSE}.status") == TRACKING
    assert error(testbed, context)[0] < 0.05
    simulator.AdvanceTo(3.0)
    assert testbed.read(context, f"{POSE}.status") == LOST
    assert np.isnan(testbed.read(context, f"{POSE}.position")).all()


@pytest.mark.slow_cases
@pytest.mark.parametrize("broken", [2, 6])
def test_numbers_that_are_not_finite_are_left_out(broken: int) -> None:
    testbed = built(broken=broken)
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(3.0)
    assert testbed.read(context, "dps.env.dead_reckoning.ignored") == 5.0
    assert testbed.read(context, f"{POSE}.status") == TRACKING
    assert error(testbed, context)[0] < 0.1


@pytest.mark.slow_cases
@pytest.mark.parametrize("fields", [{"stand_seed": 4}, {"blind_until": 9.0}])
def test_without_a_place_on_the_map_there_is_never_a_pose(fields: dict[str, Any]) -> None:
    testbed = built(**fields)
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    for k in range(1, 9):
        simulator.AdvanceTo(0.5 * k)
        assert testbed.read(context, f"{POSE}.status") == SEARCHING
        assert np.isnan(testbed.read(context, f"{POSE}.position")).all()
    assert testbed.read(context, f"{LOCALIZER}.missed") == 0.0


@pytest.mark.slow_cases
@pytest.mark.parametrize("clock", [-100.0, 1.7e9])
def test_clock_of_the_scanner_may_jump(clock: float) -> None:
    testbed = built(clock=clock)
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(4.0)
    assert testbed.read(context, f"{POSE}.status") == TRACKING
    assert error(testbed, context)[0] < 0.05


def anything() -> dict[str, np.ndarray]:
    """Return points that no forest would give, in L."""
    rng = np.random.default_rng(1)
    return {
        "nothing": np.zeros((0, 3)),
        "one point": np.array([[5.0, 0.0, 0.0]]),
        "one point often": np.tile([5.0, 1.0, 0.0], (500, 1)),
        "a trunk": np.column_stack([np.full(500, 6.0), np.full(500, 1.0), np.linspace(-2.0, 3.0, 500)]),
        "a wall": np.column_stack([np.full(5000, 8.0), rng.uniform([-20.0, -2.0], [20.0, 5.0], (5000, 2))]),
        "flat ground": np.column_stack([rng.uniform(-20.0, 20.0, (5000, 2)), np.full(5000, -2.0)]),
        "a cloud": 15.0 * rng.normal(size=(20_000, 3)),
        "stars": 1e4 * rng.normal(size=(2000, 3)),
    }


@pytest.mark.parametrize("kind", [ForestScenario, PlainScenario])
def test_arbitrary_scans_give_no_pose_and_no_error(kind: type[CarrierScenario]) -> None:
    scenario = kind(**SMALL, map="poor")
    localizer = Localizer(scenario.sensors(), scenario.unit(scenario.global_map()))
    reckoning = DeadReckoning(period=PERIOD)
    history = reckoning.GetOutputPort("history").Eval(reckoning.CreateDefaultContext())
    for name, points in anything().items():
        ranges = np.linalg.norm(points, axis=1)
        scan = Scan(points / ranges[:, None], ranges, np.zeros(len(points)), 0.0)
        memory = localizer.unit.start()
        for k in range(3):
            time = np.array([0.2 * k])
            shown, memory = localizer(scan=scan, scan_time=time, request=time, history=history, memory=memory)
            assert shown["status"] == [SEARCHING], name


@pytest.mark.parametrize(
    ("kind", "unit", "x", "message"),
    [
        ("rock", "m", 0.0, "map.geojson: .* has no tree"),
        ("tree", "kg", 0.0, "map.geojson: .*kg"),
        ("tree", "m", 0.0, "map.geojson: trunk_diameter of the tree tree-0 is 30 m"),
        ("tree", "m", 55e3, r"map.geojson: no object .* mean is \(55006, 6\) m: local_frame of the file"),
    ],
)
def test_map_files_that_do_not_fit_are_refused(tmp_path: Path, kind: str, unit: str, x: float, message: str) -> None:
    objects = (
        WorldObject(
            f"{kind}-{k}",
            kind,
            position_estimate([x + 3.0 * k, float(k**2), 0.0], deviation=0.1),
            attributes={"trunk_diameter": AttributeValue(30.0, unit)},
        )
        for k in range(5)
    )
    save_geojson(WorldModel(objects), tmp_path / "map.geojson", frame=LocalFrame(61.19, 25.11, 130.0))
    with pytest.raises(ValueError, match=message):
        ForestScenario(map_file=str(tmp_path / "map.geojson")).build()


def test_map_stays_when_the_world_is_left_out() -> None:
    scenario = RidingScenario()
    dps = DpsAlone(scenario)
    env = dps.dps.GetSubsystemByName("env")
    world_map = env.GetSubsystemByName("map")
    held = world_map.get_output_port().Eval(world_map.CreateDefaultContext())
    assert isinstance(held, WorldModel)
    assert len(held) == len(scenario.global_map())


def test_advice_reaches_the_driver_one_period_later() -> None:
    testbed = built()
    context = testbed.default_context()
    testbed.write(context, {"u.route": 3.0})
    testbed.simulator(context).AdvanceTo(2.5 * PERIOD)
    assert testbed.read(context, "dps.impl.route") == 3.0


@dataclass(frozen=True)
class Drive:
    """A drive in lock-step with a machine: the DPS, its context after ``CYCLES``, the log, and what a client saw."""

    dps: DpsAlone
    context: Context
    log: Path
    seen: dict[str, np.ndarray]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    dps, log = DpsAlone(RidingScenario()), tmp_path_factory.mktemp("drive") / "drive.lcm"
    context = dps.default_context()
    with (
        deployed(RidingScenario(), dps, context, paced_by="imu", record=log, live=True) as (runtime, url),
        LiveWatch(url, WATCHED, timeout=TIMEOUT) as live,
    ):
        run_all(runtime, CYCLES)
        after = context.Clone()
        # On a busy computer, the client's request comes late. The loop answers only while it runs.
        runtime.run(until=lambda: len(live.arrays()["time"]) >= 10)
        return Drive(dps, after, log, live.arrays())


@pytest.mark.slow
def test_unit_beside_a_machine_localizes_as_in_simulation(drive: Drive) -> None:
    testbed = built()
    simulated = testbed.default_context()
    testbed.simulator(simulated).AdvanceTo((CYCLES - 1) * PERIOD)
    assert drive.dps.read(drive.context, f"{POSE}.status") == TRACKING
    # Points travel with 32 bits.
    for name in ("position", "heading"):
        expected = testbed.read(simulated, f"{POSE}.{name}")
        np.testing.assert_allclose(drive.dps.read(drive.context, f"{POSE}.{name}"), expected, atol=1e-3)


@pytest.mark.slow
def test_throwing_the_switches_changes_nothing_else(drive: Drive) -> None:
    # The simulated world is another stand than the one on the map, in which the unit would not be localized.
    testbed = built(stand_seed=4)
    context = testbed.default_context()
    with deployed(RidingScenario(), testbed, context, paced_by="imu") as (runtime, _):
        run_all(runtime, CYCLES)
    assert testbed.read(context, f"{POSE}.status") == TRACKING
    # The first cycle still sees the simulated IMU.
    for name in ("position", "heading"):
        address = f"{POSE}.{name}"
        np.testing.assert_allclose(testbed.read(context, address), drive.dps.read(drive.context, address), atol=1e-3)


@pytest.mark.slow
def test_log_of_a_drive_is_replayed_to_the_last_bit(drive: Drive) -> None:
    report = replay(read_log(drive.log))
    assert report.identical
    assert report.digests > 0


def drawn(meshcat: Meshcat, kind: str) -> dict[str, Any]:
    """Return what the page sets, by path below ``display``: matrices (4, 4) of transforms, or values of visibility."""
    found = [
        m for m in messages(meshcat.StaticHtml()) if m["type"] == kind and m.get("property", "visible") == "visible"
    ]
    value = {"set_transform": lambda m: np.reshape(m["matrix"], (4, 4)).T, "set_property": lambda m: m["value"]}[kind]
    return {m["path"].removeprefix("/drake/display").removeprefix("/"): value(m) for m in found}


@pytest.mark.slow
def test_display_can_watch_the_running_dps(drive: Drive) -> None:
    assert set(WATCHED) <= drive.seen.keys()
    statuses = drive.seen[STATUS]
    assert len(statuses) >= 10
    # A loop that has no time for it skips cycles, the first ones perhaps.
    assert set(statuses.astype(int).tolist()) <= {SEARCHING, TRACKING}
    assert (np.diff(statuses) >= 0).all()
    assert int(drive.dps.read(drive.context, STATUS)) == TRACKING


def test_display_follows_the_pose() -> None:
    testbed = built()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    meshcat = make_meshcat()
    display = DriverDisplay(meshcat, RidingScenario().global_map())

    def show(time: float) -> int:
        simulator.AdvanceTo(time)
        display.show({address: testbed.read(context, address) for address in WATCHED})
        return int(testbed.read(context, STATUS))

    assert show(SCAN_PERIOD + PERIOD) == SEARCHING
    assert drawn(meshcat, "set_property")["carrier"] is False
    for time in (2.9, 4.0):
        assert show(time) == TRACKING
        matrices = drawn(meshcat, "set_transform")
        truth = pose(float(testbed.read(context, f"{POSE}.time")))
        X_WH = matrices["carrier"]
        assert np.linalg.norm(X_WH[:2, 3] - truth[:2]) < 0.1
        assert np.arctan2(X_WH[1, 0], X_WH[0, 0]) == pytest.approx(truth[2], abs=0.02)
        np.testing.assert_allclose(matrices["status"][:2, 3], X_WH[:2, 3])
        # The carrier stays in the middle of the view.
        np.testing.assert_allclose(matrices[""][:2, 3], -X_WH[:2, 3])
        # Nine of ten landmarks stand where a tree is; the others may be of the scan before.
        places = np.array([m[:2, 3] for path, m in matrices.items() if path.startswith("landmarks")])
        trees = map_landmarks(RidingScenario().truth()).positions
        nearest = np.linalg.norm(places[:, None] - trees, axis=2).min(axis=1)
        assert len(places) > 10
        assert np.quantile(nearest, 0.9) < 0.3
        ellipse = matrices["ellipse"][:2, :2]
        covariance = testbed.read(context, f"{POSE}.covariance")[:2, :2]
        np.testing.assert_allclose(ellipse @ ellipse.T, 9.0 * covariance, rtol=1e-6)
        # The ellipse lies on top of the carrier, which would hide it otherwise, because it is far smaller.
        assert matrices["ellipse"][2, 3] > 2.0 * X_WH[2, 3]
    assert drawn(meshcat, "set_property")["carrier"] is True


def test_display_shows_the_size_of_the_ellipse() -> None:
    turned = np.array([[0.0026, 0.0024], [0.0024, 0.0026]])  # variances 0.005 and 0.0002 m^2
    assert status_text(TRACKING, turned) == "tracking ±0.21 m"
    assert status_text(LOST, np.diag([np.inf, np.inf])) == "lost"


def test_display_of_another_scenario_is_refused() -> None:
    result = CliRunner().invoke(main, ["vtbdrake_diagrams.cart_pole.scenario:CartPoleScenario", "--url", "tcpq://x:1"])
    assert result.exit_code != 0
    assert "CartPoleScenario has no localization unit" in result.output
