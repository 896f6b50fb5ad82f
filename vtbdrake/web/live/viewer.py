"""A session with its page."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from vtbdrake.common.extras import extra_module
from vtbdrake.web.live.log_session import LogSession
from vtbdrake.web.live.simulation_session import SimulationSession
from vtbdrake.web.serving.web_page import WebPage

if TYPE_CHECKING:
    from vtbdrake.optimization import Problem
    from vtbdrake.recording import ControlLog, Log
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Scenario
    from vtbdrake.web.live.loop_session import LoopSession
    from vtbdrake.web.live.player import SessionConfig
    from vtbdrake.web.live.session import Session
    from vtbdrake.web.live.session_server import Server
    from vtbdrake.web.live.simulation_session import PlayedSession
    from vtbdrake.web.serving.tls import Tls
    from vtbdrake.web.vr.virtual_reality import LedRobot

_Session = TypeVar("_Session", bound="Session[Any]")


class View(WebPage, Generic[_Session]):
    """A testbed that runs in the background, and its page, where it is watched and steered.

    Args:
        server: The server of the page.

    Attributes:
        session: The running testbed: what the page can do, it can do, too.
    """

    def __init__(self, session: _Session, server: Server) -> None:
        super().__init__(server.host)
        self.session, self._server = session, server

    def __repr__(self) -> str:
        return f"<View of {self.session.scenario.name()} at {self.url}>"

    def _repr_mimebundle_(self, **_: Any) -> dict[str, Any]:
        """Show the page in a notebook, and how the testbed looks now where there is no kernel."""
        from vtbdrake.visualization.meshcat import picture_bundle

        # An address is not for those who read a stored notebook.
        text = f"<View of {self.session.scenario.name()}>"
        return self._framed(picture_bundle(text, self.session.still()))

    def close(self) -> None:
        """End the page and the testbed."""
        self._server.close()
        self.session.close()


def view_loop(
    scenario: Scenario,
    url: str,
    *,
    port: int = 0,
    hosts: Collection[str] = (),
    vr: bool = False,
    tls: Tls | None = None,
) -> View[LoopSession]:
    """Show a loop that runs in another process, such as ``vtbdrake run``, through its live values.

    Args:
        scenario: The scenario of the loop.
        url: LCM URL of its bus.
        port: The port of the page on the loopback interface; 0 for any that is free.
        hosts: Host names (with port) under which proxies offer the page.
        vr: Let headsets that open the page lead the robot of the loop, see `Scenario.hand_command`.
        tls: Serve the page by https to other devices; None keeps it to this machine.

    Raises:
        ValueError: The testbed cannot be built.
        PortError: The port is taken.
        BridgeError: There is no bus, and ``vr`` needs one.
        ModuleNotFoundError: The extra ``web`` is not installed.
    """
    _check_extra()
    from vtbdrake.web.live.loop_session import LoopSession
    from vtbdrake.web.vr.virtual_reality import ControlledRobot

    session = LoopSession(scenario, url)
    robot = partial(ControlledRobot, scenario, url, trouble=lambda: session.trouble)
    return _served(session, robot if vr else None, port=port, hosts=hosts, tls=tls)


def view(
    scenario: Scenario | None = None,
    *,
    log: ControlLog | Log | str | os.PathLike[str] | None = None,
    start: Snapshot | None = None,
    values: Mapping[str, Any] | None = None,
    config: SessionConfig | None = None,
    problem: Problem | None = None,
    study: str | os.PathLike[str] | None = None,
    trusted: Sequence[str] = (),
    folder: str | os.PathLike[str] = ".",
    port: int = 0,
    hosts: Collection[str] = (),
    vr: bool = False,
    tls: Tls | None = None,
) -> View[PlayedSession[Any]]:
    """Run a testbed in the background, paused, with a page where it is watched and steered.

    Args:
        scenario: The scenario; of a problem or a log, it may be left out.
        log: A log (of a real or a simulated machine) that is replayed, or the path of its file; see `LogSession`. A log
            of another program needs the scenario.
        start: A snapshot to start from; s0 if left out.
        values: Variables that are set first, by address.
        config: How it runs.
        problem: The problem whose quality judges what is driven by hand; it is one of the scenario.
        study: The file of a study of the problem, in which the page stores drives. Without a problem, it is the
            study's.
        trusted: Modules, or packages of them, that may be imported because the study names them, which runs their
            code.
        folder: Where the page saves tests.
        port: The port of the page on the loopback interface; 0 for any that is free.
        hosts: Host names (with port) under which proxies offer the page.
        vr: Let headsets that open the page lead the simulated robot, see `Scenario.hand_command`.
        tls: Serve the page by https to other devices; None keeps it to this machine.

    Raises:
        ValueError: The testbed cannot be built, a value cannot be set, or (a `LogError`) the log cannot be replayed.
        OSError: The log cannot be read.
        PortError: The port is taken.
        ModuleNotFoundError: The extra ``web`` is not installed.
    """
    _check_extra()
    from vtbdrake.web.live.simulated_robot import SimulatedRobot

    if study is not None and problem is None:
        problem = _problem_of(study, trusted)
    files = {"folder": Path(folder), "study": None if study is None else Path(study)}
    if log is not None:
        if start is not None or values or vr:
            raise ValueError("a log is replayed as it was recorded: leave out start, values and vr")
        replay = LogSession(log, scenario=scenario, config=config, problem=problem)
        return _served(replay, None, **files, port=port, hosts=hosts, tls=tls)
    if scenario is None and problem is None:
        raise ValueError("there is nothing to view: give a scenario, a problem or a log")
    scenario = scenario or (problem.scenario if problem is not None else None)
    assert scenario is not None
    session = SimulationSession(scenario, start=start, values=values, config=config, problem=problem)
    robot = partial(SimulatedRobot, session)
    return _served(session, robot if vr else None, **files, port=port, hosts=hosts, tls=tls)


def _problem_of(study: str | os.PathLike[str], trusted: Sequence[str]) -> Problem:
    from vtbdrake.optimization import Study
    from vtbdrake.optimization.statement import restated

    with Study.open(study) as opened:
        return restated(opened.record, trusted=trusted)


def _check_extra() -> None:
    for name in ("msgpack", "starlette", "uvicorn", "websockets"):
        extra_module(name, purpose="the live page", extra="web")


def _served(session: _Session, robot: Callable[[], LedRobot] | None, **options: Any) -> View[_Session]:
    """Return a session with its page, where headsets lead the robot; if one cannot be made, the others are closed."""
    from vtbdrake.web.live.session_server import Server
    from vtbdrake.web.vr.virtual_reality import VirtualReality

    with ExitStack() as stack:
        stack.callback(session.close)
        reality = None
        if robot is not None:
            reality = VirtualReality(robot(), picture=lambda: session.meshcat_url)
            stack.callback(reality.close)
        opened = View(session, Server(session, vr=reality, **options))
        stack.pop_all()
        return opened
