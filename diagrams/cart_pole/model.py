"""The SDF model of the cart-pole: a cart on a rail, and a pole that hangs from it.

``python -m vtbdrake_diagrams.cart_pole.model`` rewrites the file in ``models/``.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from pathlib import Path

import numpy as np
from pydrake.multibody.tree import SpatialInertia, UnitInertia

from vtbdrake_diagrams.sdf import add_joint, add_link, add_visual, box, cylinder, document, sphere, start_model, text

CART_POLE_SDF = Path(__file__).parent / "models" / "cart_pole.sdf"
NOTE = "Written by diagrams/cart_pole/model.py; change the cart-pole, not this file."
JOINT_NAMES = ("cart_slider", "pole_pin")

# SDFormat refuses inertias of zero. A joint that only slides does not feel the cart's inertia.
_CART_SIZE = (0.24, 0.12, 0.12)
_TINY = "1e-20"


@dataclass(frozen=True)
class CartPole:
    """The numbers of Drake's own cart-pole (``drake/examples/multibody/cart_pole/cart_pole.sdf``).

    Attributes:
        cart_mass: Mass m_c of the cart in kg.
        pole_mass: Mass m_p in kg, a point at the end of the pole.
        pole_length: Length l of the pole in m.
        gravity: Acceleration g of free fall in m/s^2.
    """

    cart_mass: float = 10.0
    pole_mass: float = 1.0
    pole_length: float = 0.5
    gravity: float = 9.81

    @property
    def hanging_frequency(self) -> float:
        """Return the angular frequency w of small swings of the hanging pole without force, in rad/s.

        From (m_c + m_p) x'' = -m_p l theta'' and l theta'' + x'' = -g theta follows w^2 = g / l (1 + m_p / m_c).
        """
        return sqrt(self.gravity / self.pole_length * (1.0 + self.pole_mass / self.cart_mass))

    def energy(self, q: np.ndarray, v: np.ndarray) -> float:
        """Return the energy in J, zero at rest with the pole level.

        Args:
            q: Position of the cart (m) and angle of the pole (rad), 0 where it hangs.
            v: Their derivatives.
        """
        m_c, m_p, length = self.cart_mass, self.pole_mass, self.pole_length
        kinetic = 0.5 * (m_c + m_p) * v[0] ** 2 + m_p * length * v[0] * v[1] * np.cos(q[1])
        kinetic += 0.5 * m_p * length**2 * v[1] ** 2
        return float(kinetic - m_p * self.gravity * length * np.cos(q[1]))

    def advanced(self, state: np.ndarray, force: float, dt: float) -> np.ndarray:
        """Return the state [x, theta, x', theta'] ``dt`` seconds after another one: one step of Runge and Kutta.

        Args:
            state: The state, shape (4,), in m and rad.
            force: The constant force on the cart in N.
            dt: The step in seconds.
        """
        m_c, m_p, length, g = self.cart_mass, self.pole_mass, self.pole_length, self.gravity

        def rates(s: np.ndarray) -> np.ndarray:
            sin, cos, rate = np.sin(s[1]), np.cos(s[1]), s[3]
            a = (force + m_p * sin * (length * rate**2 + g * cos)) / (m_c + m_p * sin**2)
            return np.array([s[2], rate, a, -(a * cos + g * sin) / length])

        k1 = rates(state)
        k2 = rates(state + 0.5 * dt * k1)
        k3 = rates(state + 0.5 * dt * k2)
        return state + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rates(state + dt * k3))


def cart_pole_sdf(cart_pole: CartPole | None = None) -> str:
    """Return the text of the SDF model ``cart_pole``.

    It has the links ``cart`` and ``pole``, the driven joint ``cart_slider`` along x and the joint ``pole_pin``; at zero
    angle the pole hangs, and a small positive one moves its end along x.
    """
    cart_pole = cart_pole or CartPole()
    root, model = start_model("cart_pole", "cart", note=NOTE)
    length = cart_pole.pole_length
    cart = add_link(model, "cart", None, SpatialInertia.SolidBoxWithMass(cart_pole.cart_mass, *_CART_SIZE))
    add_visual(cart, "body", box(*_CART_SIZE), "0 0 0 0 0 0", "0.30 0.32 0.35 1")
    point = SpatialInertia(cart_pole.pole_mass, [0.0, 0.0, -length], UnitInertia(length**2, length**2, 0.0))
    pole = add_link(model, "pole", ("cart", "0 0 0 0 0 0"), point)
    inertia = pole.find("inertial/inertia")
    assert inertia is not None
    for tag in ("ixx", "iyy", "izz"):
        element = inertia.find(tag)
        assert element is not None
        element.text = _TINY
    add_visual(pole, "rod", cylinder(0.02, length), f"0 0 {text(-length / 2)} 0 0 0", "0.86 0.87 0.88 1")
    add_visual(pole, "mass", sphere(0.05), f"0 0 {text(-length)} 0 0 0", "0.95 0.50 0.10 1")
    add_joint(model, JOINT_NAMES[0], "world", "cart", kind="prismatic", axis_J="1 0 0")
    add_joint(model, JOINT_NAMES[1], "cart", "pole", axis_J="0 -1 0", torque=0.0)
    return document(root)


def write() -> None:
    """Write the file in ``models/``."""
    CART_POLE_SDF.parent.mkdir(exist_ok=True)
    CART_POLE_SDF.write_text(cart_pole_sdf())


if __name__ == "__main__":
    write()
