"""The page of a study: how long it takes to open, and what it costs the study that is watched."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from math import nan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from benchmarks.measure import LOWER, Benchmark, interleaved, interleaved_values, spread
from tests.chromium import running_browser
from tests.web.study.studies import cart_pole_problem
from vtbdrake.optimization.records import Outcome, Trial
from vtbdrake.optimization.study.study_file import StudyFile
from vtbdrake.web import view_study

ROOT = Path(__file__).resolve().parents[1]
OPEN_GOAL, COST_GOAL = 1.0, 1.01
TRIALS, FEW = 10_000, 10

# A study of the climber's gait on all cores, which prints its CPU time, its workers' included, and its wall time.
_STUDY = """
import resource, sys, time
import vtbdrake as vtb
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

problem = vtb.Problem(
    scenario=SpaceClimberScenario(),
    parameters=[vtb.Parameter("dps.impl.gait.period", 0.5, 2.0), vtb.Parameter("dps.impl.gait.stroke", 0.02, 0.2)],
    quality=vtb.Quality(abs, "sim.sys.climber.base.x"),
    horizon=2.0,
)
study = problem.study(sys.argv[1], solver="random", seed=1)
print("ready", flush=True)
sys.stdin.readline()
begin = time.perf_counter()
study.run(rollouts=int(sys.argv[2]), executor="processes", progress=False)
wall = time.perf_counter() - begin
used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
print(sum(u.ru_utime + u.ru_stime for u in used), wall, flush=True)
"""


def study_page_open(repeats: int = 3) -> Benchmark:
    """Seconds that 10,000 trials add to the opening of a page, from the file to their picture in Chromium.

    Beside it: a study of ten trials. What both have in common is Chromium with Meshcat's page, and the testbed.
    """
    with TemporaryDirectory() as folder, running_browser() as browser:
        paths = {count: _recorded(Path(folder) / f"{count}.db", count) for count in (TRIALS, FEW)}

        def open_page(count: int) -> None:
            with view_study(paths[count]) as view:
                page = browser.new_page(viewport={"width": 1280, "height": 800})
                page.goto(view.url)
                charts = ("vtb-landscape", "vtb-history-chart")
                drawn = " && ".join(f"document.getElementById('{id}')?.dataset.points === '{count}'" for id in charts)
                page.wait_for_function(drawn, timeout=120_000)
                page.close()

        many, few = interleaved(lambda: open_page(TRIALS), lambda: open_page(FEW), repeats=repeats)
    return Benchmark(
        name="study_page_open",
        value=float(np.median(many) - np.median(few)),
        unit="s",
        goal=OPEN_GOAL,
        better=LOWER,
        absolute="what a person waits for",
        against="the same page of ten trials",
        note=f"{TRIALS} trials in {spread(many)}, {FEW} in {spread(few)}, Chromium with a software renderer",
    )


def study_page_cost(rollouts: int = 200, repeats: int = 2) -> Benchmark:
    """CPU time of a study and of the process of its page, over the study's alone, which runs on all cores.

    The page's process is ``vtbdrake study open``, with a client that reads as a browser does. Both are measured while
    the study runs. Printed beside it: the same study without a page. The CPU times of two equal studies differ by more
    than a page takes, so that the ratio of these says less.
    """
    shares: list[float] = []
    walls: dict[bool, list[float]] = {True: [], False: []}

    def cpu(watched: bool) -> float:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "a.db"
            call = [sys.executable, "-c", _STUDY, str(path), str(rollouts)]
            pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
            with subprocess.Popen(call, text=True, cwd=ROOT, **pipes) as study:
                assert study.stdin is not None and study.stdout is not None
                study.stdout.readline()
                with _page(path) if watched else _nobody() as page:
                    before = _cpu_time(page)
                    study.stdin.write("\n")
                    study.stdin.flush()
                    used, wall = map(float, study.stdout.readline().split())
                    walls[watched].append(wall)
                    if watched:
                        shares.append((_cpu_time(page) - before) / used)
                    return used

    watched, alone = interleaved_values(lambda: cpu(True), lambda: cpu(False), repeats=repeats)
    return Benchmark(
        name="study_page_cost",
        value=1.0 + float(np.median(shares)),
        unit="1",
        goal=COST_GOAL,
        better=LOWER,
        against="the study without its page",
        note=f"shares of the page {spread(100.0 * np.array(shares), unit='%')}; CPU time of the study "
        f"{spread(watched)} with the page, {spread(alone)} without; wall time {spread(np.array(walls[True]))} and "
        f"{spread(np.array(walls[False]))}",
    )


def _recorded(path: Path, count: int) -> Path:
    """Write a study of ``count`` trials, as if it had run."""
    with cart_pole_problem().study(path, solver="random") as study:
        addresses = [parameter.address for parameter in study.parameters]
    file, rng = StudyFile(path), np.random.default_rng(0)
    points = [(float(angle), float(rate)) for angle, rate in rng.uniform((0.5, -3.0), (3.0, 3.0), (count, 2))]
    for batch in range(0, count, 100):
        trials = {}
        for position, point in enumerate(points[batch : batch + 100]):
            value = abs(np.sin(point[0]) * point[1])
            file.add(point, 0, Outcome(value, value, (-1.0,), 1.0, "horizon", "", nan))
            parameters = dict(zip(addresses, point, strict=True))
            trials[position] = Trial(parameters, (value,), (-1.0,), True, "solver", "random", batch // 100)
        file.save_trials(batch // 100, trials, complete=True)
    file.close()
    return path


@contextmanager
def _page(path: Path) -> Iterator[int]:
    """A page in a process of its own, with a client that reads; yields its process id."""
    call = [sys.executable, "-m", "vtbdrake", "study", "open", str(path), "--no-browser", "--json"]
    with subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        parts = urlsplit(json.loads(process.stdout.readline())["url"])
        with connect(f"ws://{parts.netloc}/session?{parts.query}", max_size=None) as socket:
            # The worker is warm when it has simulated a point.
            socket.send(json.dumps({"id": 1, "do": "try", "point": [1.0, 0.1]}))
            while json.loads(socket.recv()).get("id") != 1:
                pass
            reader = threading.Thread(target=_read_all, args=(socket,))
            reader.start()
            yield process.pid
            process.terminate()
            reader.join()


@contextmanager
def _nobody() -> Iterator[None]:
    yield None


def _read_all(socket: ClientConnection) -> None:
    with suppress(ConnectionClosed):
        for message in socket:
            json.loads(message)


def _cpu_time(page: int | None) -> float:
    """CPU time of a process and of its children so far, in seconds."""
    ticks = 0
    for stat in Path("/proc").glob("[0-9]*/stat") if page is not None else ():
        with suppress(OSError):  # It has ended meanwhile.
            # The name, in parentheses, may have spaces.
            fields = stat.read_text().rpartition(")")[2].split()
            if page in (int(stat.parent.name), int(fields[1])):
                ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")
