"""Layers of the live page: what a testbed measures, perceives and decides, drawn into the scene of its Meshcat."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from matplotlib.colors import to_rgb
from pydrake.common.value import Value
from pydrake.geometry import Meshcat, Rgba, Sphere
from pydrake.multibody.meshcat import ContactVisualizer, ContactVisualizerParams
from pydrake.multibody.tree import BodyIndex
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, OutputPort, PortDataType, System

from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.components.sensors.laser_scanner import LaserScanner
from vtbdrake.components.world_model.world_model import WorldModel
from vtbdrake.state.systems import leaves
from vtbdrake.testbed import slow_parts
from vtbdrake.visualization.cameras import camera_view, cameras
from vtbdrake.visualization.drawing import Drawing, Parts

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import RigidBody
    from pydrake.systems.sensors import CameraInfo

    from vtbdrake.components.perception.estimate import PoseEstimate
    from vtbdrake.optimization import Motion
    from vtbdrake.reasoning import OnboardReasoner
    from vtbdrake.reasoning.decision import Decision
    from vtbdrake.reasoning.reasoner import Reasoner
    from vtbdrake.testbed import VirtualTestbed

# Colours.
_FORCE = Rgba(0.84, 0.37, 0.0, 1.0)
_MOMENT = Rgba(0.34, 0.71, 0.91, 1.0)
_FRUSTUM = Rgba(0.9, 0.62, 0.0, 1.0)
_POINTS = Rgba(0.84, 0.0, 0.0, 1.0)
_ELLIPSOID = Rgba(0.8, 0.47, 0.65, 0.6)
PERCEIVED_TINT = "#cc79a7"
# Opacity of what is perceived.
_PERCEIVED_OPACITY = 0.45
# Name of the folder of ghosts in the scene.
_GHOST = "ghost"

# Lengths over the diagonal of the robot's box.
# The arrow that stands for the robot's weight.
_WEIGHT_ARROW = 0.5
# The depth of a camera's frustum.
_FRUSTUM_DEPTH = 0.25
# The radius of an arrow.
_ARROW_RADIUS = 0.006
# The size of a point.
_POINT_SIZE = 0.012
# Least radius of an arrow and least size of a point, in m.
_LEAST_POINT = 0.004
# Forces are scaled as if gravity was this at least, in m/s^2.
_LEAST_GRAVITY = 0.5

# Size of an ellipsoid, in standard deviations.
_DEVIATIONS = 2.0
# Least semi-axis of an ellipsoid over the diagonal of the robot's box.
_FLAT = 0.002

# Number of decisions that are remembered.
_REMEMBERED = 16
# Number of candidates of a decision that are shown.
_CANDIDATES = 8
# Number of poses along the path of a candidate.
_POSES = 40

# Radius of the markers of a world model over the diagonal of the robot's box.
_MARKER = 0.03


class LayerError(ValueError):
    """There is no such layer or camera."""


@runtime_checkable
class Locating(Protocol):
    """A system that estimates where a body is."""

    def pose_estimate(self, context: Context) -> PoseEstimate:
        """Return the pose in the world with its covariance."""


class Layer(ABC):
    """Something that is drawn below a path of its own, ``layers/<name>``.

    Args:
        meshcat: The server that shows it.
        testbed: The testbed, which has a source for it.
        size: The diagonal of the robot's box in m.

    Attributes:
        note: What there is to say about it; why nothing is to be seen, for example.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    # Whether it is about the world, not about the DPS; and whether it is measured in a simulation of the world.
    is_of_world: ClassVar[bool] = False
    is_measured: ClassVar[bool] = False

    def __init__(self, meshcat: Meshcat, testbed: VirtualTestbed, size: float) -> None:
        self._meshcat, self._testbed, self._size = meshcat, testbed, size
        self._drawn: dict[str, Any] = {}  # by the name of its source
        self.path = f"layers/{self.name}"
        self.note = ""

    @classmethod
    @abstractmethod
    def has_source(cls, testbed: VirtualTestbed) -> bool:
        """Return whether a testbed has something to show."""

    @abstractmethod
    def draw(self, context: Context) -> None:
        """Show the state of a root context."""

    def clear(self) -> None:
        """Remove what has been drawn; `draw` begins anew."""
        self._drawn.clear()
        self._meshcat.Delete(self.path)

    def close(self) -> None:
        """Remove the layer."""
        self.clear()


class ContactForces(Layer):
    """The contact forces of the plant as arrows, by Drake's `ContactVisualizer`."""

    name, title = "forces", "contact forces"
    is_of_world = is_measured = True

    def __init__(self, meshcat: Meshcat, testbed: VirtualTestbed, size: float) -> None:
        super().__init__(meshcat, testbed, size)
        plant = testbed.plant
        assert plant is not None
        mass = sum(body.default_mass() for body in moving_bodies(plant))
        gravity = max(float(np.linalg.norm(plant.gravity_field().gravity_vector())), _LEAST_GRAVITY)
        weight = mass * gravity if np.isfinite(mass) and mass > 0.0 else gravity
        params = ContactVisualizerParams()
        params.prefix = self.path
        params.color = params.hydro_force_color = _FORCE
        params.hydro_moment_color = _MOMENT
        params.newtons_per_meter = weight / (_WEIGHT_ARROW * size)
        params.newton_meters_per_meter = params.newtons_per_meter * size
        params.force_threshold = 1e-3 * weight
        params.moment_threshold = 1e-3 * weight * size
        params.radius = _ARROW_RADIUS * size
        self._visualizer = ContactVisualizer(meshcat, params)
        self._port, self._plant = plant.get_contact_results_output_port(), plant
        self.note = f"{weight:.3g} N reach {_WEIGHT_ARROW * size:.2g} m to both sides of a contact"

    @classmethod
    def has_source(cls, testbed: VirtualTestbed) -> bool:
        return testbed.plant is not None and testbed.plant.num_collision_geometries() > 1

    def draw(self, context: Context) -> None:
        results = self._port.Eval(self._plant.GetMyContextFromRoot(context))
        mine = self._visualizer.CreateDefaultContext()
        self._visualizer.GetInputPort("contact_results").FixValue(mine, Value(results))
        self._visualizer.ForcedPublish(mine)

    def clear(self) -> None:
        self._visualizer.Delete()
        super().clear()


class Frusta(Layer):
    """What the cameras can see: the pyramid of each one's image."""

    name, title = "cameras", "camera frusta"
    is_of_world = True

    def __init__(self, meshcat: Meshcat, testbed: VirtualTestbed, size: float) -> None:
        super().__init__(meshcat, testbed, size)
        self._cameras = cameras(testbed)

    @classmethod
    def has_source(cls, testbed: VirtualTestbed) -> bool:
        return bool(cameras(testbed))

    def draw(self, context: Context) -> None:
        for name, camera in self._cameras.items():
            X_WC, info = camera_view(camera, camera.GetMyContextFromRoot(context))
            path = f"{self.path}/{name}"
            optics = (info.width(), info.height(), info.focal_x(), info.focal_y(), info.center_x(), info.center_y())
            if self._drawn.get(name) != optics:
                self._drawn[name] = optics
                self._meshcat.SetLineSegments(path, *frustum(info, _FRUSTUM_DEPTH * self._size), 2.0, _FRUSTUM)
            self._meshcat.SetTransform(path, X_WC)


class LaserPoints(Layer):
    """The points of the last scan of each laser scanner."""

    name, title = "laser", "laser points"
    is_of_world = is_measured = True

    def __init__(self, meshcat: Meshcat, testbed: VirtualTestbed, size: float) -> None:
        super().__init__(meshcat, testbed, size)
        self._scanners = dict(_systems(testbed, LaserScanner))

    @classmethod
    def has_source(cls, testbed: VirtualTestbed) -> bool:
        return any(_systems(testbed, LaserScanner))

    def draw(self, context: Context) -> None:
        for name, scanner in self._scanners.items():
            scanner_context = scanner.GetMyContextFromRoot(context)
            scan = scanner.GetOutputPort("scan").Eval(scanner_context)
            if self._drawn.get(name) is scan:
                continue
            self._drawn[name] = scan
            points = scanner.points_W(scanner_context)
            cloud = PointCloud(len(points))
            cloud.mutable_xyzs()[:] = points.T
            point_size = max(_POINT_SIZE * self._size, _LEAST_POINT)
            self._meshcat.SetObject(f"{self.path}/{name}", cloud, point_size, _POINTS)
        self.note = ", ".join(f"{len(scan.ranges)} points" for scan in self._drawn.values())


class Perceived(Layer):
    """The perceived environment: the world as the DPS believes it to be, as a ghost, with covariance ellipsoids.

    An ellipsoid lies where the ghost's nearest body is along a coordinate that is not known.
    """

    name, title = "perceived", "perceived beside simulated"

    def __init__(self, meshcat: Meshcat, testbed: VirtualTestbed, size: float) -> None:
        super().__init__(meshcat, testbed, size)
        self._context = testbed.default_context()
        self._locating = dict(_systems(testbed, Locating))

    @classmethod
    def has_source(cls, testbed: VirtualTestbed) -> bool:
        return testbed.plant is not None and (testbed.believes or any(_systems(testbed, Locating)))

    def draw(self, context: Context) -> None:
        if self._testbed.believes:
            self._draw_ghost(context)
        self.note = ", ".join(self._draw_ellipsoid(name, system, context) for name, system in self._locating.items())

    def _draw_ghost(self, context: Context) -> None:
        plant, mine = self._testbed.plant, self._context
        assert plant is not None
        # What the DPS has no belief about is as it is.
        state = plant.GetPositionsAndVelocities(plant.GetMyContextFromRoot(context))
        plant.SetPositionsAndVelocities(plant.GetMyMutableContextFromRoot(mine), state)
        self._testbed.write(mine, self._testbed.belief(context))
        if _GHOST not in self._drawn:
            looks: dict[str, Any] = {"tint": PERCEIVED_TINT, "opacity": _PERCEIVED_OPACITY, "parts": Parts.MOVING}
            self._drawn[_GHOST] = Drawing(self._meshcat, self._testbed, mine, f"{self.path}/{_GHOST}", **looks)
        else:
            self._drawn[_GHOST].pose(mine)

    def _draw_ellipsoid(self, name: str, system: Any, context: Context) -> str:
        from vtbdrake.visualization.world_model_drawing import covariance_ellipsoid

        path = f"{self.path}/covariance/{name}"
        estimate = system.pose_estimate(system.GetMyContextFromRoot(context))
        if not estimate.valid:
            self._meshcat.Delete(path)
            return f"{name} has no estimate"
        X_WE, semi_axes = covariance_ellipsoid(estimate)
        unknown = ~np.isfinite(np.diag(estimate.covariance)[3:])
        place = X_WE.translation().copy()
        if _GHOST in self._drawn and unknown.any():
            bodies = self._drawn[_GHOST].positions(self._context)
            nearest = np.argmin(np.linalg.norm((bodies - place)[:, ~unknown], axis=1))
            place[unknown] = bodies[nearest][unknown]
        if not self._meshcat.HasPath(path):
            self._meshcat.SetObject(path, Sphere(1.0), _ELLIPSOID)
        # The sphere is stretched by its transform: so nothing but a transform is sent in each frame.
        matrix = np.eye(4)
        matrix[:3, :3] = X_WE.rotation().matrix() * np.maximum(_DEVIATIONS * semi_axes, _FLAT * self._size)
        matrix[:3, 3] = place
        self._meshcat.SetTransform(path, np.asfortranarray(matrix))
        return f"{name}: standard deviation {1e3 * float(semi_axes.max()):.3g} mm"


class Candidates(Layer):
    """The candidates of the last decision of each reasoner on board: the paths of their bodies' centres of mass."""

    name, title = "decisions", "candidates of decisions"

    def __init__(self, meshcat: Meshcat, testbed: VirtualTestbed, size: float) -> None:
        super().__init__(meshcat, testbed, size)
        self._reasoners = _reasoners(testbed)
        for reasoner in self._reasoners.values():
            reasoner.remember(_REMEMBERED)

    @classmethod
    def has_source(cls, testbed: VirtualTestbed) -> bool:
        return testbed.plant is not None and bool(_reasoners(testbed))

    def draw(self, context: Context) -> None:
        notes = []
        for name, part in self._reasoners.items():
            drawn = self._drawn.get(name)
            shown = part.decision_shown(part.GetMyContextFromRoot(context), drawn)
            if shown is not drawn:
                self._drawn[name] = shown
                self._meshcat.Delete(f"{self.path}/{name}")
                if shown is not None:
                    self._draw_decision(f"{self.path}/{name}", *shown)
            if shown is None:
                notes.append(f"{name} has made no decision since this layer is shown")
                continue
            decision = shown[1]
            notes.append(
                f"{name}, {decision.name} = {decision.quality:.4g}: chosen orange, plan in use black, others from "
                "violet to yellow"
            )
        self.note = "; ".join(notes)

    def _draw_decision(self, path: str, reasoner: Reasoner, decision: Decision) -> None:
        from vtbdrake.visualization.decisions import decision_colors

        colors = decision_colors(decision)
        ranked = [candidate for candidate in decision.ranked if candidate.rollouts][:_CANDIDATES]
        for candidate in {each.number: each for each in (*ranked, decision.candidates[0])}.values():
            color = Rgba(*to_rgb(colors[candidate.number]), 1.0)
            paths = body_paths(reasoner.problem.testbed, reasoner.motion(decision, candidate.number))
            for body, vertices in paths.items():
                self._meshcat.SetLine(f"{path}/{candidate.number}/{body}", vertices, 2.0, color)

    def close(self) -> None:
        super().close()
        for reasoner in self._reasoners.values():
            reasoner.remember(0)


class WorldObjects(Layer):
    """The objects of the world models of the DPS, with their covariances."""

    name, title = "landmarks", "world model"

    def __init__(self, meshcat: Meshcat, testbed: VirtualTestbed, size: float) -> None:
        super().__init__(meshcat, testbed, size)
        self._ports = world_models(testbed)

    @classmethod
    def has_source(cls, testbed: VirtualTestbed) -> bool:
        return bool(world_models(testbed))

    def draw(self, context: Context) -> None:
        from vtbdrake.visualization.world_model_drawing import show_world_model

        for name, port in self._ports.items():
            model = port.Eval(port.get_system().GetMyContextFromRoot(context))
            if model is not self._drawn.get(name):
                self._drawn[name] = model
                marker = _MARKER * self._size
                show_world_model(self._meshcat, model, prefix=f"{self.path}/{name}", marker=marker, label_height=0.0)
        self.note = ", ".join(f"{name}: {len(model)} objects" for name, model in self._drawn.items())

    def names(self, near: NDArray[np.float64], count: int) -> list[tuple[str, list[float]]]:
        """Return identity and position of the objects next to a point (3,) in m.

        Args:
            near: The point, in the world frame, shape (3,), in m.
            count: The largest number of objects of each world model.
        """
        objects = [each for model in self._drawn.values() for each in model.nearest(near, count)]
        return [(each.identity, each.p_WoOo_W.tolist()) for each in objects]


_KINDS: tuple[type[Layer], ...] = (ContactForces, Frusta, LaserPoints, Perceived, Candidates, WorldObjects)


class Layers:
    """The layers of a testbed: those that are shown are drawn, the others cost nothing.

    Args:
        meshcat: The server that shows them; only the thread that made it may use them.
        testbed: The testbed.
        size: The diagonal of the robot's box in m.
        only_poses: Whether nothing but the poses of bodies is known, as of a loop that runs elsewhere.

    Attributes:
        titles: The layers for which the testbed has a source: name -> title.
        cameras: The names of its cameras with a colour image.
    """

    def __init__(self, meshcat: Meshcat, testbed: VirtualTestbed, size: float, *, only_poses: bool = False) -> None:
        self._meshcat, self._testbed, self._size = meshcat, testbed, size or 1.0
        kinds = [kind for kind in _KINDS if not only_poses or (kind.is_of_world and not kind.is_measured)]
        if testbed.scene_graph is None:
            kinds.clear()
        self._kinds = {kind.name: kind for kind in kinds if kind.has_source(testbed)}
        self.titles = {name: kind.title for name, kind in self._kinds.items()}
        self._cameras = {} if only_poses else cameras(testbed)
        self.cameras = tuple(self._cameras)
        self._shown: dict[str, Layer] = {}
        self._failures: dict[str, str] = {}

    @property
    def notes(self) -> Mapping[str, str]:
        """Return the note of each layer that is shown."""
        return {name: self._failures.get(name) or layer.note for name, layer in self._shown.items()}

    def check(self, names: Collection[str]) -> None:
        """Raise an error if there is no such layer; in any thread.

        Raises:
            LayerError: There is none.
        """
        for name in names:
            if name not in self._kinds:
                raise LayerError(f"this testbed has no layer {name!r}; it has: {', '.join(self._kinds) or 'none'}")

    def show(self, names: Collection[str]) -> None:
        """Show these layers, and no others."""
        self.check(names)
        for name in self._shown.keys() - set(names):
            self._shown.pop(name).close()
            self._failures.pop(name, None)
        for name in names:
            if name not in self._shown:
                self._shown[name] = self._kinds[name](self._meshcat, self._testbed, self._size)

    def draw(self, context: Context, world: Context | None = None) -> None:
        """Show a state; a layer that cannot be drawn is removed until it can, with the reason.

        Args:
            context: The root context of the DPS.
            world: The root context of the world, if that is another one: in a log, the world is what the DPS believed.
        """
        for name, layer in self._shown.items():
            try:
                _refuse_unmeasured(layer.is_measured, context, world)
                layer.draw(world if world is not None and layer.is_of_world else context)
                self._failures.pop(name, None)
            except FAILURES as error:
                self._failures[name] = one_line(error)
                layer.clear()

    def image(self, camera: str, context: Context, world: Context | None = None) -> NDArray[np.uint8]:
        """Return the present colour image of a camera, (height, width, 3); see `draw`.

        Args:
            camera: One of ``cameras``.
            context: The root context of the DPS, whose camera is read.
            world: The root context of the world; where it is another one, as in a log, there is no image, and a
                LayerError.
        """
        _refuse_unmeasured(True, context, world)
        if camera not in self._cameras:
            raise LayerError(f"there is no camera {camera!r}; there are: {', '.join(self._cameras) or 'none'}")
        system = self._cameras[camera]
        image = system.GetOutputPort("color_image").Eval(system.GetMyContextFromRoot(context))
        return np.array(image.data[..., :3])

    def landmarks(self, near: NDArray[np.float64], count: int) -> list[tuple[str, list[float]]]:
        """Return identity and position of the objects of the world models that are shown, the nearest to a point.

        Args:
            near: The point, in the world frame, shape (3,), in m.
            count: The largest number of objects of each world model.
        """
        layer = self._shown.get(WorldObjects.name)
        return layer.names(near, count) if isinstance(layer, WorldObjects) else []


def _refuse_unmeasured(is_measured: bool, context: Context, world: Context | None) -> None:
    if is_measured and world is not None and world is not context:
        raise LayerError("it was not simulated: the world of this log is what the DPS believed of it")


def frustum(info: CameraInfo, depth: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return begin and end, (3, n) each, of the edges of what is seen up to a depth in m, in the camera frame.

    Args:
        info: The optics of the camera.
        depth: The distance of the far edges along the optical axis, in m.
    """
    width, height = info.width(), info.height()
    pixels = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height], [0.5 * width, -0.2 * height]]).T
    middle = np.array([[info.center_x()], [info.center_y()]])
    focal = np.array([[info.focal_x()], [info.focal_y()]])
    corners = depth * np.vstack([(pixels - middle) / focal, np.ones(5)])
    # Four rays, the image's border, and a roof over its upper edge.
    begin = np.hstack([np.zeros((3, 4)), corners[:, :4], corners[:, [0, 1]]])
    end = np.hstack([corners[:, :4], corners[:, [1, 2, 3, 0]], corners[:, [4, 4]]])
    return begin, end


def moving_bodies(plant: MultibodyPlant) -> list[RigidBody]:
    """Return the bodies that are not fixed to the world."""
    bodies = [plant.get_body(BodyIndex(index)) for index in range(plant.num_bodies())]
    return [body for body in bodies if not plant.IsAnchored(body)]


def body_paths(testbed: VirtualTestbed, motion: Motion) -> dict[str, NDArray[np.float64]]:
    """Return the paths of the centres of mass of the moving bodies in a motion of this testbed, (3, n) each.

    Args:
        testbed: The testbed, which has a plant.
        motion: The motion, whose states are the plant's positions and velocities.
    """
    plant, context = testbed.plant, testbed.default_context()
    assert plant is not None
    plant_context = plant.GetMyMutableContextFromRoot(context)
    bodies = moving_bodies(plant)
    samples = np.linspace(0, len(motion.times) - 1, min(_POSES, len(motion.times))).round().astype(int)
    places = np.empty((len(bodies), 3, len(samples)))
    for column, sample in enumerate(samples):
        plant.SetPositionsAndVelocities(plant_context, motion.states[sample])
        for row, body in enumerate(bodies):
            X_WB = plant.EvalBodyPoseInWorld(plant_context, body)
            places[row, :, column] = X_WB @ body.CalcCenterOfMassInBodyFrame(plant_context)
    return {body.scoped_name().get_full().replace("::", "/"): places[row] for row, body in enumerate(bodies)}


def world_models(testbed: VirtualTestbed) -> dict[str, OutputPort]:
    """Return the output ports of systems of the DPS that show a `WorldModel`, by the paths of the systems."""
    ports: dict[str, OutputPort] = {}
    for path, system in _dps_leaves(testbed):
        for index in range(system.num_output_ports()):
            port = system.get_output_port(index)
            if port.get_data_type() == PortDataType.kAbstractValued and isinstance(
                port.Allocate().get_value(), WorldModel
            ):
                ports.setdefault(path, port)
    return ports


def _dps_leaves(testbed: VirtualTestbed) -> Iterator[tuple[str, System]]:
    return ((path, system) for path, system in leaves(testbed.diagram) if path.startswith("dps."))


def _systems(testbed: VirtualTestbed, kind: type[Any]) -> Iterator[tuple[str, Any]]:
    return ((path, system) for path, system in leaves(testbed.diagram) if isinstance(system, kind))


def _reasoners(testbed: VirtualTestbed) -> dict[str, OnboardReasoner]:
    from vtbdrake.reasoning import OnboardReasoner

    return {path: part for path, part in slow_parts(testbed.diagram).items() if isinstance(part, OnboardReasoner)}
