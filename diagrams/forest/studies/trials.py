"""Trials of global localization: how often a place is recognized on a map without a guess, and how often wrongly.

``vtbdrake campaign trials.yaml``, in the folder of this module, draws stands, maps with errors and places, simulates
the detections (`detections`), and reports how often the matching of constellations was sure and right, sure and wrong,
or not sure. Nothing moves: a rollout of a `TrialScenario` is one trial.

The criteria, fixed before any result was seen, are in the file:

* Places and headings are uniform in a stand of 1 ha; in the cases ``inside``, at least `MARGIN` from its edge, and in
  the cases ``edge`` nearer, where fewer trees are within reach: there are none outside of the stand.
* A place ``outside`` lies in another stand of the same kind, which the map does not show: each sure pose is wrong.
* A pose is right if it is nearer to the true one than 0.2 m plus four standard deviations of the map's positions, and
  turned by less than `LARGEST_TURN`.
* With the poor map, landmarks are gathered along a drive of 40 m; in a plantation also with the remote one, beside the
  trials from one place.
* Of the places inside of natural stands, a share is right and sure that depends on the map; of all trials, less than
  one in a thousand is wrong and sure. These are shares of the trials, for which the confidence is 0.5.
* Seeds begin at 100,000, and no two cases share a stand. No constant of the matching may be chosen with these trials.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import setting
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.planar import compose, wrap
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed import Interface, Scenario, VirtualTestbedBuilder
from vtbdrake_diagrams.forest.studies.detections import Detector, Odometry, Wood, arc, gathered
from vtbdrake_diagrams.forest.world.stand import KINDS, MAPS, Stand

MARGIN = 10.0
"""The least distance of a place ``inside`` from the edge of the stand, in m."""
LARGEST_TURN = np.radians(10.0)
DRIVE = 40.0
"""The length of the drive over which landmarks are gathered, in m."""


@dataclass
class Case:
    """A kind of trial."""

    stand: str = setting("natural", "The kind of stand.", choices=KINDS)
    density: float = setting(600.0, "Trees per hectare.", gt=0.0)
    map: str = setting("accurate", "The map.", choices=tuple(MAPS))
    place: str = setting("inside", "The place of the carrier.", choices=("inside", "edge", "outside"))
    is_driven: bool = setting(
        False, "Whether landmarks are gathered along a drive; with the poor map, they always are."
    )

    @property
    def way(self) -> float:
        """The distance in m along which landmarks are gathered."""
        return DRIVE if self.is_driven or self.map == "poor" else 0.0


@dataclass(frozen=True)
class Trial:
    """The result of one trial.

    Attributes:
        is_sure: Whether the pose is sure.
        is_right: Whether the pose is sure and right.
        position: Error of the position in m.
        heading: Error of the heading in rad.
        nees: Normalized estimation error squared, of 3 degrees of freedom.
    """

    is_sure: bool
    is_right: bool
    position: float
    heading: float
    nees: float


def run(case: Case, *, seed: int, detector: Detector | None = None, odometry: Odometry | None = None) -> Trial:
    """Run one trial.

    Args:
        case: The kind of trial.
        seed: Determines stand, map, place and detections.
        detector: The detector; by default `Detector`, with a share of false trunks from 0.3 to 0.4.
        odometry: The drift of the dead reckoning; by default `Odometry`.
    """
    rng = np.random.default_rng([seed, 7])
    stand = _stand(case, seed)
    errors = MAPS[case.map]
    detector = detector or Detector(false=rng.uniform(0.3, 0.4))
    wood = Wood.of(_stand(case, seed + 10**6) if case.place == "outside" else stand, false=detector.false, rng=rng)
    poses = _drive(case, stand, rng) if case.way else _place(case, stand, rng)[np.newaxis]
    local, _ = gathered(wood, poses, detector, odometry or Odometry(), rng)
    constellation = ConstellationMap(map_landmarks(stand.map(errors)), correlation=errors.correlation)
    return judged(constellation, local, poses[-1], case)


def judged(constellation: ConstellationMap, local: Landmarks, X_WH: Array, case: Case) -> Trial:
    """Return the result of matching local landmarks whose true pose is known."""
    fix = constellation.locate(local)
    if not fix.is_sure:
        return Trial(False, False, np.nan, np.nan, np.nan)
    error = np.append(fix.pose[:2] - X_WH[:2], wrap(fix.pose[2] - X_WH[2]))
    position, heading = float(np.hypot(*error[:2])), abs(float(error[2]))
    is_near = position < 0.2 + 4.0 * MAPS[case.map].position and heading < LARGEST_TURN
    nees = float(error @ np.linalg.solve(fix.covariance, error))
    return Trial(True, case.place != "outside" and is_near, position, heading, nees)


def _stand(case: Case, seed: int) -> Stand:
    return Stand(seed=seed, density=case.density, kind=case.stand)


def _place(case: Case, stand: Stand, rng: np.random.Generator) -> Array:
    """Return a pose in the stand, at its edge or not."""
    extent = np.array([stand.length, stand.width])
    while True:
        place = rng.random(2) * extent
        is_at_edge = min(*place, *(extent - place)) < MARGIN
        if is_at_edge == (case.place == "edge"):
            return np.array([*place, rng.uniform(-np.pi, np.pi)])


def _drive(case: Case, stand: Stand, rng: np.random.Generator) -> Array:
    """Return poses of a drive within the stand that ends at a place of the case, every 2 m."""
    extent = np.array([stand.length, stand.width])
    while True:
        end = _place(case, stand, rng)
        # Backwards from the end: turned by half a turn, driven, and turned back.
        back = arc(compose(end, [0.0, 0.0, np.pi]), length=case.way, curvature=rng.uniform(-0.03, 0.03), step=2.0)
        if (back[:, :2] > 0.0).all() and (back[:, :2] < extent).all():
            return np.array([compose(pose, [0.0, 0.0, np.pi]) for pose in back[::-1]])


@dataclass
class TrialScenario(Scenario):
    """A trial as a testbed: a system of the simulated world whose output is the result of a trial; nothing moves."""

    case: Case = field(default_factory=Case)

    def interface(self) -> Interface:
        return Interface(sense=[], act=[])

    def make_dps(self) -> LeafSystem:
        return LeafSystem()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        builder.add("sys", "trial", TrialSystem(self.case))


class TrialSystem(AddressedSystem):
    """Runs the trial of a seed.

    .. pydrake_system::

        name: TrialSystem
        output_ports:
        - result

    The port has [sure, right, error of the position in m, error of the heading in rad], the errors of a pose that is
    not sure being 0. The seed of the trial is the sum of the parameters ``first`` and ``number``.
    """

    def __init__(self, case: Case) -> None:
        super().__init__()
        self._case = case
        self._seed = self.declare_parameters(first=Quantity(0.0, "1"), number=Quantity(0.0, "1"))
        self.DeclareVectorOutputPort(
            "result", 4, self._calc, prerequisites_of_calc={self.numeric_parameter_ticket(self._seed.index)}
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        seed = self._seed.view(context)
        trial = run(self._case, seed=int(seed.first + seed.number))
        errors = (trial.position, trial.heading) if trial.is_sure else (0.0, 0.0)
        output.SetFromVector([float(trial.is_sure), float(trial.is_right), *errors])


def right(result: Array) -> float:
    """Return 1 if the pose is sure and right, else 0; of the ``result`` of a `TrialSystem`."""
    return float(result[1])


def wrong(result: Array) -> float:
    """Return 1 if the pose is sure and wrong, else 0; of the ``result`` of a `TrialSystem`."""
    return float(result[0] > result[1])


def position_error(result: Array) -> float:
    """Return the error of the position of a right pose in m, else 0; of the ``result`` of a `TrialSystem`."""
    return float(result[1] * result[2])
