"""The models of servicer and target against hand calculation."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake_diagrams.satellite.bodies import ARM_JOINT_NAMES, Servicer, Target
from vtbdrake_diagrams.satellite.model import SERVICER_SDF, TARGET_SDF, WHEELS_SDF, servicer_sdf, target_sdf, wheels_sdf
from vtbdrake_diagrams.satellite.plant import add_servicer, add_target, arm_positions


@pytest.fixture(scope="module")
def plant() -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    add_servicer(plant, wheels=True)
    add_target(plant)
    plant.Finalize()
    return plant


def test_files_are_current() -> None:
    for path, content in ((SERVICER_SDF, servicer_sdf()), (WHEELS_SDF, wheels_sdf()), (TARGET_SDF, target_sdf())):
        assert path.read_text() == content, f"run python -m vtbdrake_diagrams.satellite.model: {path.name} is old"


def test_masses_add_up(plant: MultibodyPlant) -> None:
    context = plant.CreateDefaultContext()
    mass = {
        n: plant.CalcTotalMass(context, [plant.GetModelInstanceByName(n)]) for n in ("servicer", "wheels", "target")
    }
    assert mass == pytest.approx({"servicer": 400.0 + 34.0 + 2.6, "wheels": 18.0, "target": 200.0})


def test_straight_arm_reaches_forward(plant: MultibodyPlant) -> None:
    context = plant.CreateDefaultContext()
    q = plant.GetPositions(context)
    q[arm_positions(plant, plant.GetModelInstanceByName("servicer"))] = 0.0
    plant.SetPositions(context, q)
    s = Servicer()
    X_BG = plant.GetFrameByName("gripper").CalcPoseInWorld(context)
    np.testing.assert_allclose(X_BG.translation(), [0.6 + s.foot + sum(s.lengths) + s.tool, 0.0, -0.35], atol=1e-9)
    np.testing.assert_allclose(X_BG.rotation().col(2), [1.0, 0.0, 0.0], atol=1e-9)


def test_grapple_faces_the_gripper(plant: MultibodyPlant) -> None:
    X_WH = plant.GetFrameByName("grapple").CalcPoseInWorld(plant.CreateDefaultContext())
    np.testing.assert_allclose(X_WH.rotation().matrix()[:, 1:], [[0.0, 1.0], [1.0, 0.0], [0.0, 0.0]], atol=1e-9)


def test_tags_lie_on_faces() -> None:
    t = Target()
    assert len({tag.id for tag in t.tags}) == len(t.tags) == 12
    for tag in t.tags:
        normal, up, center = (np.array(v, dtype=float) for v in (tag.normal, tag.up, tag.center))
        assert normal @ up == 0.0
        on_face = []
        for edges, middle in t.boxes:
            half, offset = np.array(edges) / 2, center - middle
            inside = np.abs(offset) + np.where(normal == 0.0, t.tag_size / 2, 0.0) <= half + 1e-9
            on_face.append(inside.all() and np.isclose(offset @ normal, half @ np.abs(normal)))
        assert any(on_face), tag


def test_every_joint_has_a_range(plant: MultibodyPlant) -> None:
    for name, home in zip(ARM_JOINT_NAMES, Servicer().stowed, strict=True):
        joint = plant.GetJointByName(name)
        assert joint.position_lower_limits()[0] < home < joint.position_upper_limits()[0]
