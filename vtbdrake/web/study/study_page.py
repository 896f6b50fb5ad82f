"""The page of a study: it is watched while it runs, its rollouts are seen, and points are tried."""

from __future__ import annotations

import asyncio
import base64
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from vtbdrake.common.argument_checks import as_whole
from vtbdrake.common.extras import extra_module
from vtbdrake.common.failures import one_line
from vtbdrake.common.json_data import plain
from vtbdrake.common.summary_html import png_of
from vtbdrake.optimization import Choice, Problem, Study, StudyError
from vtbdrake.optimization.identity import code_changes, describe
from vtbdrake.optimization.parameter import Dimension, short_address
from vtbdrake.optimization.records import DrivenTrial, Outcome
from vtbdrake.optimization.solvers import known_solvers
from vtbdrake.optimization.statement import StatementError, check_statement, restated
from vtbdrake.optimization.study.study_file import StudyFile
from vtbdrake.web.serving.web_page import WebPage
from vtbdrake.web.study.study_feed import StudyFeed, place
from vtbdrake.web.study.study_model import Surrogate
from vtbdrake.web.study.study_scene import TINTS, StudyScene
from vtbdrake.web.study.study_worker import PointError, PointRollout, PointSimulator

if TYPE_CHECKING:
    from starlette.websockets import WebSocket

_PERIOD = 0.2  # s between two messages to a page
_PATIENCE = 1.0  # s, for a change
# Commands that change the study: their order counts.
_CHANGES = ("give", "intervene", "remove", "run")


class StudyView(WebPage):
    """A study with its page, while it runs here, in another process, or not at all.

    Args:
        file: The file of the study.
        problem: The problem; None: as the file states it.
        trusted: Modules that may be imported because the file names them.
        port: The port of the page; 0: any that is free.
        hosts: Host names (with port) under which proxies offer the page.

    Attributes:
        study: The study; what the page does, it does, too.
        simulator: Simulates its points, beside the study; None if the problem is not known here.
        obstacle: Why the problem is not known here.
        runner: The process in which `resume` has resumed the study.
    """

    def __init__(
        self, file: StudyFile, *, problem: Problem | None, trusted: Sequence[str], port: int, hosts: Collection[str]
    ) -> None:
        from vtbdrake.web.serving.host import Host

        self.study = Study(file)
        self.trusted = tuple(trusted)
        self.obstacle, self._untold = "", "it is in memory"
        self.runner: subprocess.Popen[bytes] | None = None
        self._errors: IO[str] | None = None  # of the runner
        # Whether others can state the problem again, from the file alone.
        self.restatable = False
        self.problem = self._stated(problem)
        self.simulator: PointSimulator | None = None
        self.surrogate = Surrogate(self.study)
        self.feed = StudyFeed(file)
        self.scene = StudyScene()
        self._host: Host | None = None
        try:
            if self.problem is not None:
                self.simulator = PointSimulator(self.problem)
            super().__init__(
                Host(
                    lambda: self.scene.meshcat_url,
                    script="study.js",
                    packages=("vtbdrake.web.study", "vtbdrake.visualization"),  # uPlot: in page/vendor of the latter
                    serve=self._serve_page,
                    port=port,
                    hosts=hosts,
                )
            )
        except BaseException:
            self.close()
            raise

    def __repr__(self) -> str:
        return f"<StudyView of {self.study.path or 'a study in memory'} at {self.url}>"

    def _repr_mimebundle_(self, **_: Any) -> dict[str, Any]:
        """Show the page in a notebook, and the history of the study where there is no kernel."""
        # An address is not for those who read a stored notebook.
        static: dict[str, Any] = {"text/plain": repr(self.study)}
        if any(trial.counts for trial in self.study.trials):
            static["image/png"] = base64.b64encode(png_of(self.study.plot_history())).decode()
        return self._framed(static, height=800)

    def close(self) -> None:
        """End the page; the study goes on."""
        if self._host is not None:
            self._host.close()
        self.feed.close()
        self.surrogate.close()
        if self.simulator is not None:
            self.simulator.close()
        self.scene.close()
        if self.study.path is not None:
            self.study.close()

    def _stated(self, problem: Problem | None) -> Problem | None:
        """Return the problem; state it again from the file if it is not known."""
        try:
            if self.study.path is not None:
                check_statement(self.study.record, trusted=self.trusted)
                self.restatable = True
            return problem or restated(self.study.record, trusted=self.trusted)
        except StatementError as error:
            self._untold = one_line(error)
            self.obstacle = "" if problem is not None else self._untold
            return problem

    @cached_property
    def code_changes(self) -> list[str]:
        """Return the changes of the problem's code since the file was written, each as a phrase."""
        if self.problem is None:
            return []
        return code_changes(self.study.record["problem"], describe(self.problem))

    @property
    def resume_command(self) -> list[str]:
        """Return the command that resumes the study in a process of its own; empty if only its program can do so."""
        return self.command("continue")

    def command(self, name: str, *arguments: str) -> list[str]:
        """Return a command of the study whose problem the file states; empty if it does not.

        Args:
            name: The subcommand of ``vtbdrake study``, such as ``continue``.
            arguments: Further words, behind the file of the study.
        """
        if not self.restatable:
            return []
        trust = [word for module in self.trusted for word in ("--trust", module)]
        return [sys.executable, "-m", "vtbdrake", "study", name, str(self.study.path), *trust, *arguments]

    def resume(self) -> None:
        """Resume the study in a process of its own, which goes on when the page ends.

        Raises:
            StudyError: The study is running, or only its program can resume it.
        """
        if not self.resume_command:
            raise StudyError(f"only the program that began the study can resume it: {self._untold}")
        if self.study.is_running or (self.runner is not None and self.runner.poll() is None):
            raise StudyError("the study is running")
        if self.study.search.budget is None:
            raise StudyError("the study has no budget of rollouts: give it one first")
        # Files outlive this process, as the runner may.
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115
        quiet: dict[str, Any] = {name: subprocess.DEVNULL for name in ("stdin", "stdout")}
        self.runner = subprocess.Popen(self.resume_command, start_new_session=True, stderr=self._errors, **quiet)

    @property
    def runner_failure(self) -> str:
        """Return the reason why the process of `resume` has failed; empty if it has not."""
        if self.runner is None or self._errors is None or self.runner.poll() in (None, 0):
            return ""
        self._errors.seek(0)
        lines = self._errors.read().strip().splitlines()
        return f"the process that was to go on has ended: {lines[-1] if lines else f'code {self.runner.poll()}'}"

    async def _serve_page(self, browser: WebSocket) -> None:
        await _StudyPage(self, browser).serve()


class _StudyPage:
    """The connection to one page."""

    def __init__(self, view: StudyView, browser: WebSocket) -> None:
        self._view, self._study, self._browser = view, view.study, browser
        self._revision, self._count, self._notice = -1, 0, ""
        self._commands: dict[str, Callable[..., Any]] = {
            "show": self._show,
            "hide": lambda role: view.scene.show(str(role), None),
            "time": lambda time: view.scene.set_time(float(time)),
            "model": self._model,
            "importance": self._importance,
            "try": self._try,
            "give": self._give,
            "intervene": lambda kind, payload: self._study.intervene(kind, **payload).number,
            "remove": lambda number: self._study.remove(number),
            "run": view.resume,
        }

    async def serve(self) -> None:
        """Answer commands, and send what is new."""
        from starlette.concurrency import run_in_threadpool

        from vtbdrake.web.serving.host import action_of, answer_commands, first_of, send

        await send(self._browser, await run_in_threadpool(self._hello))

        async def tell() -> None:
            while True:
                for message in await run_in_threadpool(self._news):
                    await send(self._browser, message)
                await asyncio.sleep(_PERIOD)

        changes = asyncio.Lock()  # It lets them in one after another, as they came.

        async def carry_out(message: Mapping[str, Any]) -> Any:
            action = action_of(message, self._commands)
            fields = {key: value for key, value in message.items() if key not in ("id", "do")}
            async with changes if message["do"] in _CHANGES else nullcontext():
                return await run_in_threadpool(action, **fields)

        await first_of(tell(), answer_commands(self._browser, carry_out, together=True))

    def _hello(self) -> dict[str, Any]:
        view, record = self._view, self._study.record
        described = record["problem"]
        return {
            "type": "hello",
            "name": "study" if self._study.path is None else self._study.path.name,
            "path": "" if self._study.path is None else str(self._study.path),
            "parameters": _described(self._study.parameters, self._study.units),
            "qualities": [
                {"name": name, "unit": unit, "minimize": direction == "minimize"}
                for name, unit, direction in zip(
                    self._study.names, self._study.quality_units, self._study.directions, strict=True
                )
            ],
            "constraints": [constraint["name"] for constraint in described["constraints"]],
            "conditions": described["conditions"],
            "horizon": described["horizon"],
            "solvers": list(known_solvers()),
            "simulates": view.simulator is not None,
            "obstacle": view.obstacle,
            "changes": view.code_changes,
            "command": shlex.join(view.resume_command),
            "replay": shlex.join(view.command("replay", "NEW.db", "--without")),
        }

    def _news(self) -> list[dict[str, Any]]:
        """Return the messages about what has changed, when something has."""
        revision, notice = self._view.feed.wait(self._revision, _PATIENCE), self._view.scene.notice
        if notice != self._notice:
            self._notice = notice
            return [{"type": "picture", "notice": notice}]
        if revision == self._revision:
            return []
        trials = self._view.feed.columns(self._count, self._revision)
        self._revision, self._count = trials["revision"], trials["first"] + len(trials["kinds"])
        return [trials, self._status()]

    def _status(self) -> dict[str, Any]:
        status, view = self._view.feed.status, self._view
        search, budget = status.search, status.search.budget
        left = None
        if budget is not None and status.rate:
            left = max(0.0, budget - status.rollouts) / status.rate
        names = ("state", "reason", "rollouts", "ends", "rate", "failures")
        return {
            "type": "status",
            **{name: getattr(status, name) for name in names},
            "message": status.message or view.runner_failure,
            "budget": budget,
            "left": left,
            "parameters": _described(search.widest, self._study.units),
            "ranges": _described(search.ranges, self._study.units),
            "frozen": dict(search.frozen),
            "forbidden": [[number, dict(region)] for number, region in search.forbidden.items()],
            "solver": search.solver,
            "aspiration": search.aspiration,
            "paused": search.paused,
            "driven": view.feed.driven_columns(),
            "interventions": [{**i.to_dict(), "text": i.text} for i in status.interventions],
        }

    # -- commands

    def _show(
        self, *, role: str, trial: int | None = None, driven: int | None = None, point: Any = None, condition: int = 0
    ) -> dict[str, Any]:
        """Show the rollout of a trial, of a driven one, or of a point, in a role."""
        simulator = self._simulator()
        if role not in TINTS:
            raise StudyError(f"a rollout is shown as {', '.join(TINTS)}, not as {role!r}")
        if driven is not None:
            return self._shown_again(role, self._driven(driven))
        shown = self._trial(trial).point if trial is not None else simulator.problem.point(self._point(point))
        number = as_whole("the number of a condition", condition)
        return self._shown(role, simulator.rollout(shown, condition=number, role=role))

    def _shown(self, role: str, rollout: PointRollout) -> dict[str, Any]:
        try:
            self._view.scene.show(role, rollout)
            message = ""
        except PointError as error:
            message = one_line(error)
        result = rollout.result
        return {
            "duration": float(result.times[-1]) if len(result.times) else 0.0,
            "t_star": plain(result.t_star),
            "end": result.end,
            "message": result.message or message,
            "seconds": plain(result.wall_time),
        }

    def _shown_again(self, role: str, trial: DrivenTrial) -> dict[str, Any]:
        rollout = self._simulator().drive(trial, role=role)
        shown, now = self._shown(role, rollout), Outcome.of(rollout.result)
        if not np.array_equal(_numbers(now), _numbers(trial.outcome), equal_nan=True):
            shown["message"] = (
                f"computed again, the course has another value, {now.value:.5g}: the code has changed since"
            )
        return shown

    def _try(self, *, point: Any, condition: int = 0) -> dict[str, Any]:
        simulator = self._simulator()
        tried_point = simulator.problem.point(self._point(point))
        tried = simulator.attempt(tried_point)
        shown = self._shown("tried", simulator.rollout(tried_point, condition=condition, role="tried"))
        evaluation = tried.evaluation
        return {
            **shown,
            "point": [place(p, value) for p, value in zip(self._study.parameters, tried_point, strict=True)],
            "values": plain(evaluation.values),
            "violations": plain(evaluation.violations),
            "kind": "failed" if evaluation.failed else "feasible" if evaluation.feasible else "broken",
            "message": "; ".join(tried.messages) or shown["message"],
        }

    def _give(self, *, point: Any) -> None:
        """Give a point to the study, with its rollouts if it was tried here."""
        values = self._point(point)
        simulator = self._view.simulator
        results = simulator.results(simulator.problem.point(values)) if simulator is not None else None
        if results is None:
            self._study.add(values)
        else:
            self._study.add_results(values, results)

    def _model(self, *, x: str, y: str, quality: int, trial: int) -> dict[str, Any]:
        trials = list(self._view.feed.trials)
        grid = self._view.surrogate.grid(trials, str(x), str(y), quality=int(quality), at=self._trial(trial))
        return {**grid, "trials": len(trials)}

    def _importance(self, *, quality: int) -> dict[str, Any]:
        trials = list(self._view.feed.trials)
        return {**self._view.surrogate.importance(trials, quality=int(quality)), "trials": len(trials)}

    def _simulator(self) -> PointSimulator:
        simulator = self._view.simulator
        if simulator is None:
            raise StudyError(f"points cannot be simulated here: {self._view.obstacle}")
        simulator.widen(self._study.parameters)
        return simulator

    def _trial(self, number: int) -> Any:
        trials = self._view.feed.trials
        if not 0 <= as_whole("the number of a trial", number) < len(trials):
            raise StudyError(f"the study has {len(trials)} trials, counted from 0, and no trial {number}")
        return trials[number]

    def _driven(self, number: int) -> DrivenTrial:
        matches = [trial for trial in self._view.feed.driven if trial.number == number]
        if not matches:
            raise StudyError(f"the study has no driven trial {number}")
        return matches[0]

    def _point(self, point: Any) -> list[Any]:
        """Return a point of a page, which has the numbers of options instead of options."""
        pairs = zip(self._study.parameters, point, strict=True)
        return [p.options[int(value)] if isinstance(p, Choice) else value for p, value in pairs]


def _numbers(outcome: Outcome) -> list[float]:
    return [outcome.h, outcome.value, outcome.t_star, *outcome.measures]


def _described(parameters: Sequence[Dimension], units: Sequence[str]) -> list[dict[str, Any]]:
    addresses = [parameter.address for parameter in parameters]
    return [
        {**asdict(parameter), "unit": unit, "label": short_address(parameter.address, addresses)}
        for parameter, unit in zip(parameters, units, strict=True)
    ]


def view_study(
    source: StudyFile | str | os.PathLike[str],
    *,
    problem: Problem | None = None,
    trusted: Sequence[str] = (),
    port: int = 0,
    hosts: Collection[str] = (),
) -> StudyView:
    """Open the page of a study, which may run here, in another process, or not at all.

    Args:
        source: The file of the study, or its path.
        problem: Its problem, if it is known here; else it is stated again from the file.
        trusted: Modules, or packages of them, that may be imported because the file names them, which runs their code.
        port: The port of the page on the loopback interface; 0 for any that is free.
        hosts: Host names (with port) under which proxies offer the page.

    Raises:
        StudyError: There is no such file, it is no study, damaged, or of another version.
        PortError: The port is taken.
        ModuleNotFoundError: The extra ``web`` is not installed.
    """
    for name in ("msgpack", "starlette", "uvicorn", "websockets"):
        extra_module(name, purpose="the page of a study", extra="web")
    file = source if isinstance(source, StudyFile) else StudyFile(Path(source))
    return StudyView(file, problem=problem, trusted=trusted, port=port, hosts=hosts)
