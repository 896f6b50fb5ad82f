"""The driver's display: map, pose, status, landmarks, advised route and next trees of a running unit, live in Meshcat.

``python -m vtbdrake_diagrams.forest.pictures.display SCENARIO --url URL`` is a process of its own. It watches the live
values of a loop that runs by ``vtbdrake run`` (or `Scenario.deploy` with ``live=True``), and takes the map and the
routes from the scenario.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import click
import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Box, Cylinder, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix

from vtbdrake.cli import BadInputError
from vtbdrake.cli.options import option, scenario_argument, timeout_option, url_option
from vtbdrake.common.arrays import Array
from vtbdrake.common.extras import extra_module
from vtbdrake.common.failures import one_line
from vtbdrake.components.localization.planar import transform
from vtbdrake.components.localization.unit import DOUBTFUL, LOST, SEARCHING, TRACKING
from vtbdrake.components.world_model import WorldModel
from vtbdrake.control.bridge import BridgeError
from vtbdrake.drake_workarounds.kept_meshcats import DEATH, is_running
from vtbdrake.monitoring.live.client import watch
from vtbdrake.testbed import Scenario
from vtbdrake.visualization import make_meshcat, show_world_model
from vtbdrake.visualization.world_model_drawing import text_strokes
from vtbdrake_diagrams.forest.felling import marked_trees, next_places
from vtbdrake_diagrams.forest.scenario import CarrierScenario
from vtbdrake_diagrams.forest.world.routes import Route

POSITION = "dps.env.pose.position"
HEADING = "dps.env.pose.heading"
COVARIANCE = "dps.env.pose.covariance"
STATUS = "dps.env.pose.status"
FOUND_AT = "dps.env.localizer.pose"
LANDMARKS = "dps.env.localizer.landmarks"
ADVICE = "u.route"
WATCHED = (POSITION, HEADING, COVARIANCE, STATUS, FOUND_AT, LANDMARKS, ADVICE)
"""The addresses that the display reads."""

DEVIATIONS = 3.0
"""The size of the ellipse of the position, in standard deviations."""

# The text over the carrier, and its colour (of Okabe and Ito's palette), by status.
_LOOKS = {
    SEARCHING: ("searching", Rgba(0.94, 0.89, 0.26, 1.0)),
    TRACKING: ("tracking", Rgba(0.0, 0.62, 0.45, 1.0)),
    DOUBTFUL: ("doubtful", Rgba(0.9, 0.62, 0.0, 1.0)),
    LOST: ("lost", Rgba(0.84, 0.37, 0.0, 1.0)),
}
# Colour of the landmarks of the last scan.
_TRUNK = Rgba(0.0, 0.45, 0.7, 1.0)
# Colour of the ellipse of the position.
_ELLIPSE = Rgba(0.8, 0.47, 0.65, 0.8)
# Colour of the advised route.
_ROUTE = Rgba(0.34, 0.71, 0.91, 1.0)
# Height of the line of the advised route, in m.
_ROUTE_HEIGHT = 0.1
# Colour of the rings around the next trees to fell.
_FELLED = Rgba(0.84, 0.37, 0.0, 1.0)
# Radius of these rings, in m.
_RING = 0.8
# Largest number of these trees.
_NEXT = 5
# Height of the cylinders of the landmarks, in m.
_TRUNK_HEIGHT = 1.5
# Height of the letters over the carrier, in m.
_LETTERS = 1.0
# Radius of the spheres that mark the landmarks of the map, in m.
_MARKER = 0.25
# Height of the carrier's roof, in m.
_ROOF = 1.0
# Position of the view relative to the carrier, in m.
_VIEW = (0.0, -14.0, 26.0)
# Intensity of the ambient light.
_AMBIENT = 3.0


class DriverDisplay:
    """Draws map, pose, status and advice of a localization unit into Meshcat, under ``display``.

    The carrier is drawn at its pose, with the ellipse of its position (`DEVIATIONS`) on its roof, and the landmarks of
    the last scan as cylinders. The larger semi-axis of the ellipse is written beside the status. Without a pose, only
    the map, the advised route and the status are drawn, the status at the last pose, or in the middle of the map. The
    drawing is moved so that this place stays in the middle of the view, north up. Rings with numbers show the trees
    that are felled next (`vtbdrake_diagrams.forest.felling`).
    """

    def __init__(self, meshcat: Meshcat, world_map: WorldModel, routes: Sequence[Route] = ()) -> None:
        """Draw the map.

        Args:
            meshcat: The Meshcat to draw into.
            world_map: The map of the unit.
            routes: The routes by the number that is advised; without them, no advice is drawn.
        """
        self._meshcat = meshcat
        self._routes = routes
        self._marked = np.array([tree.p_WoOo_W[:2] for tree in marked_trees(world_map)]).reshape(-1, 2)
        self._advised: int | None = None
        self._felled = np.zeros((0, 2))
        self._text = ""
        self._landmarks = self._shown = 0
        show_world_model(meshcat, world_map, prefix="display/map", marker=_MARKER, deviations=0.0, label_height=0.0)
        self._place = world_map.positions().mean(axis=0)
        meshcat.SetCameraPose(_VIEW, np.zeros(3))
        for color in ("top_color", "bottom_color"):
            meshcat.SetProperty("/Background", color, [1.0, 1.0, 1.0])
        meshcat.SetProperty("/Grid", "visible", False)
        meshcat.SetProperty("/Lights/AmbientLight/<object>", "intensity", _AMBIENT)
        meshcat.SetObject("display/carrier/body", Box(2.5, 1.5, _ROOF), _LOOKS[TRACKING][1])
        meshcat.SetObject("display/carrier/ahead", Box(1.5, 0.15, 0.15), _LOOKS[TRACKING][1])
        meshcat.SetTransform("display/carrier/ahead", RigidTransform([2.0, 0.0, 0.0]))
        meshcat.SetObject("display/ellipse", Sphere(1.0), _ELLIPSE)

    def show(self, values: Mapping[str, ArrayLike]) -> None:
        """Show the present values of the unit, by the addresses of `WATCHED`."""
        values_by_address = {address: np.asarray(values[address], dtype=float) for address in WATCHED}
        status = int(values_by_address[STATUS])
        pose = np.append(values_by_address[POSITION], values_by_address[HEADING])
        covariance = values_by_address[COVARIANCE][:2, :2]
        has_pose = bool(np.isfinite(pose).all())
        for path in ("carrier", "ellipse"):
            self._meshcat.SetProperty(f"display/{path}", "visible", has_pose)
        if has_pose:
            self._place = np.append(pose[:2], 0.0)
            X_WH = RigidTransform(RotationMatrix.MakeZRotation(pose[2]), self._place)
            self._meshcat.SetTransform("display/carrier", X_WH @ RigidTransform([0.0, 0.0, _ROOF / 2.0]))
            self._meshcat.SetTransform("display/ellipse", ellipse(pose[:2], covariance))
        if self._routes:
            self._show_advice(int(values_by_address[ADVICE]), pose if has_pose else None)
        self._show_landmarks(values_by_address[FOUND_AT], values_by_address[LANDMARKS].reshape(-1, 3))
        self._show_status(status, covariance)
        self._meshcat.SetTransform("display", RigidTransform(-self._place))

    def _show_advice(self, number: int, pose: Array | None) -> None:
        """Draw the advised route if it has changed, and the next trees along it if they have."""
        route = self._routes[number]
        if number != self._advised:
            points = np.column_stack([route.points, np.full(len(route.points), _ROUTE_HEIGHT)])
            self._meshcat.SetLine("display/route", np.vstack([points, points[:1]]).T, 4.0, _ROUTE)
            self._advised = number
        felled = np.zeros((0, 2)) if pose is None else next_places(self._marked, route, pose[:2], count=_NEXT)
        if not np.array_equal(felled, self._felled):
            self._meshcat.Delete("display/felled")
            for k, place in enumerate(felled):
                self._meshcat.SetLine(f"display/felled/{k}/ring", _ring(place), 4.0, _FELLED)
                strokes = text_strokes(str(k + 1), _LETTERS)
                self._meshcat.SetLineSegments(f"display/felled/{k}/number", *strokes, 2.0, _FELLED)
                beside = RigidTransform([place[0] + _RING, place[1], _TRUNK_HEIGHT])
                self._meshcat.SetTransform(f"display/felled/{k}/number", beside)
            self._felled = felled

    def _show_landmarks(self, X_WH: Array, landmarks: Array) -> None:
        """Draw landmarks, rows of [x, y (m, in H), diameter (m)], where they were seen from the pose X_WH."""
        detections = landmarks[np.isfinite(landmarks).all(axis=1)]
        if not np.isfinite(X_WH).all():
            detections = detections[:0]
        for k, (place, diameter) in enumerate(zip(transform(X_WH, detections[:, :2]), detections[:, 2], strict=True)):
            path = f"display/landmarks/{k}"
            if k >= self._landmarks:
                self._meshcat.SetObject(path, Cylinder(1.0, _TRUNK_HEIGHT), _TRUNK)
                self._landmarks = k + 1
            scaled = np.diag([diameter / 2.0, diameter / 2.0, 1.0, 1.0])
            scaled[:3, 3] = [*place, _TRUNK_HEIGHT / 2.0]
            self._meshcat.SetTransform(path, scaled)
        low, high = sorted((len(detections), self._shown))
        for k in range(low, high):
            self._meshcat.SetProperty(f"display/landmarks/{k}", "visible", len(detections) > self._shown)
        self._shown = len(detections)

    def _show_status(self, status: int, covariance: Array) -> None:
        text = status_text(status, covariance)
        if text != self._text:
            self._meshcat.SetLineSegments("display/status", *text_strokes(text, _LETTERS), 2.0, _LOOKS[status][1])
            self._text = text
        self._meshcat.SetTransform("display/status", RigidTransform(self._place + np.array([0.0, 0.0, 3.0])))


class _Shown:
    """A display in a Meshcat; if that dies, in the next one.

    Attributes:
        url: The address of the Meshcat.
    """

    def __init__(self, world_map: WorldModel, routes: Sequence[Route]) -> None:
        self._map, self._routes = world_map, routes
        self._begin()

    def _begin(self) -> None:
        self._meshcat = make_meshcat()
        self._display = DriverDisplay(self._meshcat, self._map, self._routes)
        self.url = self._meshcat.web_url()

    def show(self, values: Mapping[str, ArrayLike]) -> None:
        """Show the present values of the unit."""
        try:
            self._display.show(values)
        except RuntimeError:
            if is_running(self._meshcat):
                raise
            click.echo(DEATH, err=True)
            self._begin()
            self._display.show(values)


def status_text(status: int, covariance: Array) -> str:
    """Return the status in words, and with a pose the larger semi-axis of the ellipse of the position.

    Args:
        status: The status of the unit.
        covariance: The covariance of the position, (2, 2) in m^2; infinite without a pose.
    """
    words = _LOOKS[status][0]
    if not np.isfinite(covariance).all():
        return words
    return f"{words} ±{DEVIATIONS * np.sqrt(np.linalg.eigvalsh(covariance)[-1]):.2f} m"


def _ring(place: Array) -> Array:
    """Return the points (3, n) of a ring around a tree, closed."""
    angles = np.linspace(0.0, 2.0 * np.pi, 25)
    return np.vstack([place[0] + _RING * np.cos(angles), place[1] + _RING * np.sin(angles), np.full(25, _ROUTE_HEIGHT)])


def ellipse(place: Array, covariance: Array) -> Array:
    """Return the transform (4, 4) of the unit sphere to the ellipse of a position, just above the roof.

    Args:
        place: The middle of the ellipse, (2,) in m.
        covariance: The covariance of the position, (2, 2) in m^2.
    """
    variances, axes = np.linalg.eigh(covariance)
    matrix = np.eye(4)
    matrix[:2, :2] = DEVIATIONS * axes * np.sqrt(np.maximum(variances, 0.0))
    matrix[2, 2] = 0.02
    matrix[:3, 3] = [*place, _ROOF + 0.05]
    return matrix


@click.command()
@scenario_argument
@url_option
@option("--every N", "Read every Nth cycle.", type=click.IntRange(min=1), default=10)
@timeout_option
def main(scenario: Scenario, url: str, every: int, timeout: float) -> None:
    """Show a running localization unit in a browser, until Ctrl-C or its end."""
    if not isinstance(scenario, CarrierScenario):
        raise BadInputError(
            f"{type(scenario).__name__} has no localization unit: give a ForestScenario or PlainScenario"
        )
    extra_module("uvicorn", purpose="the driver's display", extra="web")
    from vtbdrake.web.serving.host import Host

    shown = _Shown(scenario.global_map(), scenario.routes())
    host = Host(lambda: shown.url)

    def print_next() -> None:
        click.echo(f"for another browser: {host.address(used=print_next)}")

    try:
        click.echo(f"the display is at {host.address(used=print_next)}")
        for _, values in watch(url, WATCHED, every=every, timeout=timeout):
            shown.show(values)
    except KeyboardInterrupt:
        return
    except (ValueError, OSError, BridgeError) as error:
        raise BadInputError(one_line(error)) from error
    finally:
        host.close()


def program() -> None:
    """Run `main`, with one line of text for arguments that describe no scenario, too."""
    try:
        main()
    except (ValueError, OSError) as error:
        raise SystemExit(f"Error: {one_line(error)}") from error


if __name__ == "__main__":
    program()
