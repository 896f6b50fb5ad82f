"""The public names of the control layer."""

from .bridge import Bridge as Bridge
from .bridge import BridgeError as BridgeError
from .bridge import acts_idle as acts_idle
from .clock import Clock as Clock
from .clock import SimulatedClock as SimulatedClock
from .clock import WallClock as WallClock
from .fallback import Brake as Brake
from .fallback import CarryWeight as CarryWeight
from .fallback import Fallback as Fallback
from .fallback import FallbackController as FallbackController
from .fallback import Hold as Hold
from .fallback import Silence as Silence
from .fallback import Zero as Zero
from .fallback import gravity_compensation as gravity_compensation
from .guards import Guards as Guards
from .guards import LoopCondition as LoopCondition
from .inbox import Inbox as Inbox
from .limits import Bounds as Bounds
from .realtime import RealTime as RealTime
from .realtime import RealTimeError as RealTimeError
from .realtime import RunawayError as RunawayError
from .robot_mode import RobotMode as RobotMode
from .runtime import Runtime as Runtime
from .statistics import LoopStatistics as LoopStatistics
from .switching import SwitchRefusedError as SwitchRefusedError
