"""Rollouts of a study side by side, at one time: the best as it is, others as ghosts."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vtbdrake.failures import one_line
from vtbdrake.rollout.testbeds import Testbeds
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.visualization.camera import fitting_camera
from vtbdrake.visualization.drawing import Drawing, Parts
from vtbdrake.visualization.meshcat import make_meshcat
from vtbdrake.web.requests import Requests
from vtbdrake.web.study_worker import PointError, PointRollout

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat
    from pydrake.systems.framework import Context

# Role -> tint, and the opacity of a ghost. The best has its own colours.
TINTS = {"best": None, "pointed": "#cc3399", "tried": "#009e73"}
_GHOST = 0.55
# Instants of a rollout to which the camera is fitted.
_INSTANTS = 20
# Of the camera's view, which is half a page, and narrower than 4:3.
_MARGIN = 1.8


@dataclass
class _Actor:
    """A rollout, and how it is drawn."""

    rollout: PointRollout
    testbed: VirtualTestbed
    context: Context
    drawing: Drawing

    def pose(self, time: float) -> None:
        times, states = self.rollout.result.times, self.rollout.result.record["plant.state"]
        plant = self.testbed.plant
        assert plant is not None
        # Between the samples on a line; before and after them as at the ends.
        state = [np.interp(time, times, values) for values in states.T]
        plant.SetPositionsAndVelocities(plant.GetMyMutableContextFromRoot(self.context), state)
        self.drawing.pose(self.context)


class StudyScene:
    """A Meshcat with the rollouts that are shown, in a thread of its own.

    Attributes:
        meshcat_url: Its address; it has no protection of its own.
    """

    def __init__(self) -> None:
        self.meshcat_url = ""
        self._commands = Requests(PointError, "the page has ended", _failure)
        ready: Future[None] = Future()
        self._thread = threading.Thread(target=self._run, args=(ready,), name="vtbdrake scene", daemon=True)
        self._thread.start()
        ready.result()

    def close(self) -> None:
        """End the scene and its Meshcat."""
        self._commands.end()
        self._thread.join()

    def show(self, role: str, rollout: PointRollout | None) -> None:
        """Show a rollout in a role, a key of `TINTS`; None removes what is there.

        Raises:
            PointError: The rollout has no motion that could be drawn.
        """
        self._do(lambda: self._show(role, rollout))

    def set_time(self, time: float) -> None:
        """Show all rollouts at a time in seconds since their begin."""
        self._do(lambda: self._set_time(time))

    def _do(self, action: Callable[[], object]) -> None:
        self._commands.ask(self._thread, action)

    # -- in the thread of the scene

    def _run(self, ready: Future[None]) -> None:
        self._meshcat: Meshcat = make_meshcat()
        self.meshcat_url = self._meshcat.web_url()
        self._testbeds, self._time = Testbeds(), 0.0
        self._actors: dict[str, _Actor] = {}
        self._scenery: Drawing | None = None
        ready.set_result(None)
        while self._commands.carry_out():
            pass
        for name in ("_actors", "_scenery", "_testbeds", "_meshcat"):
            del self.__dict__[name]
        gc.collect()  # Meshcat ends in the thread that made it.

    def _show(self, role: str, rollout: PointRollout | None) -> None:
        actor = self._actors.pop(role, None)
        if rollout is None:
            if actor is not None:
                actor.drawing.delete()
            return
        if len(rollout.result.times) == 0 or "plant.state" not in rollout.result.record:
            if actor is not None:
                actor.drawing.delete()
            raise PointError(rollout.result.message or "there is nothing to draw: the testbed has no MultibodyPlant")
        if actor is None or actor.rollout.scenario != rollout.scenario:
            actor = self._make(role, rollout)
        actor.rollout = rollout
        actor.pose(self._time)
        self._actors[role] = actor

    def _make(self, role: str, rollout: PointRollout) -> _Actor:
        testbed = self._testbeds.get(rollout.scenario)
        context = testbed.default_context()
        ghost = role != "best"
        drawing = Drawing(
            self._meshcat,
            testbed,
            context,
            f"study/{role}",
            tint=TINTS[role],
            opacity=_GHOST if ghost else 1.0,
            parts=Parts.MOVING,
        )
        actor = _Actor(rollout, testbed, context, drawing)
        if self._scenery is None:
            self._fit_camera(actor)
        if self._scenery is None or not ghost:
            self._scenery = Drawing(self._meshcat, testbed, context, "study/scenery", parts=Parts.ANCHORED)
        return actor

    def _fit_camera(self, actor: _Actor) -> None:
        """Move the camera so that all that moves is in view, from begin to end."""
        corners = []
        for time in np.linspace(0.0, actor.rollout.result.times[-1], _INSTANTS):
            actor.pose(time)
            corners.append(actor.drawing.corners(actor.context))
        camera = fitting_camera(np.hstack(corners), margin=_MARGIN)
        self._meshcat.SetCameraPose(camera.position, camera.target)

    def _set_time(self, time: float) -> None:
        self._time = time
        for actor in self._actors.values():
            actor.pose(self._time)


def _failure(error: BaseException) -> PointError:
    """Return what another thread raises for an error of the scene's."""
    return error if isinstance(error, PointError) else PointError(one_line(error))
