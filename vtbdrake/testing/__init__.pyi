"""Checks of scenarios, and what their tests in pytest are made of."""

from .assertions import assert_bounded as assert_bounded
from .assertions import assert_continuous_at_switch as assert_continuous_at_switch
from .assertions import assert_cycle_budget as assert_cycle_budget
from .assertions import assert_energy_never_rises as assert_energy_never_rises
from .assertions import assert_replays as assert_replays
from .assertions import assert_same_motion as assert_same_motion
from .assertions import assert_settles as assert_settles
from .assertions import assert_succeeds as assert_succeeds
from .lock_step import LockStep as LockStep
from .lock_step import MachineBridge as MachineBridge
from .mutants import Mutant as Mutant
from .mutants import MutationScore as MutationScore
from .mutants import mutants_of as mutants_of
from .mutants import mutation_score as mutation_score
from .phase import Phase as Phase
from .plugin import parametrize_with_checks as parametrize_with_checks
from .scenario_check import CheckResult as CheckResult
from .scenario_check import Report as Report
from .scenario_check import ScenarioCheckError as ScenarioCheckError
from .scenario_check import check_scenario as check_scenario
from .stateful import loop_state_machine as loop_state_machine
from .subject import CheckFailedError as CheckFailedError
from .subject import CheckSkippedError as CheckSkippedError
from .subject import Subject as Subject
from .trace import Trace as Trace
from .trace import simulate as simulate
