"""Closed-form leg kinematics against Drake's own."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.morphology import LEGS, Morphology
from vtbdrake_diagrams.space_climber.plant import add_climber

MORPHOLOGY = Morphology()
KINEMATICS = LegKinematics(MORPHOLOGY)


def random_angles(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(MORPHOLOGY.joint_lower, MORPHOLOGY.joint_upper).reshape(6, 3)


def test_forward_agrees_with_drake() -> None:
    plant = MultibodyPlant(0.0)
    climber = add_climber(plant)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    base = plant.GetFrameByName("base")
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = random_angles(rng)
        plant.SetPositions(context, climber, np.concatenate([plant.GetPositions(context)[:7], q.ravel()]))
        p_BF = [plant.GetFrameByName(f"{leg}_foot").CalcPose(context, base).translation() for leg in LEGS]
        np.testing.assert_allclose(KINEMATICS.forward(q), p_BF, atol=1e-12)


def test_inverse_undoes_forward_with_the_knee_up() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        # Away from the stretched leg, and with the foot on the outer side of the hip: there the solution is unique.
        q = np.column_stack([rng.uniform(-1, 1, 6), rng.uniform(-0.8, 0.8, 6), rng.uniform(0.1, 1.5, 6)])
        if np.all(np.cos(q[:, 1]) * 0.2 + np.cos(q[:, 1] + q[:, 2]) * 0.25 + 0.06 > 0.01):
            np.testing.assert_allclose(KINEMATICS.inverse(KINEMATICS.forward(q)), q, atol=1e-9)


def test_round_trip_at_the_stance() -> None:
    stance = MORPHOLOGY.stance
    np.testing.assert_allclose(KINEMATICS.forward(KINEMATICS.inverse(stance)), stance, atol=1e-14)


@pytest.mark.parametrize("scale", [0.0, 3.0, 1e6])
def test_targets_out_of_reach_end_on_the_boundary(scale: float) -> None:
    far = MORPHOLOGY.hips + scale * (MORPHOLOGY.stance - MORPHOLOGY.hips)
    q = KINEMATICS.inverse(far)
    assert np.all(np.isfinite(q))
    if scale > 1.0:
        np.testing.assert_allclose(q[:, 2], 0.0, atol=1e-7)  # a stretched leg
        # The foot lies on the line from the basal joint to the target.
        out = np.hypot(*(far - MORPHOLOGY.hips)[:, :2].T) - MORPHOLOGY.coxa
        drop = (MORPHOLOGY.hips - far)[:, 2]
        np.testing.assert_allclose(np.tan(q[:, 1]), drop / out, rtol=1e-7)


def test_target_too_close_folds_the_leg() -> None:
    basal = MORPHOLOGY.hips + MORPHOLOGY.coxa * np.array([0, 1, 0]) * np.sign(MORPHOLOGY.hips[:, 1:2])
    q = KINEMATICS.inverse(basal)
    np.testing.assert_allclose(q[:, 2], np.pi)
    assert np.all(np.isfinite(q))
