"""The cost of being watched, and how soon the page shows what happens."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from math import inf
from multiprocessing import get_context
from multiprocessing.synchronize import Event
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from benchmarks.measure import HIGHER, LOWER, Benchmark, spread
from benchmarks.view_client import CHROMIUM, STAMP, click, client, preview, read_states, read_states_in_chromium
from vtbdrake.testbed import Scenario, VirtualTestbed
from vtbdrake.visualization.drawing import Drawing, Parts
from vtbdrake.web import View
from vtbdrake.web.live.player import Player, SessionConfig
from vtbdrake.web.live.session_server import Server
from vtbdrake.web.live.simulation_session import PlayedSession, SimulationSession
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

GHOSTS = 10
ANGLE = "sim.sys.cart_pole.pole_pin.position"
_NICE = 5
_LONGEST = 3600.0  # s, for a client
_DELAY = 4  # frames by which each ghost is behind the one before


class _CrowdedPlayer(Player):
    """Draws ghosts, which follow the robot one behind the other, and a stamp of the time of each frame."""

    def __init__(self, scenario: Scenario, config: SessionConfig) -> None:
        super().__init__(scenario, config, None)
        self._past: deque[np.ndarray] = deque(maxlen=_DELAY * GHOSTS)
        self.drawn = 0
        self._crowd: list[tuple[Drawing, Context]] = []
        for k in range(GHOSTS):
            context = self.testbed.default_context()
            path, meshcat = f"crowd/{k}", self.scene.meshcat
            ghost = Drawing(meshcat, self.testbed, context, path, tint="#0072b2", parts=Parts.MOVING)
            self._crowd.append((ghost, context))

    def _draw(self, now: float) -> tuple[str, ...]:
        warnings = super()._draw(now)
        plant = self.testbed.plant
        assert plant is not None
        self._past.appendleft(plant.GetPositions(plant.GetMyContextFromRoot(self.context)))
        for k, (ghost, context) in enumerate(self._crowd):
            late = min(_DELAY * k, len(self._past) - 1)
            plant.SetPositions(plant.GetMyMutableContextFromRoot(context), self._past[late])
            ghost.pose(context)
        self.scene.meshcat.SetTransform(STAMP, RigidTransform([time.monotonic(), 0.0, 0.0]))
        self.drawn += 1
        return warnings


class CrowdedSession(PlayedSession[_CrowdedPlayer]):
    """A simulation with ghosts and stamps."""

    def __init__(self, scenario: Scenario, *, config: SessionConfig | None = None) -> None:
        super().__init__(scenario, config=config, problem=None)

    def _make_stage(self) -> _CrowdedPlayer:
        return _CrowdedPlayer(self.scenario, self.config)

    @property
    def drawn(self) -> int:
        """Return the number of frames that were drawn."""
        return self._stage.drawn

    def processor_time(self) -> float:
        """Return the processor time of the thread that simulates and draws, in s."""
        assert self._thread.ident is not None
        return time.clock_gettime(time.pthread_getcpuclockid(self._thread.ident))


@contextmanager
def _served(session: PlayedSession[Any]) -> Iterator[View[PlayedSession[Any]]]:
    with View(session, Server(session)) as running:
        yield running


def view_cost(repeats: int = 15, horizon: float = 8.0) -> list[Benchmark]:
    """A rollout of the space climber with its ten ghosts in a page, against the same rollout without any page.

    Both advance along the same grid, as fast as they can, in turns. Frames are drawn by the wall clock, and a client in
    another process reads and unpacks all of them. Beside it, the processor time of the thread that simulates, which
    other load changes less.
    """
    scenario, config = SpaceClimberScenario(), SessionConfig()
    testbed, session = scenario.build(), CrowdedSession(scenario, config=config)
    watched, headless = [], []
    with _served(session) as running, client(read_states, running.url, _LONGEST):
        session.set_speed(inf)
        for k in range(repeats):
            turns = [lambda: watched.append(_watched(session, horizon))]
            turns.append(lambda: headless.append(_headless(testbed, horizon, config.step)))
            for turn in turns if k % 2 else turns[::-1]:
                turn()
        frames = session.drawn
    ours, theirs = 1e3 * np.array(watched), 1e3 * np.array(headless)
    against = "the same rollout without a page"
    rows = []
    for column, (name, goal) in enumerate((("view_cost", 1.05), ("view_cost_cpu", None))):
        note = f"a simulated second takes {spread(ours[:, column], unit='ms')} watched and "
        note += f"{spread(theirs[:, column], unit='ms')} headless; {frames} frames of {GHOSTS + 1} robots"
        value = float(np.median(ours[:, column] / theirs[:, column]))
        rows.append(Benchmark(name=name, value=value, unit="1", goal=goal, better=LOWER, against=against, note=note))
    return rows


def _watched(session: CrowdedSession, horizon: float) -> tuple[float, float]:
    """Return wall time and processor time of a simulated second in a session, in s."""
    session.pause()
    number, when = session.latest.number if session.latest is not None else 0, 0.0  # Older frames do not count.
    session.reset()
    session.advance()
    start = session.snapshot().time
    begin, worked = time.perf_counter(), session.processor_time()
    session.play()
    while when < horizon:
        frame = session.wait_for_frame(number, 60.0)
        assert frame is not None and not frame.failure
        number, when = frame.number, frame.time
    session.pause()
    took = time.perf_counter() - begin, session.processor_time() - worked
    seconds = session.snapshot().time - start
    return took[0] / seconds, took[1] / seconds


def _headless(testbed: VirtualTestbed, horizon: float, step: float) -> tuple[float, float]:
    """Return wall time and processor time of a simulated second along the grid of a session, in s."""
    simulator = testbed.simulator()
    simulator.AdvanceTo(step)
    begin, worked = time.perf_counter(), time.thread_time()
    for k in range(2, round(horizon / step) + 1):
        simulator.AdvanceTo(k * step)
    seconds = horizon - step
    return (time.perf_counter() - begin) / seconds, (time.thread_time() - worked) / seconds


def view_states(seconds: float = 6.0) -> list[Benchmark]:
    """States that a client handles per second, of eleven robots that move in real time; beside it, their age.

    A state counts when the client has unpacked its last pose. Its age is the time since it was drawn. If there is a
    Chromium, the same is measured in the page, with the frames that it draws.
    """
    session = CrowdedSession(SpaceClimberScenario(), config=SessionConfig(frame_rate=40.0))
    with _served(session) as running, client(read_states, running.url, seconds) as read:
        running.session.play()
        result = read()
    messages = result["messages"] / seconds
    note = f"{session.config.frame_rate:g} states/s are drawn of {GHOSTS + 1} robots, {messages:.0f} messages/s"
    states = Benchmark(
        name="view_states",
        value=_rate(result),
        unit="1/s",
        goal=30.0,
        better=HIGHER,
        against="",
        note=note,
        absolute="what the eye sees as motion",
    )
    ages = np.array(result["ages"])
    age = _latency("view_state_age_p95", ages, goal=0.1, against="the instant at which a state is drawn")
    return [states, age, *(_states_in_chromium(seconds) if CHROMIUM else [])]


def _states_in_chromium(seconds: float) -> list[Benchmark]:
    """Return states and frames per second in a browser, which renders them on the processor; there are no goals."""
    session = CrowdedSession(SpaceClimberScenario())
    with _served(session) as running, client(read_states_in_chromium, running.url, seconds) as read:
        running.session.play()
        result = read()
    age = 1e3 * np.percentile(result["ages"], 95.0)
    note = f"on the processor alone; 95 % of the states are handled within {age:.3g} ms"
    rates = {"view_states_chromium": _rate(result), "view_frames_chromium": result["drawn"] / seconds}
    common: dict[str, Any] = {"unit": "1/s", "goal": None, "better": HIGHER, "against": "", "note": note}
    return [Benchmark(name=name, value=value, **common) for name, value in rates.items()]


def _rate(result: dict[str, Any]) -> float:
    """Return states per second."""
    arrivals = result["arrivals"]
    return (len(arrivals) - 1) / (arrivals[-1] - arrivals[0])


def click_p95(clicks: int = 200) -> Benchmark:
    """Measure the time from a click in the page to its confirmation, while workers (nice 5) keep all cores busy.

    The cart-pole runs in real time in the session, and each click sets one of its variables.
    """
    with (
        _rollouts_on_all_cores() as count,
        _served(SimulationSession(CartPoleScenario())) as running,
        client(click, running.url, ANGLE, clicks, 0.02) as result,
    ):
        times = np.array(result())
    against = f"{count} workers with nice {_NICE}, which compute rollouts"
    return _latency("click_p95", times, goal=0.2, against=against)


def preview_latency(drags: int = 60) -> Benchmark:
    """Measure the time from a draft at a slider to the first pose of its ghost at the client, of the cart-pole."""
    with (
        _served(SimulationSession(CartPoleScenario())) as running,
        client(preview, running.url, ANGLE, drags, 0.1) as result,
    ):
        times = np.array(result())
    return _latency("preview_latency", times, goal=0.25, against="")


def _latency(name: str, times: np.ndarray, *, goal: float, against: str) -> Benchmark:
    value = float(np.percentile(times, 95.0))
    note = f"95 % of {times.size} come sooner; {spread(1e3 * times, unit='ms')}"
    return Benchmark(
        name=name,
        value=value,
        unit="s",
        goal=goal,
        better=LOWER,
        against=against,
        note=note,
        absolute="what a person takes for at once",
    )


@contextmanager
def _rollouts_on_all_cores() -> Iterator[int]:
    """Keep every core busy with rollouts of the space climber, in processes with a lower priority."""
    processes, count = get_context("spawn"), len(os.sched_getaffinity(0))
    begun = [processes.Event() for _ in range(count)]
    workers = [processes.Process(target=_roll_out, args=(event,), daemon=True) for event in begun]
    for worker in workers:
        worker.start()
    try:
        for event in begun:
            event.wait()
        yield count
    finally:
        for worker in workers:
            worker.kill()


def _roll_out(begun: Event) -> None:
    os.nice(_NICE)
    testbed = SpaceClimberScenario().build()
    while True:
        simulator = testbed.simulator()
        simulator.AdvanceTo(1.0)
        begun.set()
        simulator.AdvanceTo(10.0)
