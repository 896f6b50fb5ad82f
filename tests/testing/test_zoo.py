"""Every check fails on its bad diagram, and on no other."""

import re

import pytest

from tests.testing import zoo
from vtbdrake.testing import ScenarioCheckError, check_scenario
from vtbdrake.testing.checks import CHECKS
from vtbdrake.testing.checks.boundary_checks import check_dps_alone_commands_the_same, check_dps_cannot_tell_the_switch
from vtbdrake.testing.checks.repetition_checks import check_dropped_testbed_is_freed, check_reset_equals_a_new_build
from vtbdrake.testing.scenario_check import check_names
from vtbdrake.testing.subject import CheckFailedError, CheckSkippedError, Subject

HORIZON = 0.3

# Checks that do not concern the good diagram; without what the others ask for, no other check can run.
NOT_CONCERNED = {"check_mental_copy_continues", "check_derivatives_are_right"}
EVERYTHING_NEEDS = {"check_builds", "check_no_algebraic_loop", "check_simulates"}


def statuses(scenario, **options):
    try:
        report = check_scenario(scenario, horizon=HORIZON, **options)
    except ScenarioCheckError as error:
        report = error.report
    return {result.name: result for result in report}


def test_every_check_has_its_bad_diagram():
    assert list(zoo.BAD) and set(zoo.BAD) == set(check_names())


@pytest.mark.slow_cases
@pytest.mark.parametrize("kind", [zoo.GoodScenario, zoo.Differentiable])
def test_good_diagram_passes_every_check_that_concerns_it(kind):
    results = statuses(kind())
    assert {name for name, result in results.items() if result.status == "failed"} == set()
    skipped = {name for name, result in results.items() if result.status == "skipped"}
    assert skipped <= NOT_CONCERNED


# What the message of each check must name: the place, or the remedy.
MESSAGES = {
    "check_builds": "the DPS has no input port position",
    "check_no_algebraic_loop": "sample a sensor in the loop",
    "check_builds_alike_twice": "sim.sense.encoder.position, sim.sense.encoder/discrete/0: take them from fields",
    "check_yaml_round_trip": "no file can hold",
    "check_pickle_round_trip": "cannot be sent to other processes",
    "check_mental_copy_continues": "dps/discrete/1",
    "check_signals_have_units": "speed is 'deg/s'",
    "check_signals_have_limits": "give lower= and upper=",
    "check_parameters_have_bounds": "dps.gain has no bounds",
    "check_variables_do_not_overlap": "sim.sense.encoder.again and sim.sense.encoder.position",
    "check_values_fit_their_signals": "-1.0 to 1.0 m/s",
    "check_simulates": "fails after 0.06 s: RuntimeError: the disc is broken",
    "check_state_is_in_the_context": "self.last of sim.sense.encoder (Logging) changes while it is simulated: declare",
    "check_runs_repeat": "it differs in sim.sense.encoder, from t = 0 s on",
    "check_threads_agree": "in another thread, it ends otherwise",
    "check_processes_agree": "in another process",
    "check_reset_equals_a_new_build": "sim.sys.slide/discrete/0",
    "check_fork_is_the_future": "simulated from a copy at 0.15 s",
    "check_snapshot_resumes": "simulated from a snapshot at 0.15 s",
    "check_dropped_testbed_is_freed": "1 DiscreteTimeIntegrator",
    "check_runs_keep_no_memory": "objects of Python behind",
    "check_sim_and_real_alike": "position measures [0.03984], but [0.0398] arrives",
    "check_dps_cannot_tell_the_switch": "[0.1] instead of [0.2]",
    "check_dps_alone_commands_the_same": "[0.8] instead of [0.801]",
    "check_deployment_is_safe": "give continuity={'velocity'",
    "check_loop_commands_its_machine": "the fallbacks command: the machine must not be commanded",
    "check_silence_ends_in_the_fallback": "nothing arrives on SPEED any more",
    "check_nan_ends_in_the_fallback": "the numbers on POSITION are NaN",
    "check_repeated_samples_end_in_the_fallback": "one message is repeated on SPEED",
    "check_late_samples_end_in_the_fallback": "arrive 0.15 s late, and the DPS still commands",
    "check_derivatives_are_right": "sim.sys.square: the derivative of y[0] by x[0] is 0 by AutoDiff",
}


# One for the quick suite; below, all of them.
@pytest.mark.parametrize("name", [*zoo.BAD][:1])
def test_bad_diagram_fails_its_check(name):
    (check,) = (check for check in CHECKS if check.__name__ == name)
    error = Subject(zoo.BAD[name](), horizon=HORIZON).outcome(check)
    assert isinstance(error, CheckFailedError) and MESSAGES[name] in str(error)


def test_deformable_body_is_no_system_that_changes_its_defaults():
    assert Subject(zoo.Soft(), horizon=HORIZON).outcome(check_reset_equals_a_new_build) is None


@pytest.mark.parametrize("check", [check_dps_cannot_tell_the_switch, check_dps_alone_commands_the_same])
def test_dps_between_the_instants_that_drake_tells_is_fed_in_time(check):
    assert Subject(zoo.Offset(), horizon=HORIZON).outcome(check) is None


def test_function_that_keeps_a_testbed_is_named():
    error = Subject(zoo.CacheByLambda(), horizon=HORIZON).outcome(check_dropped_testbed_is_freed)
    assert "1 ByLambda" in str(error)
    assert re.search(r"keeps it: ByLambda.__init__.<lambda> \(zoo.py, line \d+\). Declare ports .* methods", str(error))


@pytest.mark.parametrize(
    ("name", "reason"), [("check_simulates", "the disc is broken"), ("check_builds", "no input port")]
)
def test_failure_that_others_presuppose_is_told_once(name, reason):
    with pytest.raises(ScenarioCheckError) as failure:
        check_scenario(zoo.BAD[name](), horizon=HORIZON)
    assert str(failure.value).count(reason) == 1
    assert sum(name in result.message for result in failure.value.report if result.status == "skipped") > 10


# It starts a process, which takes a second: of the bad diagrams, for its own and for what it presupposes.
PROCESSES = "check_processes_agree"
WITH_A_PROCESS = {PROCESSES, "check_pickle_round_trip", "check_runs_repeat"}


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo.BAD)
def test_bad_diagram_fails_its_check_alone(name):
    subject = Subject(zoo.BAD[name](), horizon=HORIZON)
    checks = [check for check in CHECKS if check.__name__ != PROCESSES or name in WITH_A_PROCESS]
    errors = {check.__name__: subject.outcome(check) for check in checks}
    failures = {check: str(error) for check, error in errors.items() if isinstance(error, CheckFailedError)}
    assert failures.keys() == {name} and MESSAGES[name] in failures[name], failures
    if name == "check_runs_keep_no_memory":
        # One of 30; other objects of the process may be freed meanwhile.
        counted = re.search(r"leaves (\d+) objects", failures[name])
        assert counted is not None and 29 <= int(counted[1]) <= 30, failures
    for check, error in errors.items():
        if isinstance(error, CheckSkippedError) and check not in NOT_CONCERNED and name not in EVERYTHING_NEEDS:
            assert name in str(error), (check, error)
