"""The picture of a session: a Meshcat, the drawing of the testbed in it, its layers, and another one if it dies."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

from vtbdrake.drake_workarounds.kept_meshcats import abandon_if_dead, is_running
from vtbdrake.visualization.drawing import Drawing, Parts
from vtbdrake.visualization.meshcat import make_meshcat
from vtbdrake.visualization.scenes.scene_writer import SceneWriter
from vtbdrake.web.live.layers import Layers
from vtbdrake.web.live.watching import Groups

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat
    from pydrake.systems.framework import Context

    from vtbdrake.testbed import VirtualTestbed
    from vtbdrake.visualization.scenes.output import SceneOutput
    from vtbdrake.visualization.still import Still
    from vtbdrake.visualization.viewpoint import Viewpoint

# Opacity of the ghosts.
_GHOST_OPACITY = 0.45


class LiveScene:
    """Draws a testbed and its layers, in the thread that made it, which must also end it.

    Args:
        testbed: The testbed.
        context: The state that is drawn first.
        world: The state whose world is in the picture.
        camera: Where it is seen from; None fits the testbed.
        only_poses: Whether nothing but the poses of bodies is known.

    Attributes:
        meshcat: The server of the picture.
        bodies: Paths in Meshcat of what moves.
        followed: The one that the camera follows at first, or nothing.
        layers: What can be shown, see `Layers`.
    """

    def __init__(
        self,
        testbed: VirtualTestbed,
        context: Context,
        *,
        world: Context | None = None,
        camera: Viewpoint | None = None,
        only_poses: bool = False,
    ) -> None:
        self._testbed, self._only_poses = testbed, only_poses
        self._shown = Groups()
        self._mirrors: list[SceneWriter] = []
        self._drawing: Drawing | None = None
        self.bodies: tuple[str, ...] = ()
        self.followed = ""
        self.meshcat: Meshcat = make_meshcat()
        self.layers = self._draw_anew(context, context if world is None else world, camera)

    def _draw_anew(self, context: Context, world: Context, camera: Viewpoint | None) -> Layers:
        """Draw into the Meshcat, which is a new one, and return its layers."""
        self._drawing, size = None, 0.0
        if self._testbed.scene_graph is not None:
            self._drawing = Drawing(self.meshcat, self._testbed, context, "now")
            self._drawing.fit_camera(world, camera)
            self.bodies = self._drawing.places
            self.followed = "" if camera is not None else self._drawing.floating
            size = self._drawing.diagonal(context)
        return Layers(self.meshcat, self._testbed, size, only_poses=self._only_poses)

    @property
    def url(self) -> str:
        """Return the address of the Meshcat."""
        return self.meshcat.web_url()

    def is_alive(self) -> bool:
        """Return whether the Meshcat runs."""
        return is_running(self.meshcat)

    def renew(self, context: Context, *, world: Context | None = None) -> None:
        """Draw into a new Meshcat, instead of one that has died.

        Args:
            context: The root context of the DPS, whose state is drawn first.
            world: The root context of the world, if that is another one.
        """
        meshcat = make_meshcat()
        abandon_if_dead(self.meshcat)
        self.meshcat = meshcat
        self.layers = self._draw_anew(context, context if world is None else world, None)
        self.layers.show(self._shown.names())

    def show(self, viewer: object, layers: Collection[str]) -> None:
        """Show layers to one of several viewers; an empty list ends it.

        Args:
            viewer: Who looks; what it has asked for before is replaced.
            layers: Names of layers.

        Raises:
            LayerError: The testbed has no such layer.
        """
        self.layers.check(layers)
        self._shown.set(viewer, layers)
        self.layers.show(self._shown.names())

    def mirror(self, output: SceneOutput) -> None:
        """Write what is drawn from now on to an output, too; of a loop that runs elsewhere, the poses alone.

        Args:
            output: A server of Foxglove or Rerun, say.
        """
        is_simulated = not self._only_poses
        self._mirrors.append(SceneWriter(self._testbed, output, images=is_simulated, signals=is_simulated))

    def draw(self, context: Context, world: Context) -> None:
        """Draw the world of a state and the layers of another one.

        Args:
            context: The root context whose layers are drawn.
            world: The root context whose bodies are drawn; the same one, unless a log is played.
        """
        if self._drawing is not None:
            self._drawing.pose(world)
            self.layers.draw(context, world)
        for mirror in self._mirrors:
            mirror.write(context, world=world)

    def pose(self, context: Context) -> None:
        """Draw the world of a state, without layers."""
        if self._drawing is not None:
            self._drawing.pose(context)
        for mirror in self._mirrors:
            mirror.write(context)

    def still(self, context: Context) -> Still | None:
        """Return a picture of a state; None if the testbed has no geometry."""
        return None if self._drawing is None else self._drawing.still(context)

    def ghost(self, context: Context, name: str, tint: str) -> Drawing | None:
        """Return a drawing of what moves in another state; None if the testbed has no geometry.

        Args:
            context: The root context of the other state.
            name: The name of the ghost, which is part of its path in Meshcat.
            tint: Colour of the ghost, any matplotlib colour.
        """
        if self._drawing is None:
            return None
        path, parts = f"ghosts/{name}", Parts.MOVING
        return Drawing(self.meshcat, self._testbed, context, path, tint=tint, opacity=_GHOST_OPACITY, parts=parts)
