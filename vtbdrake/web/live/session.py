"""A testbed in a thread of its own, watched from others: what every session has."""

from __future__ import annotations

import gc
import logging
import threading
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from vtbdrake.common.closing import Closing
from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.drake_workarounds.kept_meshcats import DEATH, abandon_if_dead
from vtbdrake.drake_workarounds.renderer_threads import release_renderers
from vtbdrake.web.serving.requests import Requests, wait_for_end

if TYPE_CHECKING:
    from vtbdrake.testbed import Scenario
    from vtbdrake.visualization.scenes.output import SceneOutput
    from vtbdrake.visualization.still import Still
    from vtbdrake.web.live.scene import LiveScene

_Result = TypeVar("_Result")

_log = logging.getLogger(__name__)


class SessionError(ValueError):
    """A command to a session cannot be carried out."""


@dataclass(frozen=True)
class Frame:
    """What a session shows at an instant.

    Attributes:
        number: Counts the frames.
        time: Simulated time, in seconds.
        playing: Whether time runs.
        speed: Simulated seconds per second that are asked for.
        rate: Those that are reached.
        positions: Positions of the switches, by side and signal.
        values: Values of the watched variables and ports, by address.
        history: First and last time of the states that are kept.
        warnings: What a machine's limits would refuse.
        failure: Why the simulation has ended; empty while it can go on.
        preview: What the preview has found: ``time``, ``end``, ``refused``; None if there is none.
        comparison: What the course without the last intervention, or the other branch, shows: ``differences`` (address
            and time), ``failure``, ``branch``, ``recorded``; None if there is none.
        drive: What is driven by hand, see `Driver.status`; None while nothing is.
        log: For a `LogSession`: whether the log is replayed (``recorded``), when the simulation has ``left`` it, a
            ``notice``, the time to which it is ``seeking`` and the ``progress`` on the way, from 0 to 1 (None while it
            is not), and the part of the log that is ``prepared``, so that every way in it is short.
        layers: What there is to say about each layer that is shown.
        picture: What has become of the picture, if its server has died; empty otherwise.
        loop: For a loop that runs in another process: ``ages`` of its sensor signals' last messages (s), ``reasons``
            why nothing reaches the machine, ``faults`` with the seconds since then; None for a simulation.
    """

    number: int
    time: float
    playing: bool
    speed: float
    rate: float
    positions: Mapping[str, Mapping[str, str]]
    values: Mapping[str, Any]
    history: tuple[float, float]
    warnings: tuple[str, ...]
    failure: str
    preview: Mapping[str, Any] | None
    comparison: Mapping[str, Any] | None
    drive: Mapping[str, Any] | None = None
    layers: Mapping[str, str] = field(default_factory=dict)
    picture: str = ""
    loop: Mapping[str, Any] | None = None
    log: Mapping[str, Any] | None = None


class Stage(ABC):
    """What the thread of a session alone uses: the testbed, its states and its picture.

    Attributes:
        scene: The picture.
        variables: See `Session.variables`.
    """

    scene: LiveScene
    variables: Mapping[str, Mapping[str, Any]]

    @property
    @abstractmethod
    def time(self) -> float:
        """Return the time of what is shown, in seconds."""

    @abstractmethod
    def idle_time(self) -> float:
        """Return the wall time, in seconds, until there is something to do."""

    @abstractmethod
    def work(self) -> Frame | None:
        """Do what is due, and return what is shown then; None if it is the same as before."""

    @abstractmethod
    def frame(self) -> Frame:
        """Draw, and return what is shown."""

    @abstractmethod
    def watch(self, watcher: object, addresses: Collection[str]) -> None:
        """Read variables and ports in each frame, see `Session.watch`.

        Args:
            watcher: Who watches; what it has watched before is replaced.
            addresses: Addresses of variables and ports; empty ends it.
        """

    def show(self, viewer: object, layers: Collection[str]) -> None:
        """Show layers, see `Session.show`.

        Args:
            viewer: Who looks; what it has asked for before is replaced.
            layers: Names of layers; empty ends it.
        """
        self.scene.show(viewer, layers)

    def lose_picture(self, reason: str) -> None:  # noqa: B027
        """Note that nobody sees what happens, before another picture is made."""

    @abstractmethod
    def redraw(self) -> None:
        """Draw what is shown into a new picture."""

    def mirror(self, output: SceneOutput) -> None:
        """Draw into an output, too, see `Session.mirror`.

        Args:
            output: The output.
        """
        self.scene.mirror(output)

    def close(self) -> None:  # noqa: B027
        """End what the stage has begun, but for its picture."""


_Stage = TypeVar("_Stage", bound=Stage)


class Session(Closing, ABC, Generic[_Stage]):
    """A testbed in a thread of its own, which can be watched from others.

    Everything that touches the testbed or its Meshcat happens in that thread. Other threads send commands; each method
    waits for its command, and raises what it raises. What a session can do beside being watched, its class tells:
    a `SimulationSession` simulates, a `LogSession` replays a log, a `LoopSession` shows a loop that runs elsewhere.

    Args:
        scenario: The scenario of the testbed.

    Attributes:
        latest: The last frame.
        variables: What can be watched and set: by address, ``kind``, ``shape``, ``unit``, ``bounds``, ``settable``.
        bodies: Paths in Meshcat of what moves.
        followed: The one that the camera follows at first, or nothing.
        layers: The layers that can be shown: name -> title.
        cameras: The cameras whose images can be shown.
        meshcat_url: Address of the Meshcat that shows the testbed; it has no protection of its own. If it dies, another
            one at another address follows; empty until then.

    Raises:
        ValueError: The testbed cannot be built.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.latest: Frame | None = None
        self.variables: Mapping[str, Mapping[str, Any]] = {}
        self.bodies: tuple[str, ...] = ()
        self.followed = ""
        self.layers: Mapping[str, str] = {}
        self.cameras: tuple[str, ...] = ()
        self.meshcat_url = ""
        self._commands = Requests(SessionError, "the session has ended", _failure)
        self._frame_ready = threading.Condition()
        self._closed = False
        # What has become of the picture, if its server has died.
        self._picture = ""
        # Where else it is shown.
        self._outputs: list[SceneOutput] = []
        # The stage belongs to the thread.
        self._stage_of_thread: _Stage | None = None
        ready: Future[None] = Future()
        self._thread = threading.Thread(target=self._run, args=(ready,), name="vtbdrake session", daemon=True)
        self._thread.start()
        ready.result()

    def close(self) -> None:
        """End the session and its Meshcat; a simulation that hangs is left behind after 10 s."""
        self._commands.end()
        wait_for_end(self._thread, "the session's simulation")

    # -- commands

    @abstractmethod
    def write(self, values: Mapping[str, Any]) -> None:
        """Set variables by address, all of them or none."""

    @abstractmethod
    def reset(self) -> None:
        """Begin again."""

    def watch(self, watcher: object, addresses: Collection[str]) -> None:
        """Read variables and ports in each frame, for one of several watchers; an empty list ends it.

        Args:
            watcher: Who watches: any object that can be a key; what it has watched before is replaced.
            addresses: Addresses of variables and ports.

        Raises:
            AddressError: There is no such variable or port.
        """
        self._do(lambda: self._stage.watch(watcher, tuple(addresses)))

    def show(self, viewer: object, layers: Collection[str]) -> None:
        """Show layers to one of several viewers; an empty list ends it. A layer that nobody looks at costs nothing.

        Args:
            viewer: Who looks: any object that can be a key; what it has asked for before is replaced.
            layers: Names of layers.

        Raises:
            LayerError: The testbed has no such layer.
        """
        self._do(lambda: self._stage.show(viewer, tuple(layers)))

    def mirror(self, output: SceneOutput) -> None:
        """Show in another viewer what is shown from now on: a `FoxgloveServer` or a `RerunServer`, for example.

        Args:
            output: The output, which the session closes at its end.
        """
        self._outputs.append(output)
        self._do(lambda: self._mirror(output))

    @abstractmethod
    def still(self) -> Still | None:
        """Return a picture of how the testbed looks now; None if there is none."""

    def wait_for_frame(self, after: int, timeout: float) -> Frame | None:
        """Return the first frame with a number above ``after``, or None if it does not come in time.

        Args:
            after: The number of the last frame that the caller has seen; 0 for the first one.
            timeout: The longest wall time to wait, in seconds.
        """
        with self._frame_ready:
            self._frame_ready.wait_for(lambda: self._closed or (self.latest and self.latest.number > after), timeout)
            return self.latest if self.latest is not None and self.latest.number > after else None

    def _do(self, action: Callable[[], _Result]) -> _Result:
        def carry_out() -> _Result:
            self._keep_scene()
            return action()

        return self._commands.ask(self._thread, carry_out)

    # -- in the thread of the session

    @abstractmethod
    def _make_stage(self) -> _Stage:
        """Return the stage that the thread of the session works with."""

    @property
    def _stage(self) -> _Stage:
        assert self._stage_of_thread is not None
        return self._stage_of_thread

    def _run(self, ready: Future[None]) -> None:
        try:
            self._begin()
        except FAILURES as error:  # It is raised where the session is made.
            self._closed = True
            failure = _failure(error)
            self._drop()
            ready.set_exception(failure)
            return
        ready.set_result(None)
        try:
            while self._commands.carry_out(max(self._stage.idle_time(), 0.0)):
                self._keep_scene()
                self._publish(self._stage.work())
        finally:
            with self._frame_ready:
                self._closed = True
                self._frame_ready.notify_all()
            self._drop()

    def _begin(self) -> None:
        self._stage_of_thread = stage = self._make_stage()
        self.variables = stage.variables
        self._tell_scene()
        self._publish(stage.frame())

    def _mirror(self, output: SceneOutput) -> None:
        self._stage.mirror(output)
        self._publish(self._stage.frame())

    def _tell_scene(self) -> None:
        scene = self._stage.scene
        self.meshcat_url = scene.url
        self.bodies, self.followed = scene.bodies, scene.followed
        self.layers, self.cameras = scene.layers.titles, scene.layers.cameras

    def _publish(self, frame: Frame | None) -> None:
        if frame is None:
            return
        number = 1 if self.latest is None else self.latest.number + 1
        with self._frame_ready:
            self.latest = replace(frame, number=number, picture=self._picture)
            self._frame_ready.notify_all()

    def _keep_scene(self) -> None:
        """Make another picture if its Meshcat has died. Nobody leads what was not seen."""
        stage = self._stage
        if stage.scene.is_alive():
            return
        if self.meshcat_url:
            _log.warning(DEATH)
            self.meshcat_url = ""  # It tells other threads, such as a hand's.
            stage.lose_picture(DEATH)
        when = f"{DEATH} (at t = {stage.time:.2f} s)"
        try:
            stage.redraw()
            self._picture = f"{when}: another one shows the present"
        except FAILURES as error:
            self._picture = f"{when}, and another one cannot show the present: {one_line(error)}"
        if stage.scene.is_alive():
            self._tell_scene()

    def _drop(self) -> None:
        """Give up the Meshcat, which must end in the thread that made it, and all that refers to it."""
        stage = self._stage_of_thread
        self._stage_of_thread = None
        for output in self._outputs:
            output.close()
        if stage is None:
            return
        stage.close()
        meshcat = stage.scene.meshcat
        del stage
        gc.collect()
        abandon_if_dead(meshcat)
        release_renderers()


def _failure(error: BaseException) -> Exception:
    """Return the error that another thread raises for an error of this one, without objects of this thread."""
    traceback.clear_frames(error.__traceback__)
    return error if isinstance(error, Exception) else SessionError(one_line(error))
