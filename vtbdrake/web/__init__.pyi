"""The public names of the live page."""

from vtbdrake.web.fork import Fork as Fork
from vtbdrake.web.loop import LoopSession as LoopSession
from vtbdrake.web.session import Frame as Frame
from vtbdrake.web.session import Session as Session
from vtbdrake.web.session import SessionConfig as SessionConfig
from vtbdrake.web.session import SessionError as SessionError
from vtbdrake.web.study_page import StudyView as StudyView
from vtbdrake.web.study_page import view_study as view_study
from vtbdrake.web.viewer import View as View
from vtbdrake.web.viewer import view as view
from vtbdrake.web.viewer import view_loop as view_loop
