"""Labelled scans of streets: trees among poles, hedges, walls and cars.

The scans are of SemanticKITTI (J. Behley et al., ICCV 2019; CC BY-NC-SA 4.0), as two repositories on GitHub publish a
few of them as examples. They are not part of this project: `FILES` says where they are expected.

* ``semantickitti/spvnas``: ``assets/000000.bin`` and ``.label`` of mit-han-lab/spvnas: a whole scan.
* ``semantickitti/open3d_ml``: ``examples/demo_data/SemanticKITTI`` (points and labels 000700, 000750) and
  ``examples/data`` (kitti_01_points_000000 and its labels) of isl-org/Open3D-ML, in its history at 0cbfde6 and df4394a:
  thinned to a point in 6 cm, with fewer classes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.trunks import TrunkDetectorConfig

TRUNK = "trunk"
"""The kind of points on trunks."""
POLE = "pole"
"""The kind of points on poles."""
# The kinds by label in the classes of SemanticKITTI.
_RAW = {71: TRUNK, 80: POLE}
# The kinds by label in the classes of Open3D-ML.
_MAPPED = {16: TRUNK, 18: POLE}
# Points of one stem are linked by less than this, in m.
_LINK = 0.4
# A scan shows a stem by at least this number of points in the slice of the detector.
_FEWEST = 10
# A point within this distance of a detected cylinder is on it, in m.
_MARGIN = 0.1

FILES = {
    "street 1": ("semantickitti/open3d_ml/000700.points.npy", "semantickitti/open3d_ml/000700.labels.npy"),
    "street 2": ("semantickitti/open3d_ml/000750.points.npy", "semantickitti/open3d_ml/000750.labels.npy"),
    "highway": ("semantickitti/open3d_ml/01_000000.points.npy", "semantickitti/open3d_ml/01_000000.labels.npy"),
    "street 3": ("semantickitti/spvnas/000000.bin", "semantickitti/spvnas/000000.label"),
}
"""The files of points and of labels in the folder of recordings, by scan."""
FITTED = ("street 1", "street 2", "highway")
"""Scans that the detector's weights are fitted to."""
JUDGES = ("street 3",)
"""Scans that had no part in the detector."""
# The places of scanners that are not at the origin, in m.
_PLACES = {"street 1": (0.0, -100.0, 0.0)}


@dataclass(frozen=True, eq=False)
class StreetScan:
    """A scan of a street.

    Attributes:
        points: The points in m, z up over the ground under the scanner, which is at `EYE`, (n, 3).
        kinds: The kind of each point, (n,): `TRUNK`, `POLE` or "".
    """

    points: Array
    kinds: NDArray[np.str_]
    EYE: ClassVar[Array] = np.array([0.0, 0.0, 1.73])
    DETECTOR: ClassVar[TrunkDetectorConfig] = TrunkDetectorConfig(
        azimuth_step=np.radians(0.173), elevation_step=np.radians(0.41), range_noise=0.02
    )

    @classmethod
    def read(cls, folder: Path, name: str) -> StreetScan:
        """Return a scan of `FILES`."""
        points_file, labels_file = (folder / file for file in FILES[name])
        if points_file.suffix == ".bin":
            points = np.fromfile(points_file, np.float32).reshape(-1, 4)[:, :3].astype(float)
            labels, kinds_of = np.fromfile(labels_file, np.uint32) & 0xFFFF, _RAW
        else:
            points, labels, kinds_of = np.load(points_file).astype(float), np.load(labels_file).ravel(), _MAPPED
        kinds = np.full(len(labels), "", dtype="<U5")
        for label, kind in kinds_of.items():
            kinds[labels == label] = kind
        return cls(points - _PLACES.get(name, np.zeros(3)) + cls.EYE, kinds)

    def stems(self) -> list[Array]:
        """Return the points (k, 2) of each stem that the scan shows within the reach of the detector."""
        low, high = self.DETECTOR.heights
        z, is_trunk = self.points[:, 2], self.kinds == TRUNK
        places = self.points[is_trunk & (z > low) & (z < high), :2]
        if not len(places):
            return []
        links = cKDTree(places).sparse_distance_matrix(cKDTree(places), _LINK)
        _, owners = connected_components(links, directed=False)
        parts = [places[owners == owner] for owner in range(owners.max() + 1)]
        reach = self.DETECTOR.reach
        return [part for part in parts if len(part) >= _FEWEST and np.hypot(*part.mean(axis=0)) < reach]

    def kinds_of(self, places: Array, diameters: Array) -> list[str]:
        """Return the kind of most points on each detected cylinder at places (k, 2) with diameters (k,)."""
        low, high = self.DETECTOR.heights
        inside = (self.points[:, 2] > low) & (self.points[:, 2] < high)
        kinds, tree = self.kinds[inside], cKDTree(self.points[inside, :2])
        on = [kinds[rows] for rows in tree.query_ball_point(places, 0.5 * diameters + _MARGIN)]
        return [next((kind for kind in (TRUNK, POLE) if np.mean(part == kind) > 0.5), "") for part in on]
