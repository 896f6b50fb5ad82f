"""The semantic world model: objects with class, pose and attributes, from files and observations, to simulate in."""

from vtbdrake.components.world_model.geojson import GeoJsonError, load_geojson, save_geojson
from vtbdrake.components.world_model.geometry import Part, add_to_plant
from vtbdrake.components.world_model.local_frame import LocalFrame
from vtbdrake.components.world_model.object_association import Sighting, associate, mahalanobis
from vtbdrake.components.world_model.objects import AttributeValue, Relation, WorldObject, position_estimate
from vtbdrake.components.world_model.observing import LifeCycleConfig, fused, observe
from vtbdrake.components.world_model.world_model import WORLD_MODEL_CODEC, WorldModel

__all__ = [
    "WORLD_MODEL_CODEC",
    "AttributeValue",
    "GeoJsonError",
    "LifeCycleConfig",
    "LocalFrame",
    "Part",
    "Relation",
    "Sighting",
    "WorldModel",
    "WorldObject",
    "add_to_plant",
    "associate",
    "fused",
    "load_geojson",
    "mahalanobis",
    "observe",
    "position_estimate",
    "save_geojson",
]
