"""The public names for reasoning."""

from .belief import Belief as Belief
from .belief import BeliefConfig as BeliefConfig
from .belief import BeliefError as BeliefError
from .belief import BeliefToStart as BeliefToStart
from .decision import Budget as Budget
from .decision import Candidate as Candidate
from .decision import Decision as Decision
from .decision import Health as Health
from .onboard import OnboardReasoner as OnboardReasoner
from .reasoner import Reasoner as Reasoner
from .reasoner import ReasonerError as ReasonerError
from .reasoner import SearchConfig as SearchConfig
from .trajectory import Trajectory as Trajectory
