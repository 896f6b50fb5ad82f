"""The data processing system of the localization unit, the same for the testbed, its copies and the carrier."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drake import lcmt_scope
from pydrake.common.value import Value
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ZeroOrderHold

from vtbdrake.components.localization.dead_reckoning import DeadReckoning, DriftModel
from vtbdrake.components.localization.pedestrian import Pedometer
from vtbdrake.components.sensors.raw_values import make_calibration
from vtbdrake.components.world_model import WorldModel
from vtbdrake.control.fallback import Hold
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.maps import LcmMap, vector_map
from vtbdrake.lcm.protocol import Protocol
from vtbdrake_diagrams.forest.perception import Localizer, PresentPose, add_localizer

PERIOD = 0.02
"""The period of the DPS, of its IMU and of its wheel odometry, in s."""
AXLE = -0.8
"""The x coordinate in B of the machine's rear axle, which is not steered, in m."""
SWAY_ON_FOOT = 0.5
"""The parameter ``sway`` of the `DeadReckoning` of a worker, in m/s^2: accelerations of the gait are noise."""


def make_deployment(*maps: tuple[LcmMap, float], on_foot: bool = False) -> Deployment:
    """Return the deployment of the localization unit on its carrier: after a fault, the advised route stays.

    Signals of numbers are sent as ``lcmt_scope``; scans or images are sent before them in the cycle of the carrier.

    Args:
        *maps: The maps of the messages of scans and images, each with the time from one to the next in s.
        on_foot: Whether a worker carries the unit: there is no ODOMETRY.
    """
    odometry = [] if on_foot else [vector_map("ODOMETRY", lcmt_scope, {"odometry": "value"})]
    return Deployment(
        protocol=Protocol(
            sense=[
                *(each for each, _ in maps),
                *odometry,
                vector_map("IMU", lcmt_scope, {"imu": "value"}),
            ],
            act=[vector_map("ROUTE_COMMAND", lcmt_scope, {"route": "value"})],
            commands=[vector_map("ROUTE", lcmt_scope, {"route": "value"})],
            periods={each.channel: period for each, period in maps},
        ),
        period=PERIOD,
        guards={"fallback": {"route": Hold()}},
        continuity={"route": None},  # It is the number of the advised route.
    )


def make_dps(
    world_map: WorldModel,
    localizer: Localizer,
    signals: Mapping[str, Any],
    *,
    latency: float,
    drift: DriftModel,
    on_foot: bool = False,
) -> Diagram:
    """Return the DPS: ``sense`` calibrates, ``env`` localizes, ``impl`` advises the driver.

    Input ports: one for each of the signals (``scan``, a `Scan`), ``imu`` (6), ``odometry`` (1), and the command
    ``route`` (1: the number of the route that is advised). Output port: ``route`` (1). On foot there is no
    ``odometry``: ``env`` has a `Pedometer` in place of wheels.

    ``env`` has the map as a constant, ``map``: it is part of the DPS, and stays when the simulated world is left out.
    Every part is sampled and shows its own state: no input feeds through.

    Args:
        world_map: The map that the localizer uses.
        localizer: The localization from scans to the pose.
        signals: A value of each of the signals in which the localizer detects landmarks, by name.
        latency: The time from the sample of a scan to its pose, in s.
        drift: The drift of the dead reckoning.
        on_foot: Whether a worker carries the unit.
    """
    builder = DiagramBuilder()
    sizes = {"imu": 6} if on_foot else {"imu": 6, "odometry": 1}
    sense = builder.AddNamedSystem("sense", make_calibration(sizes, largest={"imu": 1.0, "odometry": 0.5}))
    env = builder.AddNamedSystem(
        "env", _make_env(world_map, localizer, signals, latency=latency, drift=drift, on_foot=on_foot)
    )
    impl = builder.AddNamedSystem("impl", _make_impl())
    for signal in sizes:
        builder.ExportInput(sense.GetInputPort(signal), signal)
        builder.Connect(sense.GetOutputPort(signal), env.GetInputPort(signal))
    for signal in signals:
        builder.ExportInput(env.GetInputPort(signal), signal)
    builder.ExportInput(impl.GetInputPort("route"), "route")
    builder.ExportOutput(impl.GetOutputPort("route"), "route")
    dps = builder.Build()
    dps.set_name("dps")
    return dps


def _make_env(
    world_map: WorldModel,
    localizer: Localizer,
    signals: Mapping[str, Any],
    *,
    latency: float,
    drift: DriftModel,
    on_foot: bool,
) -> Diagram:
    """Return the perceived environment: the map, and the pose of the carrier on it."""
    builder = DiagramBuilder()
    builder.AddNamedSystem("map", ConstantValueSource(Value(world_map)))
    reckoning = builder.AddNamedSystem("dead_reckoning", _make_reckoning(on_foot=on_foot))
    part = add_localizer(builder, reckoning, localizer, signals, period=PERIOD, latency=latency)
    axle = 0.0 if on_foot else AXLE
    pose = builder.AddNamedSystem("pose", PresentPose(period=PERIOD, drift=drift, axle=axle))
    builder.Connect(reckoning.GetOutputPort("motion"), pose.GetInputPort("motion"))
    for port in ("pose", "covariance", "status", "odometry", "time"):
        builder.Connect(part.GetOutputPort(port), pose.GetInputPort(port))
    imu = builder.ExportInput(reckoning.GetInputPort("imu"), "imu")
    if on_foot:
        pedometer = builder.AddNamedSystem("pedometer", Pedometer(period=PERIOD))
        builder.ConnectInput(imu, pedometer.GetInputPort("imu"))
        builder.Connect(reckoning.GetOutputPort("motion"), pedometer.GetInputPort("motion"))
        builder.Connect(pedometer.GetOutputPort("odometry"), reckoning.GetInputPort("odometry"))
    else:
        builder.ExportInput(reckoning.GetInputPort("odometry"), "odometry")
    return builder.Build()


def _make_reckoning(*, on_foot: bool) -> DeadReckoning:
    """Return the dead reckoning of a machine on wheels, or of a worker, who never holds the unit still."""
    if on_foot:
        return DeadReckoning(period=PERIOD, sway=SWAY_ON_FOOT, still_rate=0.0)
    return DeadReckoning(period=PERIOD, axle=AXLE)


def _make_impl() -> Diagram:
    """Return the system that passes the advice on, one period later."""
    builder = DiagramBuilder()
    route = builder.AddNamedSystem("route", ZeroOrderHold(PERIOD, 1))
    builder.ExportInput(route.get_input_port(), "route")
    builder.ExportOutput(route.get_output_port(), "route")
    return builder.Build()
