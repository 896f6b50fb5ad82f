"""The public names of the control layer."""

from vtbdrake.control.bridge import Bridge as Bridge
from vtbdrake.control.bridge import BridgeError as BridgeError
from vtbdrake.control.clock import Clock as Clock
from vtbdrake.control.clock import SimulatedClock as SimulatedClock
from vtbdrake.control.clock import WallClock as WallClock
from vtbdrake.control.fallback import Brake as Brake
from vtbdrake.control.fallback import CarryWeight as CarryWeight
from vtbdrake.control.fallback import Fallback as Fallback
from vtbdrake.control.fallback import FallbackController as FallbackController
from vtbdrake.control.fallback import Hold as Hold
from vtbdrake.control.fallback import Silence as Silence
from vtbdrake.control.fallback import Zero as Zero
from vtbdrake.control.fallback import gravity_compensation as gravity_compensation
from vtbdrake.control.guards import Guards as Guards
from vtbdrake.control.realtime import RealTime as RealTime
from vtbdrake.control.realtime import RealTimeError as RealTimeError
from vtbdrake.control.realtime import RunawayError as RunawayError
from vtbdrake.control.runtime import Runtime as Runtime
from vtbdrake.control.statistics import LoopStatistics as LoopStatistics
from vtbdrake.control.switching import SwitchRefusedError as SwitchRefusedError
