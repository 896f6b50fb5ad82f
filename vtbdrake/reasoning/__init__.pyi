"""The public names for reasoning."""

from vtbdrake.reasoning.belief import Belief as Belief
from vtbdrake.reasoning.belief import BeliefConfig as BeliefConfig
from vtbdrake.reasoning.belief import BeliefError as BeliefError
from vtbdrake.reasoning.belief import BeliefToStart as BeliefToStart
from vtbdrake.reasoning.decision import Budget as Budget
from vtbdrake.reasoning.decision import Candidate as Candidate
from vtbdrake.reasoning.decision import Decision as Decision
from vtbdrake.reasoning.decision import Health as Health
from vtbdrake.reasoning.onboard import OnboardReasoner as OnboardReasoner
from vtbdrake.reasoning.reasoner import Reasoner as Reasoner
from vtbdrake.reasoning.reasoner import ReasonerError as ReasonerError
from vtbdrake.reasoning.reasoner import SearchConfig as SearchConfig
from vtbdrake.reasoning.trajectory import Trajectory as Trajectory
