"""Fiducial markers: on a body of a plant, in an image, and the pose that follows from them.

The markers are AprilTags of the family 36h11 (Olson, "AprilTag: A robust and flexible visual fiducial system", ICRA
2011; Wang and Olson, "AprilTag 2", IROS 2016), found by OpenCV's module aruco.

Pixels count as in Drake's `CameraInfo`: (0, 0) is the corner of the first pixel, and its centre is (0.5, 0.5). OpenCV
counts from that centre instead; all that it returns is corrected here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import log
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RotationMatrix

from vtbdrake.common.arrays import Array, immutable, set_read_only
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.perception.estimate import (
    PoseEstimate,
    cross_matrix,
    rotation_matrix,
)
from vtbdrake.components.perception.opencv import grey_image, opencv
from vtbdrake.components.textures import textured_mesh

if TYPE_CHECKING:
    from pydrake.geometry import Mesh, SceneGraphInspector
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import RigidBody
    from pydrake.systems.sensors import ImageRgba8U

FAMILY_SIZE = 587  # The number of markers in 36h11.
# Cells along an edge of the black square of a marker.
_CELLS = 8
# Cells along an edge of the marker with its white frame, which is one cell wide.
_FRAMED = 10
_CELL_PIXELS = 8  # In the texture.
_PROPERTY = ("markers", "size")


@immutable
class MarkerBoard:
    """The positions of the markers on a rigid body T.

    A marker's frame M has its origin in the marker's centre, x to the right and y upwards in the picture, and z
    towards the viewer.

    Attributes:
        ids: The numbers of the markers in the family 36h11, (n,).
        poses: X_TM of each, (n, 3, 4), translation in m.
        size: The edge length of the black square of every marker, in m.
        corners: The corners of the black squares in T, (n, 4, 3) in m, clockwise from the upper left one.
    """

    ids: NDArray[np.int64]
    poses: Array
    size: float
    corners: Array = field(init=False)

    def __post_init__(self) -> None:
        ids, poses = np.array(self.ids, dtype=np.int64), self.poses
        if ids.ndim != 1 or not len(ids) or poses.shape != (len(ids), 3, 4):
            raise ValueError(f"a MarkerBoard has ids (n,) and poses (n, 3, 4), not {ids.shape} and {poses.shape}")
        if len(set(ids.tolist())) < len(ids) or ids.min() < 0 or ids.max() >= FAMILY_SIZE:
            raise ValueError(f"the ids of markers differ and lie in 0 to {FAMILY_SIZE - 1}; found {ids.tolist()}")
        if not 0.0 < self.size < np.inf:
            raise ValueError(f"the size of markers is a positive length in m, not {self.size}")
        set_read_only(self, ids=ids, corners=_on(poses, self.size))

    @staticmethod
    def of(poses: Mapping[int, RigidTransform], *, size: float) -> MarkerBoard:
        """Return the board of markers of one ``size`` (m) with the poses X_TM by id.

        Args:
            poses: The pose X_TM of each marker on the body T, by its number in the family 36h11.
            size: The edge length of the black squares, in m.
        """
        return MarkerBoard(
            np.array(list(poses)), np.array([X_TM.GetAsMatrix34() for X_TM in poses.values()]), float(size)
        )

    def find(self, ids: ArrayLike) -> NDArray[np.int64]:
        """Return the place of each id on this board, -1 for those that it does not have."""
        match = np.asarray(ids)[:, None] == self.ids
        return np.where(match.any(axis=1), match.argmax(axis=1), -1)


def _on(poses: Array, size: float) -> Array:
    """Return the corners (n, 4, 3) of squares of this edge length on the frames M, in the order of the detector."""
    square = 0.5 * size * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    corners: Array = square @ np.swapaxes(poses[:, :, :3], 1, 2) + poses[:, None, :, 3]
    return corners


# -- in a plant


def add_markers(plant: MultibodyPlant, body: RigidBody, board: MarkerBoard, *, name: str = "markers") -> None:
    """Show the markers of a board on a body of a plant that is not finalized, in images and in Meshcat.

    They are one visual geometry, a textured mesh in memory, because every visual costs time in every image. A marker
    occupies a square of 1.25 sizes with its white frame; leave a millimetre between it and the surface behind it.

    Args:
        plant: The plant, registered with a SceneGraph.
        body: The body that is the frame T of the board.
        board: The markers.
        name: Name of the geometry.
    """
    from pydrake.geometry import GeometryInstance, IllustrationProperties, PerceptionProperties, RenderLabel

    shape = _mesh(board)
    geometry = GeometryInstance(RigidTransform(), shape, name)
    geometry.set_illustration_properties(IllustrationProperties())
    properties = PerceptionProperties()
    properties.AddProperty(*_PROPERTY, board.size)
    properties.AddProperty("label", "id", RenderLabel(int(body.index())))  # As a plant labels its own geometry.
    geometry.set_perception_properties(properties)
    plant.RegisterVisualGeometry(body, geometry)


def check_marker_size(board: MarkerBoard, inspector: SceneGraphInspector) -> None:
    """Check that the markers which `add_markers` put into a model are as large as a detector's board says.

    Args:
        board: The board of the detector.
        inspector: The inspector of the scene with the model; other geometry is left out.

    Raises:
        ValueError: They are not.
    """
    for geometry in inspector.GetAllGeometryIds():
        properties = inspector.GetPerceptionProperties(geometry)
        if properties is None or not properties.HasProperty(*_PROPERTY):
            continue
        size = properties.GetProperty(*_PROPERTY)
        if abs(size - board.size) > 1e-9:
            raise ValueError(
                f"the markers of the model ({inspector.GetName(geometry)}) have edges of {size:g} m, but the board of "
                f"the detector says {board.size:g} m: use the same MarkerBoard for both"
            )


def _mesh(board: MarkerBoard) -> Mesh:
    """Return the markers as a mesh: one quad each, with its strip of the texture."""
    count = len(board.ids)
    first = np.arange(count)[:, None]
    strips = np.stack([first, first + 1, first + 1, first], axis=-1).reshape(count, 4) / count
    heights = np.broadcast_to([1.0, 1.0, 0.0, 0.0], (count, 4))
    corners = 4 * np.arange(count)[:, None, None] + [[3, 2, 1], [3, 1, 0]]
    return textured_mesh(
        _on(board.poses, board.size * _FRAMED / _CELLS).reshape(-1, 3),
        normals=np.repeat(board.poses[:, :, 2], 4, axis=0),
        coordinates=np.stack([strips, heights], axis=-1).reshape(-1, 2),
        triangles=corners.reshape(-1, 3),
        image=_texture(board.ids),
    )


def _texture(ids: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return the markers side by side, in their white frames, as a grey image."""
    aruco = opencv().aruco
    dictionary = aruco.getPredefinedDictionary(aruco.DICT_APRILTAG_36h11)
    tiles = [aruco.generateImageMarker(dictionary, int(k), _CELLS * _CELL_PIXELS) for k in ids]
    return np.hstack([np.pad(tile, _CELL_PIXELS, constant_values=255) for tile in tiles])


# -- in an image


REFINEMENTS = ("lines", "subpixel", "none")


@dataclass
class MarkerDetectorConfig:
    """Settings of the detection of markers in an image."""

    window: int = setting(
        23, "The edge of the largest window of the adaptive threshold; the smallest has 3.", unit="pixels", ge=3
    )
    windows: int = setting(3, "The number of windows that are tried.", ge=1)
    threshold: float = setting(
        7.0, "The offset of the adaptive threshold below the mean, in 8-bit counts: less finds markers in the dark."
    )
    min_width: float = setting(
        9.0, "The edge of the smallest marker: below, a cell has hardly more than one pixel.", unit="pixels", gt=0.0
    )
    upscaling: int = setting(
        1,
        "Above 1, markers are also searched for in an image that is enlarged by this factor: 2 finds more that are "
        "narrower than 20 pixels, in two to three times the time.",
        ge=1,
        le=4,
    )
    refinement: str = setting(
        "lines",
        "``lines`` fits lines to the edges of a marker, ``subpixel`` is OpenCV's search at the corners, "
        "``none`` gives whole pixels.",
        choices=REFINEMENTS,
    )
    error_correction: float = setting(
        0.6, "The share of the family's capacity for the correction of bits that is used.", ge=0.0, le=1.0
    )

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, eq=False)
class Detections:
    """The markers found in one image.

    Attributes:
        ids: Their numbers, (n,).
        corners: Their corners in pixels, in the order of `MarkerBoard`, (n, 4, 2).
    """

    ids: NDArray[np.int64]
    corners: Array

    def on(self, board: MarkerBoard) -> Detections:
        """Return those that the board has, each once."""
        first = np.unique(self.ids, return_index=True)[1]
        rows = first[board.find(self.ids[first]) >= 0]
        return Detections(self.ids[rows], self.corners[rows])


def detect_markers(image: ImageRgba8U | NDArray[np.uint8], detector: MarkerDetectorConfig | None = None) -> Detections:
    """Find the markers of the family 36h11 in an image; there may be none.

    Args:
        image: A colour image, or an array (height, width) of grey values.
        detector: The settings of the detection.

    Raises:
        ModuleNotFoundError: OpenCV is missing.
    """
    detector = detector or MarkerDetectorConfig()
    grey = grey_image(image)
    ids, corners = _search(grey, detector, scale=1)
    if detector.upscaling > 1:
        more_ids, more = _search(grey, detector, scale=detector.upscaling)
        is_new = ~_repeated(more, more_ids, corners, ids)
        ids, corners = np.concatenate([ids, more_ids[is_new]]), np.concatenate([corners, more[is_new]])
    if detector.refinement == "lines" and len(ids):
        corners = fit_edges(grey, fit_edges(grey, corners))
    return Detections(ids, corners + 0.5)


def _search(grey: NDArray[np.uint8], detector: MarkerDetectorConfig, *, scale: int) -> tuple[NDArray[np.int64], Array]:
    """Return the ids of markers in an image, (n,), and their corners from the centre of its first pixel, (n, 4, 2).

    Args:
        grey: The image.
        detector: The settings.
        scale: The factor by which the image is enlarged for the search.
    """
    cv2 = opencv()
    aruco = cv2.aruco
    parameters = aruco.DetectorParameters()
    # A window has a middle, so that its edge is odd.
    parameters.adaptiveThreshWinSizeMin = 3 if scale == 1 else 3 * scale + 1 - scale % 2
    parameters.adaptiveThreshWinSizeMax = detector.window * scale + 1 - scale % 2
    parameters.adaptiveThreshWinSizeStep = max(1, scale * (detector.window - 3) // max(1, detector.windows - 1))
    parameters.adaptiveThreshConstant = detector.threshold
    parameters.minMarkerPerimeterRate = 4.0 * detector.min_width / max(grey.shape)
    parameters.errorCorrectionRate = detector.error_correction
    if detector.refinement == "subpixel":
        parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    dictionary = aruco.getPredefinedDictionary(aruco.DICT_APRILTAG_36h11)
    enlarged = grey if scale == 1 else cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    quadrangles, ids, _ = aruco.ArucoDetector(dictionary, parameters).detectMarkers(enlarged)
    if ids is None or not len(ids):
        return np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2))
    corners = np.array(quadrangles, dtype=float).reshape(-1, 4, 2)
    return np.array(ids, dtype=np.int64).ravel(), (corners + 0.5) / scale - 0.5


def _repeated(corners: Array, ids: NDArray[np.int64], first: Array, first_ids: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask of the markers (n, 4, 2) among the first ones (m, 4, 2): the same ids, the middles within them."""
    gaps = np.linalg.norm(corners.mean(axis=1)[:, None] - first.mean(axis=1), axis=2)
    widths = np.linalg.norm(np.diff(first, axis=1), axis=2).max(axis=1, initial=0.0)
    return np.asarray(((ids[:, None] == first_ids) & (gaps < 0.5 * widths)).any(axis=1))


_ALONG = np.linspace(0.08, 0.92, 13)  # Where an edge is searched for, as a share of its length.
_ACROSS = np.linspace(-1.0, 1.0, 13)  # And across, as a share of the reach.


def fit_edges(grey: NDArray[np.uint8], corners: Array) -> Array:
    """Return the corners of markers as the intersections of lines that are fitted to their edges.

    Across an edge, from the black square to its white frame, the place of the edge is the centre of the brightness
    gradient. Weighted with the gradients, the places along one edge give its line.

    Args:
        grey: The image.
        corners: The corners (n, 4, 2), in pixels from the centre of the first pixel, within about one pixel.
    """
    cv2 = opencv()
    following = np.roll(corners, -1, axis=1)
    length = np.linalg.norm(following - corners, axis=2, keepdims=True)
    t = (following - corners) / np.maximum(length, 1e-9)
    # The corners run clockwise in the image, in which y points down.
    n = np.stack([t[..., 1], -t[..., 0]], axis=-1)
    reach = np.clip(0.9 * length / _CELLS, 1.0, 2.0)
    along, across = _ALONG * length, _ACROSS * reach
    points = (
        corners[:, :, None, None]
        + along[..., None, None] * t[:, :, None, None]
        + across[:, :, None, :, None] * n[:, :, None, None]
    ).astype(np.float32)
    flat = points.reshape(-1, len(_ACROSS), 2)
    values = cv2.remap(
        grey.astype(np.float32), flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE
    )
    rise = np.maximum(np.diff(values.reshape(points.shape[:-1]), axis=-1), 0.0)
    weight = rise.sum(axis=-1)
    middle = 0.5 * (across[..., 1:] + across[..., :-1])
    offset = (rise @ middle[..., None])[..., 0] / np.maximum(weight, 1e-9)
    # The line: offset = a + b along.
    total = np.maximum(weight.sum(axis=-1), 1e-9)
    mean_along, mean_offset = (weight * along).sum(axis=-1) / total, (weight * offset).sum(axis=-1) / total
    from_mean = along - mean_along[..., None]
    slope = (weight * from_mean * offset).sum(axis=-1) / np.maximum((weight * from_mean**2).sum(axis=-1), 1e-9)
    through = corners + mean_along[..., None] * t + mean_offset[..., None] * n
    direction = t + slope[..., None] * n
    fitted = _intersections(np.roll(through, 1, axis=1), np.roll(direction, 1, axis=1), through, direction)
    moved = np.linalg.norm(fitted - corners, axis=2, keepdims=True)
    return np.where(moved < 2.0 * reach, fitted, corners)


def _intersections(p: Array, u: Array, q: Array, v: Array) -> Array:
    """Return the points where the lines p + s u and q + t v meet, (..., 2)."""
    across = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    d = q - p
    s = (d[..., 0] * v[..., 1] - d[..., 1] * v[..., 0]) / np.where(np.abs(across) < 1e-9, 1e-9, across)
    return p + s[..., None] * u


# -- the pose

# A pose is clear if another one is less likely by a factor of a thousand: twice the logarithm of that.
_CLEAR = 2.0 * log(1000.0)
# Two poses are apart if one is outside of what the covariance of the other allows: chi-squared, 6 degrees, 99 %.
_APART = 16.8
# Up to this angle in rad between two poses, a covariance covers both.
_NEAR = 0.4
# Markers that are narrower in the image (in pixels) are left out: a cell then has hardly more than one pixel.
_NARROWEST = 10.0
# Standard deviation of an edge, over the marker's width across the edge, which is in pixels.
_DEVIATION = 0.8
# The ends of an edge deviate by this factor more, to either side.
_TURN = 2.0
# Number of residuals that this prior counts for, beside an image's residuals.
_PRIOR_WEIGHT = 4.0


def pose_from_markers(
    detections: Detections,
    board: MarkerBoard,
    intrinsics: ArrayLike,
    *,
    time: float,
    prediction: RigidTransform | None = None,
    corner_noise: float | None = None,
    edge_shift: float = 0.05,
    residual_limit: float = 1.5,
    fewest: int = 3,
) -> PoseEstimate:
    r"""Estimate the pose X_CT of a body from its markers, by the least squares of the reprojection error.

    With the corners p_i of all markers in T, at the pixels u_i, the residuals e_i = u_i - π(R_CT p_i + p_CT) - δ d_i.
    What is measured are the edges: edge k, with its normal n, is off by o_k = n·(e_k + e_k+1) / 2 in its middle, and
    turned such that its ends are off by t_k = n·(e_k+1 - e_k) / 2 more. Minimize by Gauss-Newton steps

        Σ (o_k / σ_k)² + (t_k / 2 σ_k)² + (δ / edge_shift)²

    All edges may be shifted outwards by the same δ pixels, their corners by δ d_i, because a bright frame that is
    overexposed or smoothed grows into the black square. The covariance is s² (JᵀJ)⁻¹ with the Jacobian J of all terms
    r, restricted to the rows and columns of the pose. The smaller a marker is, the less exact are its edges:
    σ_k = 0.8 / w_k pixels at the width w_k of the marker across the edge, in pixels, somewhat more than in rendered
    images whose pixels are means (``supersampling``). By how much it is more or less in an image follows from its
    residuals: s² = (4 + r·r) / (4 + 2 n - 6) for n corners, as if 4 more residuals were as supposed. Markers that are
    less than 10 pixels wide are left out: a few of their corners err by pixels. The steps start at the result of
    OpenCV's SQPNP.

    Small markers in one plane have two poses that fit almost equally well, the plane tilted to one side or to the other
    (Oberkampf, DeMenthon and Davis, "Iterative pose estimation using coplanar feature points", CVIU 63, 1996). Both are
    determined. If neither is a thousand times likelier than the other, the one next to the prediction is taken, and
    without a prediction there is no estimate. If they are near each other, as in a view from the front, the covariance
    is enlarged by their difference δ, by δ δᵀ. With fewer than ``fewest`` markers the steps start at the prediction,
    and without one there is no estimate.

    Args:
        detections: The markers in the image.
        board: Their positions on the body.
        intrinsics: [fx, fy, cx, cy] of the camera in pixels, as in Drake's CameraInfo.
        time: When the image was taken, in s.
        prediction: X_CT as it is expected.
        corner_noise: The standard deviation of every corner's coordinates in pixels, if it is known; s is then at
            least 1, and no marker is too narrow. By default it follows from the image.
        edge_shift: The standard deviation of δ, in pixels.
        residual_limit: The largest root mean square of the residuals of a valid estimate, in pixels.
        fewest: How many markers suffice without a prediction.

    Returns:
        An estimate of X_CT; a missing one if there are too few markers, if they do not fit, or if two poses do.

    Raises:
        ValueError: A corner is not finite.
    """
    on_board = detections.on(board)
    if not np.isfinite(on_board.corners).all():
        raise ValueError("corners of markers are finite numbers of pixels: leave out what was not found")
    wide = _widths(on_board.corners).min(axis=1) >= (_NARROWEST if corner_noise is None else 0.0)
    ids, pixels = on_board.ids[wide], on_board.corners[wide]
    if not len(ids) or (prediction is None and len(ids) < fewest):
        return PoseEstimate.missing(time=time)
    corners = _Corners(
        board.corners[board.find(ids)].reshape(-1, 3),
        pixels.reshape(-1, 2),
        _edges(pixels) if corner_noise is None else np.tile(np.eye(8) / corner_noise, (len(ids), 1, 1)),
        edge_shift * _outward(pixels).reshape(-1, 2),
        np.asarray(intrinsics, dtype=float),
        least_scale=0.0 if corner_noise is None else 1.0,
    )
    start = prediction if len(ids) < fewest else _start(corners)
    fit = None if start is None else _refine(corners, start)
    if fit is None:
        return PoseEstimate.missing(time=time)
    back = _fit_at(corners, _tilted_back(corners.points, fit.X_CT))
    other = None if back is None else _refine(corners, back.X_CT)
    if other is not None and other.squares < fit.squares:
        fit, other = other, fit
    if not fit.rms <= residual_limit:
        return PoseEstimate.missing(time=time)
    estimate = fit.estimate(fit.scale, time=time)
    # In a front view, both may be one minimum.
    rival = next((pose for pose in (other, back) if pose is not None and _is_rival(pose, fit)), None)
    if rival is None:
        return estimate
    apart = estimate.error_to(rival.X_CT)
    if np.linalg.norm(apart[:3]) < _NEAR or rival is back:
        return PoseEstimate.of(estimate.X, estimate.covariance + np.outer(apart, apart), time=time)
    if prediction is None:
        return PoseEstimate.missing(time=time)
    both = (estimate, rival.estimate(fit.scale, time=time))
    return min(both, key=lambda pose: float(np.linalg.norm(pose.error_to(prediction)[:3])))


def _widths(corners: Array) -> Array:
    """Return the width of each marker across each of its edges, (n, 4) in pixels."""
    length = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    a, b = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    area = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    across: Array = area[:, None] / np.maximum(length, 1e-9)
    return across


def _edges(corners: Array) -> Array:
    """Return the matrices that turn errors of corners into errors of edges over their deviations, (n, 8, 8)."""
    along = np.roll(corners, -1, axis=1) - corners
    normals = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-9)
    rows = 0.5 * normals * _widths(corners)[..., None] / _DEVIATION
    matrices = np.zeros((len(corners), 4, 2, 4, 2))
    for k in range(4):
        for end, turn in ((k, -1.0), ((k + 1) % 4, 1.0)):
            matrices[:, k, 0, end] = rows[:, k]
            matrices[:, k, 1, end] = turn / _TURN * rows[:, k]
    return matrices.reshape(-1, 8, 8)


def _outward(corners: Array) -> Array:
    """Return by how much the corners move if the edges of a marker move outwards by a pixel, (n, 4, 2)."""
    edges = np.roll(corners, -1, axis=1) - corners
    edges = edges / np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-9)
    before = np.roll(edges, 1, axis=1)
    sine = before[..., 0] * edges[..., 1] - before[..., 1] * edges[..., 0]
    moved: Array = (before - edges) / np.maximum(np.abs(sine), 0.1)[..., None]
    return moved


def _is_rival(pose: _PoseFit, best: _PoseFit) -> bool:
    """Return whether a pose is nearly as likely as the best one, but outside of what its covariance allows."""
    estimate = best.estimate(best.scale, time=0.0)
    apart = estimate.error_to(pose.X_CT)
    distance = apart @ np.linalg.solve(estimate.covariance, apart)
    return bool(pose.squares - best.squares < _CLEAR * best.scale**2 and distance > _APART)


@dataclass(frozen=True, eq=False)
class _Corners:
    """The corners of the markers in an image, and the same corners on the body.

    Attributes:
        points: In T, (n, 3) in m.
        pixels: In the image, (n, 2).
        whitening: What turns the errors of the four corners of each marker into numbers of deviation 1, (n / 4, 8, 8).
        shift: By how much edges that are shifted by one deviation move them, (n, 2) in pixels.
        intrinsics: [fx, fy, cx, cy] of the camera in pixels.
        least_scale: The smallest factor of the deviations.
    """

    points: Array
    pixels: Array
    whitening: Array
    shift: Array
    intrinsics: Array
    least_scale: float

    def whitened(self, errors: Array) -> Array:
        """Return errors in pixels (or columns of them), (2 n, ...), in their deviations, (2 n, ...)."""
        white: Array = (self.whitening @ errors.reshape(len(self.whitening), 8, -1)).reshape(errors.shape)
        return white


def _start(corners: _Corners) -> RigidTransform | None:
    cv2 = opencv()
    fx, fy, cx, cy = corners.intrinsics
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    try:
        solved, rotation, translation = cv2.solvePnP(corners.points, corners.pixels, K, None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:  # All corners are in one place.
        return None
    if not solved or not np.isfinite(rotation).all():
        return None
    return RigidTransform(RotationMatrix(rotation_matrix(rotation.ravel())), translation.ravel())


def _tilted_back(points: Array, X_CT: RigidTransform) -> RigidTransform:
    """Return the pose from which points in a plane look the same from afar: their depths are exchanged.

    With the line of sight d, a unit vector in C, and the plane's normal n in T, R' = (1 - 2 d dᵀ) R (1 - 2 n nᵀ).
    Points that are in no plane have the normal of least squares.
    """
    middle = points.mean(axis=0)
    n, sight = np.linalg.svd(points - middle)[2][-1], X_CT @ middle
    R = _mirror(sight / np.linalg.norm(sight)) @ X_CT.rotation().matrix() @ _mirror(n)
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), sight - R @ middle)


def _mirror(n: Array) -> Array:
    matrix: Array = np.eye(3) - 2.0 * np.outer(n, n)
    return matrix


@dataclass(frozen=True, eq=False)
class _PoseFit:
    """A pose and a shift of the edges, and how well the corners fit to them.

    Attributes:
        corners: The corners.
        X_CT: The pose.
        shift: The shift of the edges, in its deviations.
        error: Measured less expected pixels, (2 n,).
        residual: The same and the shift, over their deviations, (2 n + 1,).
        J: The Jacobian of what is expected by pose and shift, over the deviations, (2 n + 1, 7).
    """

    corners: _Corners
    X_CT: RigidTransform
    shift: float
    error: Array
    residual: Array
    J: Array

    @property
    def squares(self) -> float:
        """The sum of the squares of the residuals."""
        return float(self.residual @ self.residual)

    @property
    def rms(self) -> float:
        """The root mean square of the residuals in pixels."""
        return float(np.sqrt(np.mean(self.error**2)))

    @property
    def scale(self) -> float:
        """The true deviations over the supposed ones, by the residuals."""
        freedom = len(self.residual) - 7
        scale = np.sqrt((_PRIOR_WEIGHT + self.squares) / (_PRIOR_WEIGHT + freedom))
        return max(float(scale), self.corners.least_scale)

    def estimate(self, scale: float, *, time: float) -> PoseEstimate:
        """Return the estimate at a time (s), with deviations of the corners ``scale`` times the supposed ones."""
        covariance = scale**2 * np.linalg.inv(self.J.T @ self.J)[:6, :6]
        return PoseEstimate.of(self.X_CT, 0.5 * (covariance + covariance.T), time=time)


def _fit_at(corners: _Corners, X_CT: RigidTransform, shift: float = 0.0) -> _PoseFit | None:
    """Return the fit of the corners to a pose; None if it has a corner behind the camera."""
    fx, fy, cx, cy = corners.intrinsics
    turned = corners.points @ X_CT.rotation().matrix().T
    x, y, z = (turned + X_CT.translation()).T
    if z.min() < 1e-3:
        return None
    expected = np.stack([fx * x / z + cx, fy * y / z + cy], axis=1) + shift * corners.shift
    J_p = np.zeros((len(turned), 2, 3))
    J_p[:, 0, 0], J_p[:, 0, 2] = fx / z, -fx * x / z**2
    J_p[:, 1, 1], J_p[:, 1, 2] = fy / z, -fy * y / z**2
    J = np.concatenate([-J_p @ cross_matrix(turned), J_p, corners.shift[:, :, None]], axis=2)
    error = (corners.pixels - expected).ravel()
    residual = np.append(corners.whitened(error), -shift)
    return _PoseFit(
        corners, X_CT, shift, error, residual, np.vstack([corners.whitened(J.reshape(-1, 7)), np.eye(7)[6]])
    )


_MOST_STEPS = 15


def _refine(corners: _Corners, start: RigidTransform) -> _PoseFit | None:
    """Return the fit to the best pose near ``start``, or None if the steps lead to none."""
    X_CT, shift = start, 0.0
    for _ in range(_MOST_STEPS):
        fit = _fit_at(corners, X_CT, shift)
        if fit is None:
            return None
        step, *_ = np.linalg.lstsq(fit.J, fit.residual, rcond=None)
        if np.abs(step[:6]).max() < 1e-8:
            return fit
        step *= min(1.0, 0.5 / max(float(np.linalg.norm(step[:3])), 1e-12))
        R = RotationMatrix.ProjectToRotationMatrix(rotation_matrix(step[:3]) @ X_CT.rotation().matrix())
        X_CT, shift = RigidTransform(R, X_CT.translation() + step[3:6]), shift + float(step[6])
    return None
