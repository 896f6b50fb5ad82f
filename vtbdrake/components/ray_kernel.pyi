import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array, Indices

Singles = NDArray[np.float32]

def to_world(directions_L: Array, times: Array, motion_WL: Array) -> tuple[Array, Array]:
    """Return the origins (m) and directions in W of rays from the origin of L, shapes (n, 3).

    Args:
        directions_L: Unit vectors, expressed in L at their firing times, shape (n, 3).
        times: Firing times of the rays in s, shape (n,).
        motion_WL: The motion of L in W, shape (18,): R by rows, p (m), w (rad/s) and v (m/s) at the time 0.
    """

def to_body(
    origins_W: Array,
    directions_W: Array,
    times: Array,
    motion_WB: Array,
    bounds_B: Array,
    nearest: Array,
) -> tuple[Singles, Singles, Singles, Indices]:
    """Return origins, directions, largest distances and indices of the rays that may hit the geometry of B, in B.

    Args:
        origins_W: Origins of the rays in m, shape (n, 3).
        directions_W: Unit vectors of the rays, shape (n, 3).
        times: Firing times in s, shape (n,).
        motion_WB: The motion of B in W, as in `to_world`.
        bounds_B: Center and radius of a sphere, and lower and upper corner of a box along B's axes, around the geometry
            of B, in m, shape (10,).
        nearest: Largest distances of the rays in m, shape (n,).
    """

def keep_nearest(
    distances: Singles,
    normals: Singles,
    directions: Singles,
    rays: Indices,
    body: int,
    *,
    nearest: Array,
    cosines: Array,
    bodies: NDArray[np.int32],
) -> None:
    """Write the hits of ``body`` that are nearer than ``nearest`` to the last three arrays.

    Args:
        distances: Distances to the hits in m, shape (m,).
        normals: Normals of the surface at the hits, of any length, shape (m, 3).
        directions: Unit vectors of the rays, shape (m, 3).
        rays: Indices of the rays, shape (m,).
        body: The index of the body that is hit.
        nearest: Distances of the hits of all rays in m, shape (n,).
        cosines: Cosines of the angles of incidence of all rays, shape (n,).
        bodies: Indices of the bodies that the rays hit, shape (n,).
    """
