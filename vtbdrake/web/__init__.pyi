"""The public names of the live page."""

from .live.fork import Fork as Fork
from .live.log_session import LogSession as LogSession
from .live.loop_session import LoopSession as LoopSession
from .live.player import SessionConfig as SessionConfig
from .live.session import Frame as Frame
from .live.session import Session as Session
from .live.session import SessionError as SessionError
from .live.simulation_session import SimulationSession as SimulationSession
from .live.viewer import View as View
from .live.viewer import view as view
from .live.viewer import view_loop as view_loop
from .study.study_page import StudyView as StudyView
from .study.study_page import view_study as view_study
