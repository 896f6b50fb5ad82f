"""The checks that every scenario can be put through; each is a function of one clear question."""

from collections.abc import Callable

from vtbdrake.testing.checks import (
    boundary_checks,
    derivative_checks,
    loop_checks,
    repetition_checks,
    scenario_checks,
    signal_checks,
)
from vtbdrake.testing.subject import Subject

CHECKS: tuple[Callable[[Subject], None], ...] = (
    scenario_checks.check_builds,
    scenario_checks.check_no_algebraic_loop,
    scenario_checks.check_builds_alike_twice,
    scenario_checks.check_yaml_round_trip,
    scenario_checks.check_pickle_round_trip,
    scenario_checks.check_mental_copy_continues,
    signal_checks.check_signals_have_units,
    signal_checks.check_signals_have_limits,
    signal_checks.check_parameters_have_bounds,
    signal_checks.check_variables_do_not_overlap,
    repetition_checks.check_simulates,
    repetition_checks.check_state_is_in_the_context,
    repetition_checks.check_runs_repeat,
    repetition_checks.check_threads_agree,
    repetition_checks.check_processes_agree,
    repetition_checks.check_reset_equals_a_new_build,
    repetition_checks.check_fork_is_the_future,
    repetition_checks.check_snapshot_resumes,
    repetition_checks.check_dropped_testbed_is_freed,
    repetition_checks.check_runs_keep_no_memory,
    signal_checks.check_values_fit_their_signals,
    boundary_checks.check_sim_and_real_alike,
    boundary_checks.check_dps_cannot_tell_the_switch,
    boundary_checks.check_dps_alone_commands_the_same,
    loop_checks.check_deployment_is_safe,
    loop_checks.check_loop_commands_its_machine,
    loop_checks.check_silence_ends_in_the_fallback,
    loop_checks.check_nan_ends_in_the_fallback,
    loop_checks.check_repeated_samples_end_in_the_fallback,
    loop_checks.check_late_samples_end_in_the_fallback,
    derivative_checks.check_derivatives_are_right,
)
"""All checks, in the order in which they run: what later ones presuppose comes first."""
