"""Functions to compare solvers on: those that `auto` was tuned on, and those that are kept back to judge it.

Both are in three kinds: smooth ones, nearly quadratic, ill-conditioned or curved; multimodal ones; and ones with noise,
steps or impacts, as rollouts have. The split is by name, and was made before the solver was changed: nothing in
`vtbdrake/optimization/solvers` was chosen by a look at `HELD_OUT`. Every box is shifted, so that neither its middle nor
a corner is an optimum; "rotated" functions have axes that are no parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

SMOOTH = "smooth"
MULTIMODAL = "multimodal"
ROUGH = "rough"


@dataclass(frozen=True)
class Function:
    """A function of a place in the unit cube.

    Attributes:
        kind: `SMOOTH`, `MULTIMODAL` or `ROUGH`.
        size: The number of parameters.
        true: The cost at a place, shape (size,), without noise.
        lowest: The smallest cost.
        noise: Standard deviation of what is added, normal, and the same whenever a place is repeated.
        relative: The part of the cost by which the noise grows.
    """

    kind: str
    size: int
    true: Callable[[np.ndarray], float]
    lowest: float = 0.0
    noise: float = 0.0
    relative: float = 0.0

    def cost(self, u: np.ndarray) -> float:
        """Return the cost that a solver gets at ``u`` in the unit cube, shape (size,)."""
        value = self.true(u)
        if not (self.noise or self.relative):
            return value
        draw = np.random.default_rng(u.view(np.uint32).tolist()).standard_normal()
        return value + (self.noise + self.relative * (value - self.lowest)) * float(draw)


# ------------------------------------------------------------------------------ places


@cache
def _rotation(size: int, seed: int) -> np.ndarray:
    """Return an orthogonal matrix, shape (size, size)."""
    Q, R = np.linalg.qr(np.random.default_rng(seed).standard_normal((size, size)))
    return Q * np.sign(np.diag(R))


def _boxed(function: Callable[[np.ndarray], float], lower: float, upper: float) -> Callable[[np.ndarray], float]:
    """Return a function of the unit cube, from one of a box."""
    return lambda u: float(function(lower + u * (upper - lower)))


def _shifted(
    function: Callable[[np.ndarray], float], size: int, width: float, *, seed: int, rotated: bool = True
) -> Callable[[np.ndarray], float]:
    """Return a function of the unit cube, of ``width``, with its place 0 in the inner half, turned at will."""
    best = 0.25 + 0.5 * np.random.default_rng(seed).random(size)
    M = width * (_rotation(size, seed) if rotated else np.eye(size))
    return lambda u: float(function(M @ (u - best)))


# ------------------------------------------------------------------------------ smooth


def _ellipsoid(condition: float) -> Callable[[np.ndarray], float]:
    return lambda x: x**2 @ condition ** (np.arange(x.size) / max(x.size - 1, 1))


def _rosenbrock(x: np.ndarray) -> float:
    return np.sum(100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2)


def _zakharov(x: np.ndarray) -> float:
    tilt = 0.5 * np.arange(1, x.size + 1) @ x
    return x @ x + tilt**2 + tilt**4


def _powell(x: np.ndarray) -> float:
    """Powell's function: singular in its minimum."""
    a, b, c, d = x.reshape(-1, 4).T
    return np.sum((a + 10.0 * b) ** 2 + 5.0 * (c - d) ** 2 + (b - 2.0 * c) ** 4 + 10.0 * (a - d) ** 4)


def _branin(x: np.ndarray) -> float:
    a, b = 15.0 * x + [-5.0, 0.0]
    valley = b - 5.1 / (4.0 * np.pi**2) * a**2 + 5.0 / np.pi * a - 6.0
    return valley**2 + 10.0 * (1.0 - 1.0 / (8.0 * np.pi)) * np.cos(a) + 10.0


def _trid(x: np.ndarray) -> float:
    """Trid: quadratic, its axes no parameters; the best place is i (n + 1 - i)."""
    return np.sum((x - 1.0) ** 2) - x[1:] @ x[:-1]


def _dixon_price(x: np.ndarray) -> float:
    return (x[0] - 1.0) ** 2 + np.arange(2, x.size + 1) @ (2.0 * x[1:] ** 2 - x[:-1]) ** 2


def _colville(x: np.ndarray) -> float:
    a, b, c, d = x
    valleys = 100.0 * (a**2 - b) ** 2 + (a - 1.0) ** 2 + 90.0 * (c**2 - d) ** 2 + (c - 1.0) ** 2
    return valleys + 10.1 * ((b - 1.0) ** 2 + (d - 1.0) ** 2) + 19.8 * (b - 1.0) * (d - 1.0)


def _powers(x: np.ndarray) -> float:
    """Sum of powers of 2 to 6: nearly quadratic, flat along some axes."""
    return np.sum(np.abs(x) ** (2.0 + 4.0 * np.arange(x.size) / (x.size - 1)))


def _log_cosh(x: np.ndarray) -> float:
    """A quadratic that becomes linear far from its minimum, along each of its axes."""
    return np.sum(np.logaddexp(x, -x) - math.log(2.0))


# ------------------------------------------------------------------------------ multimodal


def _rastrigin(x: np.ndarray) -> float:
    return np.sum(x**2 + 10.0 * (1.0 - np.cos(2.0 * np.pi * x)))


def _ackley(x: np.ndarray) -> float:
    slope = 20.0 - 20.0 * np.exp(-0.2 * np.sqrt(np.mean(x**2)))
    return slope + np.e - np.exp(np.mean(np.cos(2.0 * np.pi * x)))


def _griewank(x: np.ndarray) -> float:
    return x @ x / 4000.0 + 1.0 - np.prod(np.cos(x / np.sqrt(np.arange(1, x.size + 1))))


def _levy(x: np.ndarray) -> float:
    w = 1.0 + x / 4.0
    middle = (w[:-1] - 1.0) ** 2 @ (1.0 + 10.0 * np.sin(np.pi * w[:-1] + 1.0) ** 2)
    return np.sin(np.pi * w[0]) ** 2 + middle + (w[-1] - 1.0) ** 2 * (1.0 + np.sin(2.0 * np.pi * w[-1]) ** 2)


def _schwefel(x: np.ndarray) -> float:
    """Schwefel's function 2.26: the second best place is far from the best one."""
    return 418.9828872724338 * x.size - x @ np.sin(np.sqrt(np.abs(x)))


def _rotated_schwefel(x: np.ndarray) -> float:
    """Schwefel's function with other axes around its best place, and a slope back into its box, as in the CEC's."""
    z = _rotation(x.size, 23) @ (x - 420.9687462275036) + 420.9687462275036
    inside = np.clip(z, -500.0, 500.0)
    return _schwefel(inside) + np.sum((z - inside) ** 2) / 10_000.0


def _michalewicz(x: np.ndarray) -> float:
    return -np.sum(np.sin(x) * np.sin(np.arange(1, x.size + 1) * x**2 / np.pi) ** 20)


def _salomon(x: np.ndarray) -> float:
    r = math.sqrt(x @ x)
    return 1.0 - math.cos(2.0 * np.pi * r) + 0.1 * r


@cache
def _peaks(size: int, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    centres, widths = 0.1 + 0.8 * generator.random((count, size)), 30.0 * 10.0 ** (generator.random((count, size)))
    return centres, widths, np.concatenate([[10.0], 1.5 + 7.5 * np.arange(count - 1) / (count - 1)])


def _gallagher(u: np.ndarray) -> float:
    """Gallagher's peaks, each with other widths; the highest is one of many."""
    centres, widths, heights = _peaks(u.size, 21, 5)
    return 10.0 - np.max(heights * np.exp(-0.5 / u.size * np.sum(widths * (u - centres) ** 2, axis=1)))


def _styblinski_tang(x: np.ndarray) -> float:
    """Two minima along each axis; the deepest is at 0."""
    z = x - 2.903534027771178
    return np.sum(z**4 - 16.0 * z**2 + 5.0 * z) + 78.33233140754282 * x.size


def _gramacy_lee(x: np.ndarray) -> float:
    return np.sin(10.0 * np.pi * x[0]) / (2.0 * x[0]) + (x[0] - 1.0) ** 4


_HARTMANN_A = np.array(
    [[10, 3, 17, 3.5, 1.7, 8], [0.05, 10, 17, 0.1, 8, 14], [3, 3.5, 1.7, 10, 17, 8], [17, 8, 0.05, 10, 0.1, 14]]
)
_HARTMANN_P = 1e-4 * np.array(
    [
        [1312, 1696, 5569, 124, 8283, 5886],
        [2329, 4135, 8307, 3736, 1004, 9991],
        [2348, 1451, 3522, 2883, 3047, 6650],
        [4047, 8828, 8732, 5743, 1091, 381],
    ]
)


def _hartmann(u: np.ndarray) -> float:
    return -np.array([1.0, 1.2, 3.0, 3.2]) @ np.exp(-np.sum(_HARTMANN_A * (u - _HARTMANN_P) ** 2, axis=1))


# ------------------------------------------------------------------------------ as rollouts have


def _steps(x: np.ndarray) -> float:
    """An ellipsoid in steps, whose treads tilt a little."""
    z = np.where(np.abs(x) > 0.5, np.round(x), np.round(10.0 * x) / 10.0)
    return max(abs(x[0]) / 1e4, float(z**2 @ 100.0 ** (np.arange(x.size) / max(x.size - 1, 1))))


def _sharp(x: np.ndarray) -> float:
    """The sharp ridge: along it the cost falls slowly, beside it, it rises at once."""
    return x[0] ** 2 + 100.0 * math.sqrt(x[1:] @ x[1:])


def _absolute(x: np.ndarray) -> float:
    """Weighed absolute values, with a crease along each axis."""
    return np.abs(x) @ 10.0 ** (np.arange(x.size) / max(x.size - 1, 1))


def _cart(u: np.ndarray) -> float:
    """A mass with dry friction is pushed by n forces in turn, and shall rest at 1: it sticks, so there are steps."""
    position = speed = effort = 0.0
    for force in np.repeat(4.0 * u - 2.0, 20):
        effort += force**2 / (20.0 * u.size)
        if speed == 0.0 and abs(force) <= 0.5:
            continue
        drag = 0.5 * (math.copysign(1.0, speed) if speed else math.copysign(1.0, force))
        after = speed + 0.05 * (force - drag)
        speed = 0.0 if speed * after < 0.0 else after
        position += 0.05 * speed
    return abs(position - 1.0) + abs(speed) + 0.01 * effort


def _ball(u: np.ndarray) -> float:
    """A ball is thrown at a wall and shall land in a bucket behind its bounce: speed, angle, spin kept at impacts."""
    speed, angle, lift = 4.0 + 8.0 * u[0], 0.2 + 1.2 * u[1], 0.5 + 1.5 * u[2]
    x, y, vx, vy = 0.0, lift, speed * math.cos(angle), speed * math.sin(angle)
    bounces, nearest = 0, math.inf
    for _ in range(600):
        x, y, vy = x + 0.005 * vx, y + 0.005 * vy, vy - 0.005 * 9.81
        if x > 5.0 and vx > 0.0:
            vx = -0.7 * vx
        if y < 0.0 and vy < 0.0:
            vy, vx, bounces = -0.6 * vy, 0.8 * vx, bounces + 1
        nearest = min(nearest, math.hypot(x - 2.6, y - 0.4) + 0.3 * abs(bounces - 1))
    return nearest


def _pendulum(u: np.ndarray) -> float:
    """A pendulum with a weak motor swings up by n torques in turn, and strikes a stop at 3.5 rad."""
    angle = rate = effort = 0.0
    for torque in np.repeat(5.0 * u - 2.5, 60 // u.size + 1):
        rate += 0.05 * (torque - 9.81 * math.sin(angle) - 0.1 * rate)
        angle += 0.05 * rate
        if abs(angle) > 3.5:
            angle, rate = math.copysign(3.5, angle), -0.5 * rate
        effort += 0.001 * torque**2
    return (1.0 + math.cos(angle)) + 0.1 * rate**2 / (1.0 + 0.1 * rate**2) + effort / 60.0


def _walker(u: np.ndarray) -> float:
    """A rimless wheel is pushed before each of 12 steps by a law of 6 gains; where it falls decides the cost."""
    speed, walked = 0.4 + 0.4 * u[0], 0.0
    for step in range(12):
        slope = 0.08 * math.sin(1.7 * step)
        push = u[1] + u[2] * (0.9 - speed) * 2.0 + (u[3] - 0.5) * slope * 10.0 + (u[4] - 0.5) * math.sin(step)
        energy = (0.88 * speed) ** 2 + 0.3 * push - 0.12 - slope
        if energy <= 0.0 or speed > 2.2:
            return 3.0 - walked / 12.0
        speed = math.sqrt(energy)
        walked += 1.0
    return abs(speed - 0.9 - 0.2 * u[5]) + 0.3 * abs(u[5] - 0.35) + 0.2 * (u[1] - 0.3) ** 2


# ------------------------------------------------------------------------------ the two sets

# The functions that `auto` may be tuned on.
TUNING: dict[str, Function] = {
    "sphere_2": Function(SMOOTH, 2, _shifted(lambda x: x @ x, 2, 10.0, seed=11)),
    "ellipsoid_10": Function(SMOOTH, 10, _shifted(_ellipsoid(1e6), 10, 10.0, seed=12)),
    "rosenbrock_4": Function(SMOOTH, 4, _boxed(_rosenbrock, -2.0, 2.5)),
    "rosenbrock_16": Function(SMOOTH, 16, _boxed(_rosenbrock, -2.0, 2.5)),
    "zakharov_3": Function(SMOOTH, 3, _shifted(_zakharov, 3, 12.0, seed=13, rotated=False)),
    "powell_8": Function(SMOOTH, 8, _shifted(_powell, 8, 8.0, seed=14, rotated=False)),
    "branin_2": Function(MULTIMODAL, 2, _branin, 10.0 / (8.0 * np.pi)),
    "hartmann_6": Function(MULTIMODAL, 6, _hartmann, -3.322368011391339),
    "rastrigin_8": Function(MULTIMODAL, 8, _shifted(_rastrigin, 8, 10.0, seed=15)),
    "ackley_3": Function(MULTIMODAL, 3, _shifted(_ackley, 3, 40.0, seed=16)),
    "griewank_5": Function(MULTIMODAL, 5, _shifted(_griewank, 5, 100.0, seed=17)),
    "levy_12": Function(MULTIMODAL, 12, _shifted(_levy, 12, 16.0, seed=18)),
    "schwefel_4": Function(MULTIMODAL, 4, _boxed(_schwefel, -500.0, 500.0)),
    "noisy_hartmann_6": Function(ROUGH, 6, _hartmann, -3.322368011391339, noise=0.1),
    "noisy_sphere_10": Function(ROUGH, 10, _shifted(lambda x: x @ x, 10, 10.0, seed=19), relative=0.1, noise=0.5),
    "steps_5": Function(ROUGH, 5, _shifted(_steps, 5, 10.0, seed=20)),
    "sharp_6": Function(ROUGH, 6, _shifted(_sharp, 6, 4.0, seed=21)),
    "cart_8": Function(ROUGH, 8, _cart),
}

# More functions at several sizes and places: the kind, the function, its width, and pairs of size and seed.
_FAMILIES: dict[str, tuple[str, Callable[[np.ndarray], float], float, tuple[tuple[int, int], ...]]] = {
    "ellipsoid": (SMOOTH, _ellipsoid(1e3), 7.0, ((2, 201), (4, 202), (8, 203), (14, 204))),
    "turned_rosenbrock": (SMOOTH, lambda x: _rosenbrock(x + 1.0), 3.5, ((3, 205), (6, 206), (12, 207))),
    "zakharov": (SMOOTH, _zakharov, 9.0, ((2, 208), (4, 209), (9, 210))),
    "powell": (SMOOTH, _powell, 7.0, ((12, 211), (4, 212))),
    "cone": (SMOOTH, lambda x: math.sqrt(1.0 + x @ x) - 1.0, 6.0, ((5, 213), (18, 214))),
    "rastrigin": (MULTIMODAL, _rastrigin, 7.0, ((2, 215), (5, 216), (12, 217))),
    "ackley": (MULTIMODAL, _ackley, 35.0, ((1, 218), (4, 219), (7, 220))),
    "griewank": (MULTIMODAL, _griewank, 150.0, ((2, 221), (7, 222), (14, 223))),
    "levy": (MULTIMODAL, _levy, 14.0, ((3, 224), (8, 225))),
    "styblinski_tang": (MULTIMODAL, _styblinski_tang, 9.0, ((2, 226), (3, 227), (7, 228))),
    "steps": (ROUGH, _steps, 9.0, ((2, 229), (6, 230), (10, 231))),
    "sharp": (ROUGH, _sharp, 4.0, ((2, 232), (5, 233), (10, 234))),
    "absolute": (ROUGH, _absolute, 6.0, ((3, 235), (10, 236))),
    "worst": (ROUGH, lambda x: np.max(np.abs(x) * np.linspace(1.0, 4.0, x.size)), 6.0, ((2, 242), (4, 243), (8, 244))),
}
TUNING |= {
    f"{name}_{size}": Function(kind, size, _shifted(function, size, width, seed=seed))
    for name, (kind, function, width, members) in _FAMILIES.items()
    for size, seed in members
}
TUNING |= {
    f"noisy_ellipsoid_{size}": Function(
        ROUGH, size, _shifted(_ellipsoid(10.0), size, 6.0, seed=seed), noise=0.5, relative=0.1
    )
    for size, seed in ((3, 237), (6, 238), (14, 239))
}

# The functions that judge it.
HELD_OUT: dict[str, Function] = {
    "ill_conditioned_7": Function(SMOOTH, 7, _shifted(_ellipsoid(1e4), 7, 6.0, seed=31)),
    "rosenbrock_10": Function(SMOOTH, 10, _boxed(_rosenbrock, -1.5, 2.2)),
    "trid_6": Function(SMOOTH, 6, _boxed(_trid, -36.0, 30.0), -50.0),
    "dixon_price_5": Function(SMOOTH, 5, _boxed(_dixon_price, -8.0, 10.0)),
    "colville_4": Function(SMOOTH, 4, _boxed(_colville, -4.0, 7.0)),
    "powers_15": Function(SMOOTH, 15, _shifted(_powers, 15, 3.0, seed=32)),
    "log_cosh_20": Function(SMOOTH, 20, _shifted(_log_cosh, 20, 8.0, seed=33)),
    "gramacy_lee_1": Function(MULTIMODAL, 1, _boxed(_gramacy_lee, 0.5, 2.5), -0.8690111349894997),
    "schwefel_rotated_2": Function(MULTIMODAL, 2, _boxed(_rotated_schwefel, -500.0, 500.0)),
    "gallagher_3": Function(MULTIMODAL, 3, _gallagher),
    "michalewicz_5": Function(MULTIMODAL, 5, _boxed(_michalewicz, 0.0, np.pi), -4.687658179),
    "salomon_4": Function(MULTIMODAL, 4, _shifted(_salomon, 4, 12.0, seed=34)),
    "rastrigin_rotated_10": Function(MULTIMODAL, 10, _shifted(_rastrigin, 10, 8.0, seed=35)),
    "griewank_rotated_15": Function(MULTIMODAL, 15, _shifted(_griewank, 15, 600.0, seed=36)),
    "noisy_ellipsoid_4": Function(ROUGH, 4, _shifted(_ellipsoid(30.0), 4, 6.0, seed=37), noise=1.0, relative=0.1),
    "noisy_log_cosh_12": Function(ROUGH, 12, _shifted(_log_cosh, 12, 8.0, seed=38), noise=0.3, relative=0.05),
    "noisy_zakharov_2": Function(ROUGH, 2, _shifted(_zakharov, 2, 10.0, seed=39), noise=0.2, relative=0.3),
    "steps_8": Function(ROUGH, 8, _shifted(_steps, 8, 12.0, seed=40)),
    "ball_3": Function(ROUGH, 3, _ball),
    "walker_6": Function(ROUGH, 6, _walker, 0.0429445513),
    "pendulum_10": Function(ROUGH, 10, _pendulum, 0.9697215615),
}
