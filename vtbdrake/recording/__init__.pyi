"""The public names about logs; `replay` and `export` are modules."""

from vtbdrake.recording.log import Log as Log
from vtbdrake.recording.log import Series as Series
from vtbdrake.recording.log_format import LogError as LogError
from vtbdrake.recording.log_reader import ControlLog as ControlLog
from vtbdrake.recording.log_reader import read_log as read_log
from vtbdrake.recording.playback import DrivenScenario as DrivenScenario
from vtbdrake.recording.playback import LogBridge as LogBridge
from vtbdrake.recording.recorder import Recorder as Recorder
from vtbdrake.recording.table_reader import read_table as read_table
