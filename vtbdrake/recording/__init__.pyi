"""The public names about logs; `replay` and `export` are modules."""

from vtbdrake.recording.log_format import LogError as LogError
from vtbdrake.recording.log_reader import ControlLog as ControlLog
from vtbdrake.recording.log_reader import read_log as read_log
from vtbdrake.recording.recorder import Recorder as Recorder
