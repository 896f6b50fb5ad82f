"""The checks that every scenario can be put through; each is a function of one clear question."""

from collections.abc import Callable

from vtbdrake.testing.checks import boundary, derivatives, loop, repetition, scenario, signals
from vtbdrake.testing.subject import Subject

CHECKS: tuple[Callable[[Subject], None], ...] = (
    scenario.check_builds,
    scenario.check_no_algebraic_loop,
    scenario.check_builds_alike_twice,
    scenario.check_yaml_round_trip,
    scenario.check_pickle_round_trip,
    scenario.check_mental_copy_continues,
    signals.check_signals_have_units,
    signals.check_signals_have_limits,
    signals.check_parameters_have_bounds,
    signals.check_variables_do_not_overlap,
    repetition.check_simulates,
    repetition.check_state_is_in_the_context,
    repetition.check_runs_repeat,
    repetition.check_threads_agree,
    repetition.check_processes_agree,
    repetition.check_reset_equals_a_new_build,
    repetition.check_fork_is_the_future,
    repetition.check_snapshot_resumes,
    repetition.check_dropped_testbed_is_freed,
    repetition.check_runs_keep_no_memory,
    signals.check_values_fit_their_signals,
    boundary.check_sim_and_real_alike,
    boundary.check_dps_cannot_tell_the_switch,
    boundary.check_dps_alone_commands_the_same,
    loop.check_deployment_is_safe,
    loop.check_loop_commands_its_machine,
    loop.check_silence_ends_in_the_fallback,
    loop.check_nan_ends_in_the_fallback,
    loop.check_repeated_samples_end_in_the_fallback,
    loop.check_late_samples_end_in_the_fallback,
    derivatives.check_derivatives_are_right,
)
"""All checks, in the order in which they run: what later ones presuppose comes first."""
