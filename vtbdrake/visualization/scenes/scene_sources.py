"""Files of scenes, for Foxglove (.mcap) and Rerun (.rrd), of motions, rollouts, decisions and logs."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from math import floor, inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.math import RigidTransform

from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.optimization.problem import Motion, ProblemRollout
from vtbdrake.recording import ControlLog, Log, read_log
from vtbdrake.recording.log_entries import LogEntry, log_entries
from vtbdrake.recording.recorded_course import RecordedCourse
from vtbdrake.rollout.runner import RolloutRunner, SimulationError
from vtbdrake.rollout.testbeds import split
from vtbdrake.state.archive import PRIVATE, whole_file
from vtbdrake.visualization.decisions import GhostMotions
from vtbdrake.visualization.drawing import Parts
from vtbdrake.visualization.film import PosedTestbed
from vtbdrake.visualization.meshcat import check_motion, motion_looks, motion_states, stage_of
from vtbdrake.visualization.scenes.output import SceneOutput
from vtbdrake.visualization.scenes.scene_model import SceneModel
from vtbdrake.visualization.scenes.scene_writer import SceneWriter, check_scene_path, open_scene_file

if TYPE_CHECKING:
    from matplotlib.typing import ColorType
    from numpy.typing import ArrayLike

    from vtbdrake.rollout import RolloutTask
    from vtbdrake.testbed import VirtualTestbed

Source = (
    Motion
    | ProblemRollout
    | Mapping[str, Motion | ProblemRollout]
    | GhostMotions
    | ControlLog
    | Log
    | str
    | os.PathLike[str]
)
"""What a scene is written of; a path is the one of a log."""

_GHOST_OPACITY = 0.35
# Times are sums with rounding errors, in s.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class _Choice:
    """What is written, see `write_scene`."""

    rate: float
    images: bool
    record: Sequence[str]

    def writer(self, testbed: VirtualTestbed, output: SceneOutput, **options: Any) -> SceneWriter:
        """Return a writer of a testbed."""
        arguments: dict[str, Any] = {"images": self.images, "record": self.record} | options
        return SceneWriter(testbed, output, rate=self.rate, **arguments)

    def due(self, times: np.ndarray) -> list[int]:
        """Return the numbers of the samples that are written: at most ``rate`` per second, and the last one."""
        ticks = np.floor((times - times[:1]) * self.rate + 1e-6)
        return sorted({*np.unique(ticks, return_index=True)[1].tolist(), *([len(times) - 1] if len(times) else [])})


def write_scene(
    source: Source,
    path: str | os.PathLike[str],
    *,
    rate: float = 30.0,
    images: bool = True,
    record: Sequence[str] = (),
    colors: Mapping[str, ColorType] | None = None,
    opacity: float | Mapping[str, float] = _GHOST_OPACITY,
    spacing: ArrayLike = (0.0, 0.0, 0.0),
    world: bool = True,
    mode: int | None = None,
) -> None:
    """Write a scene to a file that Foxglove (.mcap) or Rerun (.rrd) shows.

    A rollout of a problem is simulated again, and a log is replayed, so that their files have images, scans and signals
    as well as the motion, see `SceneWriter`. A log has its signals and events at all times, at its times of day, as
    `log_entries` names them; the world of a log of a DPS alone is what the DPS believed. A motion has poses and joints,
    and its quality as ``/quality``. Several motions are ghosts, each beneath a frame with its label; what stands still
    is drawn once for each scenario.

    Args:
        source: A `Motion`; a rollout of a problem; several of them by label; the `GhostMotions` of a decision; or a
            log, or the path of its file.
        path: The file. It is written as a whole or not at all.
        rate: States per second at most, of simulated time.
        images: Whether images and scans are written.
        record: Addresses of variables and vector ports that are written, too; of a rollout or a log.
        colors: Label -> tint of a ghost, any matplotlib colour; by default every ghost is tinted.
        opacity: Opacity of the ghosts, in (0, 1], for all or by label.
        spacing: Displacement from each ghost to the next in m, shape (3,).
        world: Whether the world of a log is written, by a replay, which runs the code of its scenario; otherwise its
            signals and events alone.
        mode: Permissions of the file; None: what the umask leaves, but a file of a log is read by its owner alone.

    Raises:
        ValueError: There is nothing to show, or an argument makes no sense.
        OSError: A file cannot be read or written.
        ModuleNotFoundError: The extra ``foxglove`` or ``rerun`` is not installed.
    """
    check_scene_path(path)
    if isinstance(source, str | os.PathLike):
        source = read_log(source)
    choice = _Choice(rate, images, record)
    is_log = isinstance(source, ControlLog | Log)
    write: Callable[[SceneOutput], None]
    if isinstance(source, ControlLog):
        write = _log_writing(source, choice, world)
    elif isinstance(source, Log):
        write = _signals_writing(source)
    elif isinstance(source, ProblemRollout):
        write = _rollout_writing(source, choice)
    elif isinstance(source, Motion):
        write = _motion_writing(source, choice)
    else:
        looks = source.looks if isinstance(source, GhostMotions) else {"colors": colors, "opacity": opacity}
        motions = source.motions if isinstance(source, GhostMotions) else source
        write = _ghosts_writing(motions, choice, spacing=spacing, **looks)
    _write_file(path, write, calendar=isinstance(source, ControlLog), mode=PRIVATE if is_log and mode is None else mode)


def write_rollout(
    task: RolloutTask,
    parameters: Mapping[str, Any],
    path: str | os.PathLike[str],
    *,
    testbed: VirtualTestbed | None = None,
    end: float = inf,
    rate: float = 30.0,
    images: bool = True,
    record: Sequence[str] = (),
) -> None:
    """Simulate a rollout, and write its scene at its sample times; one that fails is written up to there.

    Args:
        task: The task of the rollout.
        parameters: Address -> value, set in s0.
        path: The file, .mcap or .rrd. It is written as a whole or not at all.
        testbed: A testbed of the task's scenario; None: a new one is built.
        end: The time, in s from t0, after which nothing is simulated any more.
        rate: States per second at most.
        images: Whether images and scans are written.
        record: Addresses of variables and vector ports that are written, too.

    Raises:
        ValueError: The path has another suffix, or an argument makes no sense.
        ModuleNotFoundError: The extra ``foxglove`` or ``rerun`` is not installed.
    """
    check_scene_path(path)
    runner, choice = RolloutRunner(task, testbed), _Choice(rate, images, record)
    _write_file(path, lambda output: _simulate(runner, parameters, end, choice.writer(runner.testbed, output)))


def _write_file(
    path: str | os.PathLike[str],
    write: Callable[[SceneOutput], None],
    *,
    calendar: bool = False,
    mode: int | None = None,
) -> None:
    suffix = Path(path).suffix
    with (
        whole_file(path, mode=mode) as partial,
        open_scene_file(partial, suffix=suffix, calendar=calendar) as output,
    ):
        write(output)


# -- rollouts


def _rollout_writing(rollout: ProblemRollout, choice: _Choice) -> Callable[[SceneOutput], None]:
    if not len(rollout.times):
        raise ValueError(f"the rollout has no sample, so that there is nothing to show: {rollout.message}")
    task, testbed = rollout.problem.placed(rollout.problem.task, rollout.parameters)
    runner, end = RolloutRunner(task, testbed), float(rollout.times[-1])

    def write(output: SceneOutput) -> None:
        writer = choice.writer(testbed, output)
        _simulate(runner, split(rollout.parameters)[1], end, writer)
        _write_quality(output, "/quality", rollout.times, rollout.quality)

    return write


def _simulate(runner: RolloutRunner, parameters: Mapping[str, Any], end: float, writer: SceneWriter) -> None:
    """Simulate a rollout up to an end, and write its states."""
    last = -1
    with Interruptible() as interruptible:
        try:
            for time in runner.simulate(parameters):
                interruptible.raise_interrupt()
                if time > end + _ROUNDING:
                    return
                if (tick := floor(time * writer.rate + 1e-6)) != last:
                    last = tick
                    writer.write(runner.context, time=round(1e9 * time))
        except SimulationError:  # It is an outcome; what has been written is shown.
            return


def _write_quality(output: SceneOutput, topic: str, times: np.ndarray, quality: np.ndarray | None) -> None:
    if quality is not None and len(quality) == len(times):
        for time, value in zip(times.tolist(), quality.tolist(), strict=True):
            output.write_values(topic, round(1e9 * time), [value])


# -- motions


def _motion_writing(motion: Motion, choice: _Choice) -> Callable[[SceneOutput], None]:
    check_motion(motion, "the scene", choice.rate)
    stage = PosedTestbed(motion.scenario)
    states = motion_states(motion, stage.testbed, "the scene")

    def write(output: SceneOutput) -> None:
        _write_motions(output, [_Ghost(motion, states, stage, SceneModel(stage.testbed))], choice)

    return write


@dataclass(frozen=True)
class _Ghost:
    """A motion in a scene: its states, the testbed that takes them, and what is drawn."""

    motion: Motion
    states: np.ndarray
    stage: PosedTestbed
    model: SceneModel


def _ghosts_writing(
    motions: Mapping[str, Motion | ProblemRollout],
    choice: _Choice,
    *,
    colors: Mapping[str, ColorType] | None,
    opacity: float | Mapping[str, float],
    spacing: ArrayLike,
) -> Callable[[SceneOutput], None]:
    if not isinstance(motions, Mapping):
        raise ValueError(f"a scene is written of motions, rollouts or a log, not of {type(motions).__name__}")
    computed = {
        name: motion.problem.motion(motion.parameters) if isinstance(motion, ProblemRollout) else motion
        for name, motion in motions.items()
    }
    tints, opacities = motion_looks(computed, colors, opacity)
    step = np.asarray(spacing, dtype=float)
    if step.shape != (3,):
        raise ValueError(f"spacing is a displacement of shape (3,) in metres, not of shape {step.shape}")
    stages: list[PosedTestbed] = []
    ghosts: list[_Ghost] = []
    for number, (name, motion) in enumerate(computed.items()):
        check_motion(motion, name, choice.rate)
        is_drawn = any(ghost.motion.scenario == motion.scenario for ghost in ghosts) and not step.any()
        stage = stage_of(motion.scenario, stages)
        model = SceneModel(
            stage.testbed,
            prefix=name,
            tint=tints.get(name),
            opacity=opacities.get(name, 1.0),
            parts=Parts.MOVING if is_drawn else Parts.ALL,
            X_WP=RigidTransform(number * step),
        )
        ghosts.append(_Ghost(motion, motion_states(motion, stage.testbed, name), stage, model))
    return lambda output: _write_motions(output, ghosts, choice)


def _write_motions(output: SceneOutput, ghosts: Sequence[_Ghost], choice: _Choice) -> None:
    """Write the samples of motions in the order of time."""
    writers = [
        choice.writer(ghost.stage.testbed, output, model=ghost.model, images=False, signals=False, record=())
        for ghost in ghosts
    ]
    samples = sorted(
        (float(ghost.motion.times[sample]), number, sample)
        for number, ghost in enumerate(ghosts)
        for sample in choice.due(np.asarray(ghost.motion.times))
    )
    for time, number, sample in samples:
        ghost = ghosts[number]
        ghost.stage.set_state(ghost.states[sample])
        writers[number].write(ghost.stage.context, time=round(1e9 * time))
    for ghost in ghosts:
        _write_quality(output, ghost.model.topic("quality"), ghost.motion.times, ghost.motion.quality)


# -- logs


def _signals_writing(log: Log) -> Callable[[SceneOutput], None]:
    def write(output: SceneOutput) -> None:
        _write_entries(output, log_entries(log))

    return write


def _log_writing(log: ControlLog, choice: _Choice, world: bool) -> Callable[[SceneOutput], None]:
    if not world:
        return lambda output: _write_entries(output, log_entries(log))
    testbed = log.scenario.build()

    def write(output: SceneOutput) -> None:
        # What nothing of the machine was part of is not in the log, but in its replay.
        writer = choice.writer(testbed, output, without=_recorded_streams(log))
        with ExitStack() as stack:
            course = stack.enter_context(RecordedCourse(log, testbed, kept_work=inf))
            interruptible = stack.enter_context(Interruptible())
            entries = _EntriesInStep(output, log_entries(log))
            for cycle in choice.due(course.times):
                interruptible.raise_interrupt()
                course.advance_to(float(course.times[cycle]))
                time = 1000 * int(log.utimes[cycle])
                entries.write_until(time)
                writer.write(course.context, world=course.world, time=time)
            entries.write_until(None)

    return write


def _recorded_streams(log: ControlLog) -> set[str]:
    """Return the streams of the signals that a log has itself."""
    sides = {"sense": {name: source != 0 for name, source in log.sources.items()}, "command": log.commanded}
    return {f"{side}/{name}" for side, each in sides.items() for name, present in each.items() if present.any()}


class _EntriesInStep:
    """Writes the entries of a log up to the time of each state, so that the file is in the order of time."""

    def __init__(self, output: SceneOutput, entries: Iterator[LogEntry]) -> None:
        self._output, self._entries = output, entries

    def write_until(self, time: int | None) -> None:
        """Write the entries up to a time in ns, or all that are left."""
        for entry in self._entries:
            if time is not None and entry.time > time:
                self._entries = chain([entry], self._entries)
                return
            _write_entries(self._output, [entry])


def _write_entries(output: SceneOutput, entries: Iterator[LogEntry] | Sequence[LogEntry]) -> None:
    for time, stream, content, is_error in entries:
        if isinstance(content, str):
            output.write_text(f"/{stream}", time, content, is_error=is_error)
        else:
            output.write_values(f"/{stream}", time, content)
