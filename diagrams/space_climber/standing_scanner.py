"""The climber's laser scanner on a robot that stands, in a crater that is seen and not felt."""

from __future__ import annotations

import numpy as np
from pydrake.geometry import Mesh
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import FixedOffsetFrame, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.common.scan import Scan
from vtbdrake.components.meshes import obj_mesh
from vtbdrake.components.ray_casting import RayCaster
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.components.sensors.laser_scanner import LaserScanner, connect_laser_scanner
from vtbdrake_diagrams.space_climber.crater_scenario import SCANNER_NOISE, X_BL, scanner_config
from vtbdrake_diagrams.space_climber.terrain import GREY, Crater

SLICE_PERIOD = 0.2
"""Length of a slice of a scan in s, as in `CraterScenario`."""

# Corners of a box of the size 2, and the triangles of its surface.
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
_TRIANGLES = np.vstack([_FACES[:, [0, 1, 2]], _FACES[:, [0, 2, 3]]])


class StandingScanner:
    """The `LaserScanner` of `CraterScenario` at poses where the robot stands still.

    The crater is two meshes, because a plant of a thousand geometries takes seconds to build.

    Args:
        crater: What it looks at.
    """

    def __init__(self, crater: Crater) -> None:
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.02)
        self._base = plant.AddRigidBody("base", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        frame = plant.AddFrame(FixedOffsetFrame("scanner", self._base.body_frame(), X_BL))
        surfaces = {"ground": crater.mesh} | ({"boulders": _boulders(crater)} if crater.blocks else {})
        for name, (vertices, triangles) in surfaces.items():
            mesh = Mesh(obj_mesh(vertices, triangles, name=name), 1.0)
            plant.RegisterVisualGeometry(plant.world_body(), RigidTransform(), mesh, name, GREY)
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
        plant.Finalize()
        caster = RayCaster(plant, scene_graph, without=[self._base])
        errors = ErrorModel(noise=SCANNER_NOISE)
        config = scanner_config()
        scanner = LaserScanner(plant, frame, caster, config=config, slice_period=SLICE_PERIOD, stream=0, errors=errors)
        builder.AddSystem(scanner)
        connect_laser_scanner(builder, scanner, plant)
        self._plant, self._scanner, self._duration = plant, scanner, 1.0 / config.frequency
        self._diagram = builder.Build()

    def scan(self, X_WB: RigidTransform, time: float) -> Scan:
        """Return the scan of a robot that stands still until a time.

        Args:
            X_WB: Pose of the torso.
            time: The end of the scan in s.
        """
        context = self._diagram.CreateDefaultContext()
        context.SetTime(max(0.0, time - self._duration - SLICE_PERIOD))
        self._plant.SetFreeBodyPose(self._plant.GetMyMutableContextFromRoot(context), self._base, X_WB)
        simulator = Simulator(self._diagram, context)
        simulator.AdvanceTo(context.get_time() + self._duration + 1.5 * SLICE_PERIOD)
        output = self._scanner.GetOutputPort("scan").Eval(self._scanner.GetMyContextFromRoot(context))
        assert isinstance(output, Scan)
        return output


def _boulders(crater: Crater) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (m) and triangles of the surfaces of all boulders."""
    heights = crater.height([b.x for b in crater.blocks], [b.y for b in crater.blocks]).tolist()
    vertices = [
        0.5 * np.array(block.size) * _CORNERS @ RollPitchYaw(block.rpy).ToRotationMatrix().matrix().T
        + np.array([block.x, block.y, z])
        for block, z in zip(crater.blocks, heights, strict=True)
    ]
    triangles = [len(_CORNERS) * k + _TRIANGLES for k in range(len(crater.blocks))]
    return np.vstack(vertices), np.vstack(triangles)
