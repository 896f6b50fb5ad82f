import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import ContactResults

def contact_forces(
    results: ContactResults, body_slots: list[int], geometry_slots: dict[int, int], count: int
) -> NDArray[np.float64]:
    """Return the sums of the magnitudes of contact forces in N, shape (count,).

    Args:
        results: The contacts, in point contact and hydroelastic contact.
        body_slots: By the index of a body, the sum that it adds to; ``count`` if none.
        geometry_slots: By the id's value of a geometry, the sum that it adds to; those not listed add to none.
        count: Number of sums.
    """
