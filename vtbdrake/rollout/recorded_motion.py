"""Rollouts along a recorded motion: the world is simulated once for all candidates that do not affect its motion."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import inf
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.common.argument_checks import as_addresses, as_number
from vtbdrake.state.layout import FlatState, StateLayout
from vtbdrake.state.systems import is_plant, leaves
from vtbdrake.state.variables import A
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.testbed.dependencies import chain, followers
from vtbdrake.testbed.switch import BOARD, T_ACT

# Windows begin this part of the shortest period after an event: not at an event, where rounding would matter.
_BETWEEN = 0.382


class MotionError(ValueError):
    """A motion cannot be recorded, or depends on the varied variables."""


@dataclass(frozen=True)
class RecordedMotion:
    """A declaration that the motion of the testbed does not depend on the varied variables.

    For example, the pose of a camera that observes, or the parameters of a detector of its images, are varied. The
    motion is simulated once, and recorded. Each candidate is then simulated only in a window of ``memory`` seconds
    before each sample of f, from the recorded state. The systems that depend on the varied variables are called
    followers. If their state does not depend on anything more than ``memory`` seconds ago, the result equals the whole
    rollout's, to the last bit. So images that nothing reads are not rendered, and the world between the samples is not
    simulated. A candidate takes about memory / sample period of the time of a whole rollout.

    The followers are found from the connections of the Diagram. If the plant or an actuator is one, the motion is
    refused. At each sample, the state of all other systems is compared with the recorded one.
    `Problem.check_repeatability` compares whole rollouts with those along the motion, and finds a memory that is too
    short. The testbed must have no continuous state: a discrete plant continues exactly from a recorded state, an
    integrator with error control does not. A failure between the windows (a camera that is inside a link for a moment)
    is not noticed.

    Attributes:
        memory: Memory of the followers in seconds. For a camera of period T and a detector of latency D that samples
            its images s seconds after they were taken, it is T + s + D at most, and less if f is sampled right after a
            result. The memory of a filter is infinite: f must use its input.
        varied: Addresses of the varied variables, which are parameters of followers; a `Problem` sets them to its
            parameters' addresses.
        while_recording: Values of parameters of followers while the motion is recorded, by address: for example an
            exposure of 0, with which a camera renders nothing.

    Raises:
        ValueError: The memory is not a positive time.
    """

    memory: float
    varied: Sequence[str] = ()
    while_recording: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "memory", as_number("the memory of a recorded motion", self.memory))
        object.__setattr__(self, "varied", as_addresses("what is varied along a recorded motion", self.varied))
        if not 0.0 < self.memory < inf:
            raise ValueError(f"the memory of a recorded motion is a positive, finite time in s, not {self.memory}")


@dataclass(frozen=True)
class Recording:
    """One recorded motion, at the sample times.

    Attributes:
        starts: The state at the beginning of the window of each sample; None if the window begins before the previous
            sample, so that the rollout goes on from there.
        worlds: The numbers of all systems that are not followers, at each sample.
    """

    starts: list[FlatState | None] = field(default_factory=list)
    worlds: list[np.ndarray] = field(default_factory=list)


# Testbed -> memory, followers and samples -> values set in s0 -> the recording.
_RECORDINGS: WeakKeyDictionary[VirtualTestbed, dict[Hashable, dict[Hashable, Recording]]] = WeakKeyDictionary()


class MotionPlayer:
    """Sets contexts of a testbed to recorded states, and compares them with recorded states.

    Args:
        motion: The varied variables, and the memory of their followers.
        testbed: The testbed of the rollouts.

    Raises:
        MotionError: The motion depends on the varied variables, or cannot be continued exactly from a recorded state.
    """

    def __init__(self, motion: RecordedMotion, testbed: VirtualTestbed) -> None:
        self.motion = motion
        self._testbed = testbed
        if testbed.default_context().num_continuous_states():
            raise MotionError(
                "a motion is recorded of a testbed without continuous state, from which rollouts continue exactly: "
                "use a discrete plant (a positive time_step), and discrete systems"
            )
        self._paths = tuple(path for path, _ in leaves(testbed.diagram))
        self._following = following = self._followers()
        for address in motion.while_recording:
            if address in self.fixed({address: None}):
                raise MotionError(f"{address} is no parameter of a follower: the recorded motion could depend on it")
        self._state_layout = StateLayout(
            testbed.diagram, state=lambda path: path != BOARD, parameters=lambda path: False
        )
        self._world_layout = StateLayout(
            testbed.diagram, state=lambda path: path != BOARD and path not in following, parameters=lambda path: False
        )

    def _followers(self) -> dict[str, str]:
        systems = dict(leaves(self._testbed.diagram))
        variables = self._testbed.variables()
        sources = {}
        for address in self.motion.varied:
            owner = self._owner(address)
            if not owner or is_plant(systems[owner]):
                raise MotionError(
                    f"{address} belongs to the plant, to the scene or to the switches, on which the motion depends: "
                    "vary it without motion="
                )
            if variables[address].kind != A:
                raise MotionError(
                    f"{address} is a dynamic state, whose initial value has no effect later: along a recorded motion, "
                    "vary parameters (of kind 'a')"
                )
            sources[owner] = address
        following = followers(self._testbed.diagram, sources)
        for path in following:
            if is_plant(systems[path]) or path.startswith(T_ACT):
                way = chain(following, path)
                raise MotionError(
                    f"the motion depends on {sources[way[0]]}, by way of {' -> '.join(way)}: let the DPS control the "
                    "motion by sensors that do not depend on it, or leave out motion="
                )
        return following

    def _owner(self, address: str) -> str:
        """Return the path of the system that a variable belongs to; empty if it is the plant's, or no system's."""
        return next((path for path in self._paths if address.startswith(f"{path}.")), "")

    def fixed(self, parameters: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values set in s0 on which the motion may depend: all but the parameters of followers."""
        variables = self._testbed.variables()
        return {
            address: value
            for address, value in parameters.items()
            if self._owner(address) not in self._following or variables[address].kind != A
        }

    def window_starts(self, instants: np.ndarray) -> list[float | None]:
        """Return the begin of each sample's window, in seconds; None if that is before the previous sample.

        Args:
            instants: The simulator's time at each sample, shape (n,).
        """
        periods = [period for period, _ in self._testbed.event_timings()]
        starts: list[float | None] = [None]
        for before, instant in pairwise(instants):
            start = float(instant) - self.motion.memory
            if periods:
                step = min(periods)
                start = (np.floor(start / step) - 1.0 + _BETWEEN) * step
            starts.append(float(start) if start > before else None)
        return starts

    def recordings(self, instants: np.ndarray) -> dict[Hashable, Recording]:
        """Return the recordings from default starts with samples at these instants; the caller adds new ones.

        Args:
            instants: The simulator's time at each sample, shape (n,).
        """
        of_testbed = _RECORDINGS.setdefault(self._testbed, {})
        recorded_with = tuple((key, np.asarray(value).tobytes()) for key, value in self.motion.while_recording.items())
        return of_testbed.setdefault(
            (self.motion.memory, tuple(self._following), recorded_with, instants.tobytes()), {}
        )

    def state(self, context: Context) -> FlatState:
        """Return the state from which a window begins."""
        return self._state_layout.take(context)

    def world(self, context: Context) -> np.ndarray:
        """Return the numbers of all systems that are not followers, shape (n,)."""
        return self._world_layout.take(context).numbers

    def put(self, context: Context, time: float, start: FlatState) -> None:
        """Set time and state of ``context`` to a recorded one; its parameters stay.

        Args:
            context: A root context of the testbed, which is changed.
            time: The time of the recorded state, in seconds.
            start: The recorded state.
        """
        context.SetTime(time)
        self._state_layout.put(context, start)

    def compare(self, context: Context, recorded: np.ndarray) -> None:
        """Compare the systems that are not followers with the recorded numbers.

        Args:
            context: A root context of the testbed.
            recorded: The recorded numbers of these systems, shape (n,), in the order of their layout.

        Raises:
            MotionError: They differ.
        """
        here = self._world_layout.take(context).numbers
        if np.array_equal(here, recorded, equal_nan=True):
            return
        index = int(np.flatnonzero((here != recorded) & ~(np.isnan(here) & np.isnan(recorded)))[0])
        raise MotionError(
            f"the motion depends on {', '.join(self.motion.varied)}, although no connection leads there: at t = "
            f"{context.get_time():g} s, {self._world_layout.name_at(index)} is not as recorded. A system has memory "
            "outside the Context, see Problem.check"
        )
