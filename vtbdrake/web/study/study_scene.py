"""Rollouts of a study side by side, at one time: the best as it is, others as ghosts."""

from __future__ import annotations

import gc
import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.drake_workarounds.kept_meshcats import DEATH, abandon_if_dead, is_running
from vtbdrake.rollout.testbeds import Testbeds
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.visualization.drawing import Drawing, Parts
from vtbdrake.visualization.meshcat import make_meshcat
from vtbdrake.visualization.viewpoint import fitting_camera
from vtbdrake.web.serving.requests import Requests, wait_for_end
from vtbdrake.web.study.study_worker import PointError, PointRollout

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat
    from pydrake.systems.framework import Context

# Role -> tint, and the opacity of a ghost. The best has its own colours.
TINTS = {"best": None, "pointed": "#cc3399", "tried": "#009e73"}
_GHOST = 0.55
_PERIOD = 0.2  # s of wall time between two looks at whether Meshcat runs
_log = logging.getLogger(__name__)
# Instants of a rollout to which the camera is fitted.
_INSTANTS = 20
# Margin of the camera's view, which is half a page, and narrower than 4:3.
_MARGIN = 1.8


@dataclass
class _DrawnRollout:
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


class _Picture:
    """The rollouts that are drawn in a Meshcat, for the thread that makes it.

    Attributes:
        meshcat: The Meshcat.
    """

    def __init__(self) -> None:
        self.meshcat: Meshcat = make_meshcat()
        self._testbeds = Testbeds()
        self._time = 0.0
        self._actors: dict[str, _DrawnRollout] = {}
        self._scenery: Drawing | None = None

    def replace_meshcat(self) -> dict[str, PointRollout]:
        """Take another Meshcat, which is empty, and return the rollouts that were shown, by role."""
        meshcat = make_meshcat()
        abandon_if_dead(self.meshcat)
        self.meshcat = meshcat
        rollouts = {role: actor.rollout for role, actor in self._actors.items()}
        self._actors.clear()
        self._scenery = None
        return rollouts

    def show(self, role: str, rollout: PointRollout | None) -> None:
        """Draw a rollout in a role; None removes what is there."""
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

    def _make(self, role: str, rollout: PointRollout) -> _DrawnRollout:
        testbed = self._testbeds.get(rollout.scenario)
        context = testbed.default_context()
        ghost = role != "best"
        drawing = Drawing(
            self.meshcat,
            testbed,
            context,
            f"study/{role}",
            tint=TINTS[role],
            opacity=_GHOST if ghost else 1.0,
            parts=Parts.MOVING,
        )
        actor = _DrawnRollout(rollout, testbed, context, drawing)
        if self._scenery is None:
            self._fit_camera(actor)
        if self._scenery is None or not ghost:
            self._scenery = Drawing(self.meshcat, testbed, context, "study/scenery", parts=Parts.ANCHORED)
        return actor

    def _fit_camera(self, actor: _DrawnRollout) -> None:
        """Move the camera so that all that moves is in view, from begin to end."""
        corners = []
        for time in np.linspace(0.0, actor.rollout.result.times[-1], _INSTANTS):
            actor.pose(time)
            corners.append(actor.drawing.corners(actor.context))
        camera = fitting_camera(np.hstack(corners), margin=_MARGIN)
        self.meshcat.SetCameraPose(camera.position, camera.target)

    def set_time(self, time: float) -> None:
        """Move all rollouts to a time in seconds since their begin."""
        self._time = time
        for actor in self._actors.values():
            actor.pose(self._time)


class StudyScene:
    """A Meshcat with the rollouts that are shown, in a thread of its own.

    Attributes:
        meshcat_url: Its address; it has no protection of its own. If it dies, another one at another address follows.
        notice: What has become of the picture, if its Meshcat has died; empty otherwise.
    """

    def __init__(self) -> None:
        self.meshcat_url = self.notice = ""
        self._commands = Requests(PointError, "the page has ended", _failure)
        self._picture: _Picture | None = None  # while its thread runs, which alone uses it
        ready: Future[None] = Future()
        self._thread = threading.Thread(target=self._run, args=(ready,), name="vtbdrake scene", daemon=True)
        self._thread.start()
        ready.result()

    def close(self) -> None:
        """End the scene and its Meshcat."""
        self._commands.end()
        wait_for_end(self._thread, "the study's picture")

    def show(self, role: str, rollout: PointRollout | None) -> None:
        """Show a rollout in a role, a key of `TINTS`; None removes what is there.

        Args:
            role: ``best``, ``pointed`` or ``tried``.
            rollout: The rollout, with the states of its plant.

        Raises:
            PointError: The rollout has no motion that could be drawn.
        """
        self._do(lambda picture: picture.show(role, rollout))

    def set_time(self, time: float) -> None:
        """Show all rollouts at a time in seconds since their begin."""
        self._do(lambda picture: picture.set_time(time))

    def _do(self, action: Callable[[_Picture], object]) -> None:
        self._commands.ask(self._thread, lambda: action(self._kept_picture()))

    # -- in the thread of the scene

    def _run(self, ready: Future[None]) -> None:
        self._picture = _Picture()
        self.meshcat_url = self._picture.meshcat.web_url()
        ready.set_result(None)
        while self._commands.carry_out(_PERIOD):
            self._kept_picture()
        meshcat = self._picture.meshcat
        self._picture = None
        gc.collect()
        abandon_if_dead(meshcat)
        del meshcat  # It ends in the thread that made it.

    def _kept_picture(self) -> _Picture:
        """Return the picture; draw what is shown into another Meshcat if this one has died."""
        picture = self._picture
        assert picture is not None, "a scene is used by its thread while that runs"
        if is_running(picture.meshcat):
            return picture
        _log.warning(DEATH)
        rollouts = picture.replace_meshcat()
        self.meshcat_url = picture.meshcat.web_url()
        self.notice = f"{DEATH}: another one shows the rollouts"
        try:
            for role, rollout in rollouts.items():
                picture.show(role, rollout)
        except FAILURES as error:  # For example: it has died, too.
            self.notice = f"{DEATH}, and another one cannot show the rollouts: {one_line(error)}"
        return picture


def _failure(error: BaseException) -> PointError:
    """Return the error that another thread raises for an error of the scene's."""
    return error if isinstance(error, PointError) else PointError(one_line(error))
