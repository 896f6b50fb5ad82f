"""vtbdrake: virtual testbeds on Drake. One model to develop, optimize, reason and control.

Names are loaded when they are first used, so that importing the package costs next to nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import vtbdrake.child_process as _child_process  # noqa: F401  It notes the directory to which sys.path refers.

if TYPE_CHECKING:
    from vtbdrake.control.guards import Guards
    from vtbdrake.control.realtime import RealTime
    from vtbdrake.control.runtime import Runtime
    from vtbdrake.deployment import Deployment
    from vtbdrake.lcm.bridge import LcmBridge
    from vtbdrake.lcm.hub import Hub
    from vtbdrake.lcm.protocol import Protocol
    from vtbdrake.machine import MachineProcess
    from vtbdrake.monitoring.live.client import LiveClient, LiveWatch, watch
    from vtbdrake.monitoring.live.service import LiveService
    from vtbdrake.monitoring.residuals import ResidualMonitor
    from vtbdrake.optimization import Boundary, Choice, CVaR, Parameter, Problem, Quantile, Study, Sweep
    from vtbdrake.recording.log_reader import read_log
    from vtbdrake.recording.recorder import Recorder
    from vtbdrake.recording.replay import replay
    from vtbdrake.rollout import Constraint, Quality, RolloutResult
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import (
        DpsAlone,
        Interface,
        Scenario,
        Signal,
        SlowPart,
        VirtualTestbed,
        VirtualTestbedBuilder,
        load_scenario,
    )

__all__ = [
    "Boundary",
    "CVaR",
    "Choice",
    "Constraint",
    "Deployment",
    "DpsAlone",
    "Guards",
    "Hub",
    "Interface",
    "LcmBridge",
    "LiveClient",
    "LiveService",
    "LiveWatch",
    "MachineProcess",
    "Parameter",
    "Problem",
    "Protocol",
    "Quality",
    "Quantile",
    "RealTime",
    "Recorder",
    "ResidualMonitor",
    "RolloutResult",
    "Runtime",
    "Scenario",
    "Signal",
    "SlowPart",
    "Snapshot",
    "Study",
    "Sweep",
    "VirtualTestbed",
    "VirtualTestbedBuilder",
    "load_scenario",
    "read_log",
    "replay",
    "watch",
]

_HOMES = {
    "control.guards": ("Guards",),
    "lcm.hub": ("Hub",),
    "lcm.bridge": ("LcmBridge",),
    "monitoring.live.client": ("LiveClient", "LiveWatch", "watch"),
    "monitoring.live.service": ("LiveService",),
    "machine": ("MachineProcess",),
    "deployment": ("Deployment",),
    "lcm.protocol": ("Protocol",),
    "recording.log_reader": ("read_log",),
    "recording.recorder": ("Recorder",),
    "recording.replay": ("replay",),
    "monitoring.residuals": ("ResidualMonitor",),
    "control.realtime": ("RealTime",),
    "control.runtime": ("Runtime",),
    "optimization": ("Boundary", "CVaR", "Choice", "Parameter", "Problem", "Quantile", "Study", "Sweep"),
    "rollout": ("Constraint", "Quality", "RolloutResult"),
    "state": ("Snapshot",),
    "testbed": (
        "DpsAlone",
        "Interface",
        "Scenario",
        "Signal",
        "SlowPart",
        "VirtualTestbed",
        "VirtualTestbedBuilder",
        "load_scenario",
    ),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'vtbdrake' has no attribute {name!r}")
    value = getattr(import_module(f"vtbdrake.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
