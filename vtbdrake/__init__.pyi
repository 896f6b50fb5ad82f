"""The public names for the four uses: develop, optimize, reason and control."""

from vtbdrake.control.realtime import RealTime as RealTime
from vtbdrake.control.runtime import Runtime as Runtime
from vtbdrake.deployment import Deployment as Deployment
from vtbdrake.lcm.hub import Hub as Hub
from vtbdrake.lcm.protocol import Protocol as Protocol
from vtbdrake.machine import MachineProcess as MachineProcess
from vtbdrake.monitoring.live.client import LiveClient as LiveClient
from vtbdrake.monitoring.residuals import ResidualMonitor as ResidualMonitor
from vtbdrake.optimization import Choice as Choice
from vtbdrake.optimization import CVaR as CVaR
from vtbdrake.optimization import Parameter as Parameter
from vtbdrake.optimization import Problem as Problem
from vtbdrake.optimization import Study as Study
from vtbdrake.recording.log_reader import read_log as read_log
from vtbdrake.recording.recorder import Recorder as Recorder
from vtbdrake.recording.replay import replay as replay
from vtbdrake.rollout import Constraint as Constraint
from vtbdrake.rollout import Quality as Quality
from vtbdrake.state import Snapshot as Snapshot
from vtbdrake.testbed import DpsAlone as DpsAlone
from vtbdrake.testbed import Interface as Interface
from vtbdrake.testbed import Scenario as Scenario
from vtbdrake.testbed import Signal as Signal
from vtbdrake.testbed import SlowPart as SlowPart
from vtbdrake.testbed import load_scenario as load_scenario
