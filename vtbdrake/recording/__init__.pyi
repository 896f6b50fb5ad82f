"""The public names about logs; `replay` and `export` are modules."""

from .lerobot_writer import LeRobotEpisode as LeRobotEpisode
from .lerobot_writer import episode_times as episode_times
from .lerobot_writer import write_lerobot as write_lerobot
from .log import Log as Log
from .log import Series as Series
from .log_format import LogError as LogError
from .log_reader import ControlLog as ControlLog
from .log_reader import read_log as read_log
from .playback import DrivenScenario as DrivenScenario
from .playback import LogBridge as LogBridge
from .playback import feed as feed
from .recorder import Recorder as Recorder
from .table_reader import read_table as read_table
