"""Checks of scenarios, and what their tests in pytest are made of."""

from vtbdrake.testing.assertions import assert_bounded as assert_bounded
from vtbdrake.testing.assertions import assert_continuous_at_switch as assert_continuous_at_switch
from vtbdrake.testing.assertions import assert_cycle_budget as assert_cycle_budget
from vtbdrake.testing.assertions import assert_energy_never_rises as assert_energy_never_rises
from vtbdrake.testing.assertions import assert_replays as assert_replays
from vtbdrake.testing.assertions import assert_same_motion as assert_same_motion
from vtbdrake.testing.assertions import assert_settles as assert_settles
from vtbdrake.testing.assertions import assert_succeeds as assert_succeeds
from vtbdrake.testing.campaign import Campaign as Campaign
from vtbdrake.testing.campaign import CampaignError as CampaignError
from vtbdrake.testing.campaign_results import CampaignResult as CampaignResult
from vtbdrake.testing.check import CheckFailedError as CheckFailedError
from vtbdrake.testing.check import CheckResult as CheckResult
from vtbdrake.testing.check import CheckSkippedError as CheckSkippedError
from vtbdrake.testing.check import Report as Report
from vtbdrake.testing.check import ScenarioCheckError as ScenarioCheckError
from vtbdrake.testing.check import check_scenario as check_scenario
from vtbdrake.testing.lock_step import LockStep as LockStep
from vtbdrake.testing.lock_step import MachineBridge as MachineBridge
from vtbdrake.testing.plugin import parametrize_with_checks as parametrize_with_checks
from vtbdrake.testing.subject import Subject as Subject
from vtbdrake.testing.trace import Trace as Trace
from vtbdrake.testing.trace import simulate as simulate
