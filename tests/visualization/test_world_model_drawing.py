"""Tests of the drawing of a world model, read back from what Meshcat writes."""

import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform

from tests.visualization.meshcat_page import messages
from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.components.world_model import AttributeValue, WorldModel, WorldObject, position_estimate
from vtbdrake.components.world_model.geometry import PARTS
from vtbdrake.visualization import make_meshcat, show_world_model
from vtbdrake.visualization.world_model_drawing import covariance_ellipsoid

GREEN, ORANGE, RED = 0x009E73, 0xE69F00, 0xFF0000


@pytest.fixture(scope="module")
def meshcat() -> Meshcat:
    return make_meshcat()


def drawn(meshcat: Meshcat) -> dict[str, dict]:
    """Path -> message of every object of the model."""
    start = "/drake/world_model/"
    found = [m for m in messages(meshcat.StaticHtml()) if m["type"] == "set_object" and m["path"].startswith(start)]
    return {m["path"].removeprefix(start): m["object"] for m in found}


def material(shape: dict) -> tuple[int, float]:
    (found,) = shape["materials"]
    return found["color"], found["opacity"]


def tree(identity: str, xyz: list[float], **fields: object) -> WorldObject:
    sizes = {"trunk_diameter": AttributeValue(0.3, "m"), "height": AttributeValue(12.0, "m")}
    return WorldObject(identity, "tree", position_estimate(xyz, deviation=0.2), attributes=sizes, **fields)


def test_class_and_status_are_seen(meshcat: Meshcat) -> None:
    rock = WorldObject("r", "rock", position_estimate([1.0, 0.0, 0.0]))
    model = WorldModel([tree("a", [0, 0, 0]), tree("b", [1, 0, 0], status="tentative"), rock])
    model = model.with_objects(tree("c", [2, 0, 0], status="retired"))
    scene = show_world_model(meshcat, model)
    shapes = drawn(meshcat)
    names = {"tree/a", "tree/b", "rock/r"}
    assert set(shapes) == {f"{name}/{part}" for name in names for part in ("marker", "covariance", "label")}
    assert material(shapes["tree/a/marker"]) == (GREEN, 1.0)
    assert material(shapes["rock/r/marker"]) == (ORANGE, 1.0)
    assert material(shapes["tree/b/marker"])[1] < 1.0
    assert scene.legend == {"rock": "#e69f00", "tree": "#009e73"}


def test_drawing_again_replaces_what_is_gone(meshcat: Meshcat) -> None:
    show_world_model(meshcat, WorldModel([tree("a", [0, 0, 0]), tree("b", [0, 0, 0])]))
    show_world_model(
        meshcat,
        WorldModel([tree("b", [0, 0, 0])]),
        colors={"tree": "red"},
        deviations=0.0,
        label_height=0.0,
        parts=PARTS,
    )
    shapes = drawn(meshcat)
    assert set(shapes) == {"tree/b/trunk", "tree/b/crown"}
    assert material(shapes["tree/b/trunk"]) == (RED, 1.0)


def test_ellipsoid_holds_one_standard_deviation() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    one = WorldObject("a", "rock", PoseEstimate.of(RigidTransform([1.0, 2.0, 3.0]), root @ root.T, time=0.0))
    X_WE, semi_axes = covariance_ellipsoid(one.pose)
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    offsets = (semi_axes * directions) @ X_WE.rotation().matrix().T
    P = (root @ root.T)[3:, 3:]
    assert np.allclose(np.einsum("ij,jk,ik->i", offsets, np.linalg.inv(P), offsets), 1.0)
    assert X_WE.translation().tolist() == [1.0, 2.0, 3.0]


def test_ellipsoid_is_flat_where_nothing_is_known(meshcat: Meshcat) -> None:
    one = WorldObject("a", "tree", position_estimate([0, 0, 0], deviation=[0.3, 0.3, np.inf]))
    X_WE, semi_axes = covariance_ellipsoid(one.pose)
    assert sorted(semi_axes) == pytest.approx([0.0, 0.3, 0.3])
    show_world_model(meshcat, WorldModel([one]))
    matrix = np.array(drawn(meshcat)["tree/a/covariance"]["object"]["matrix"]).reshape(4, 4).T
    extent = np.abs(X_WE.rotation().matrix() @ matrix[:3, :3]).max(axis=1)
    assert extent == pytest.approx([0.6, 0.6, 1e-3])


def test_label_has_the_stated_height(meshcat: Meshcat) -> None:
    show_world_model(meshcat, WorldModel([tree("H", [0, 0, 0])]), label_height=2.0)
    (geometry,) = drawn(meshcat)["tree/H/label"]["geometries"]
    points = np.frombuffer(geometry["data"]["attributes"]["position"]["array"], dtype=np.float32).reshape(-1, 3)
    width, depth, height = np.ptp(points, axis=0)
    # Capitals are about 0.7 of a font's size.
    assert depth == 0.0 and 1.2 < height < 1.7 and 0.8 < width < 1.7


def test_negative_sizes_are_refused(meshcat: Meshcat) -> None:
    with pytest.raises(ValueError, match="marker is positive"):
        show_world_model(meshcat, WorldModel(), marker=0.0)
