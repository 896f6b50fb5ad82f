"""The pedometer against a walk whose steps are known."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.dead_reckoning import MOTION, DriftModel
from vtbdrake.components.localization.pedestrian import PedestrianDriftModel, Pedometer

pytestmark = pytest.mark.one_python

T = 0.02
G = 9.81
FREQUENCY = 2.0
"""The number of steps per second of the walk."""
BOB = 0.02
"""The amplitude of the height of the walk, in m."""
BEGIN = 2.0
"""The time at which the walker begins to walk, in s."""
END = 12.0
"""The time at which the walker stands again, in s."""


class Walk(LeafSystem):
    """Measurements of an IMU that is held at a roll and pitch, and rises and falls with each step.

    The speed goes from 0 to ``speed`` within half a second.
    """

    def __init__(self, *, roll: float = 0.0, pitch: float = 0.0, speed: float = 0.0, fault: float = 0.0) -> None:
        super().__init__()
        # From the level frame to the unit: pitch and roll back.
        c, s = np.cos(pitch), np.sin(pitch)
        back_pitch = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        c, s = np.cos(roll), np.sin(roll)
        self._R_BH = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]) @ back_pitch
        self._speed, self._fault = speed, fault
        self.DeclareVectorOutputPort("imu", 6, self._calc)

    def _calc(self, context: Context, output: object) -> None:
        time = context.get_time()
        walks = BEGIN <= time < END
        rate = 2.0 * np.pi * FREQUENCY
        up = G + BOB * rate**2 * np.sin(rate * (time - BEGIN)) * walks
        ahead = self._speed / 0.5 * (BEGIN <= time < BEGIN + 0.5)
        force = self._R_BH @ [ahead, 0.0, up]
        if self._fault and abs(time - self._fault) < T / 2.0:
            force[0] = np.nan
        output.SetFromVector([0.0, 0.0, 0.0, *force])  # type: ignore[attr-defined]


def walked(*, until: float, roll: float = 0.0, pitch: float = 0.0, **walk: float) -> tuple[Pedometer, Context, Array]:
    """Return the pedometer, its context at the end, and its speed over time in rows of [s, m/s]."""
    builder = DiagramBuilder()
    imu = builder.AddSystem(Walk(roll=roll, pitch=pitch, **walk))
    motion = np.zeros(MOTION.size)
    motion[1:3] = roll, pitch
    level = builder.AddSystem(ConstantVectorSource(motion))
    pedometer = builder.AddSystem(Pedometer(period=T))
    builder.Connect(imu.GetOutputPort("imu"), pedometer.GetInputPort("imu"))
    builder.Connect(level.get_output_port(), pedometer.GetInputPort("motion"))
    simulator = Simulator(builder.Build())
    context = pedometer.GetMyContextFromRoot(simulator.get_context())
    rows = []
    for time in np.arange(0.1, until + 1e-9, 0.1):
        simulator.AdvanceTo(time)
        rows.append([time, pedometer.get_output_port().Eval(context).item()])
    return pedometer, context, np.array(rows)


def count(pedometer: Pedometer, context: Context, name: str) -> float:
    """Return a number of the state of the pedometer by its name."""
    element = next(each for each in pedometer.variables if each.name == name)
    return float(context.get_discrete_state(element.index).value()[element.start])


def test_steps_and_their_length_are_counted_in_any_orientation() -> None:
    # Weinberg's formula, with the range of the specific force of the walk: twice its amplitude.
    length = 0.43 * (2.0 * BOB * (2.0 * np.pi * FREQUENCY) ** 2) ** 0.25
    for roll, pitch in ((0.0, 0.0), (0.3, -0.4)):
        pedometer, context, rows = walked(until=END, roll=roll, pitch=pitch)
        late = rows[rows[:, 0] > BEGIN + 4.0, 1]
        assert late.mean() == pytest.approx(length * FREQUENCY, rel=0.1)
        assert count(pedometer, context, "steps") == pytest.approx((END - BEGIN) * FREQUENCY, abs=1.0)


def test_speed_begins_with_the_walk_and_ends_after_it() -> None:
    _, _, rows = walked(until=END + 5.0, speed=1.2)
    by_time = dict(zip(rows[:, 0].round(1).tolist(), rows[:, 1].tolist(), strict=True))
    assert by_time[1.9] == pytest.approx(0.0, abs=1e-9)
    # Before the second step is counted, by the acceleration alone.
    assert by_time[2.6] == pytest.approx(1.2, abs=0.2)
    assert abs(by_time[17.0]) < 0.02


def test_fault_is_left_out_and_counted() -> None:
    pedometer, context, rows = walked(until=6.0, speed=1.2, fault=4.0)
    assert np.isfinite(rows).all()
    assert count(pedometer, context, "ignored") == 1.0


def test_motion_that_no_step_shows_is_uncertain() -> None:
    still = np.zeros(3)
    walker, wheels = (model.covariance(still, 1.0) for model in (PedestrianDriftModel(), DriftModel()))
    assert wheels[0, 0] == 0.0
    assert np.sqrt(walker[0, 0]) == pytest.approx(0.1)
    assert walker[2, 2] > 0.0 and walker[0, 2] == 0.0
