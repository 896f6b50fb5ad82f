"""Plots show the numbers of the sweep: drawn data are compared with it."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from tests.optimization.studies import THETA, pendulum_problem
from vtbdrake.optimization import Parameter, Sweep
from vtbdrake.rollout import Quality, RolloutResult
from vtbdrake.rollout.quality import best_sample
from vtbdrake.visualization import plot_quality, plot_sweep

MASS = Parameter("sim.sys.payload.mass", 0.0, 60.0)
FRICTION = Parameter("sim.env.ground.friction", 0.0, 1.0)
TIMES = np.linspace(0.0, 2.0, 21)


def rollout(quality: np.ndarray, threshold: float = np.inf, failed: bool = False, **parameters: float) -> RolloutResult:
    above = np.flatnonzero(quality > threshold)
    quality = quality[: above[0] + 1] if above.size else quality
    best = best_sample(quality, threshold=threshold)
    return RolloutResult(
        parameters=parameters,
        end="failed" if failed else "threshold" if above.size else "horizon",
        times=TIMES[: quality.size],
        quality=quality,
        t_star=np.nan if failed else TIMES[best],
        h=np.nan if failed else quality[best],
        value=np.nan if failed else quality[best],
        threshold=threshold,
        exceedances=TIMES[above[:1]],
    )


def sweep(points, rollouts, conditions=({},), parameters=(MASS,), units=("kg",)) -> Sweep:
    return Sweep(
        parameters=parameters,
        units=units,
        conditions=tuple(conditions),
        points=np.repeat(np.reshape(points, (-1, len(parameters))), len(conditions), axis=0).astype(float),
        condition=np.tile(np.arange(len(conditions)), len(rollouts) // len(conditions)),
        rollouts=tuple(rollouts),
    )


def smooth(threshold: float = np.inf, failed: int = -1) -> Sweep:
    masses = [0.0, 20.0, 40.0, 60.0]
    return sweep(masses, [rollout(m / 60 * np.sin(TIMES), threshold, failed=i == failed) for i, m in enumerate(masses)])


def stepped() -> Sweep:
    """Tips over at (mass 40: 1.0 s, mass 60: 0.5 s), and not below."""
    steps = [9.0, 9.0, 1.0, 0.5]
    return sweep([0, 20, 40, 60], [rollout((step <= TIMES).astype(float), 0.9) for step in steps])


def marked(axes: Axes, gid: str) -> list[Line2D]:
    return [line for line in axes.get_lines() if line.get_gid() == gid]


def xy(lines: list[Line2D]) -> np.ndarray:
    return np.concatenate([line.get_xydata() for line in lines])


def test_h_is_drawn_over_the_parameter_with_its_unit() -> None:
    data = smooth()
    left = plot_sweep(data).axes[0]
    np.testing.assert_array_equal(xy(marked(left, "h")), np.column_stack([data.points[:, 0], data.h]))
    assert left.get_xlabel() == "sim.sys.payload.mass [kg]"


def test_trajectories_and_t_star_are_those_of_the_rollouts() -> None:
    data = smooth()
    right = plot_sweep(data).axes[1]
    for line, result in zip(marked(right, "trajectory"), data.rollouts, strict=True):
        np.testing.assert_array_equal(line.get_xydata(), np.column_stack([result.times, result.quality]))
    np.testing.assert_array_equal(xy(marked(right, "t_star")), np.column_stack([data.t_star, data.h]))
    assert right.get_xlabel() == "time t [s]"


def test_trajectories_are_coloured_by_the_parameter() -> None:
    figure = plot_sweep(smooth())
    colors = [line.get_color() for line in marked(figure.axes[1], "trajectory")]
    assert colors[0] == pytest.approx((0.267, 0.005, 0.329, 1.0), abs=1e-3)
    assert colors[-1] == pytest.approx((0.993, 0.906, 0.144, 1.0), abs=1e-3)
    assert figure.axes[2].get_ylabel() == "sim.sys.payload.mass [kg]"


def test_boundary_interval_is_shaded_under_a_threshold() -> None:
    left = plot_sweep(smooth(threshold=0.5)).axes[0]
    (span,) = [patch for patch in left.patches if patch.get_gid() == "boundary"]
    assert (span.get_x(), span.get_x() + span.get_width()) == (20.0, 40.0)
    assert left.get_title() == "Safe up to 20 kg, not at 40 kg"
    assert [line.get_ydata()[0] for line in marked(left, "threshold")] == [0.5]


def test_without_threshold_nothing_is_shaded() -> None:
    left = plot_sweep(smooth()).axes[0]
    assert not left.patches
    assert not marked(left, "threshold")


def test_a_boundary_is_drawn_with_its_own_interval() -> None:
    data = smooth(threshold=0.5)
    boundary = replace(data.boundary(), lower=0.0, upper=60.0)
    left = boundary.plot().axes[0]
    (span,) = [patch for patch in left.patches if patch.get_gid() == "boundary"]
    assert (span.get_x(), span.get_x() + span.get_width()) == (0.0, 60.0)
    assert left.get_title() == "Safe up to 0 kg, not at 60 kg"
    with pytest.raises(ValueError, match="the boundary has no sweep to draw"):
        replace(boundary, sweep=None).plot()


def test_points_that_hold_are_filled_those_that_exceed_are_open() -> None:
    left = plot_sweep(smooth(threshold=0.5)).axes[0]
    np.testing.assert_array_equal(xy(marked(left, "not_exceeded"))[:, 0], [0.0, 20.0])
    assert marked(left, "h")[0].get_markerfacecolor() == "white"


def test_failed_point_is_a_cross_and_a_gap_in_h() -> None:
    left, right = plot_sweep(smooth(failed=1)).axes[:2]
    np.testing.assert_array_equal(xy(marked(left, "failed"))[:, 0], [20.0])
    assert np.isnan(marked(left, "h")[0].get_ydata()[1])
    np.testing.assert_allclose(xy(marked(right, "failed")), [[2.0, 20 / 60 * np.sin(2.0)]])
    assert len(marked(right, "t_star")) == 3


def test_conditions_have_lines_of_their_own() -> None:
    qualities = [mass / 60 * np.sin(TIMES) * scale for mass in (0, 30, 60) for scale in (1.0, 0.5)]
    conditions = [{"dps.gait.phase": 0.0}, {"dps.gait.phase": 0.5}]
    left = plot_sweep(sweep([0, 30, 60], [rollout(q) for q in qualities], conditions)).axes[0]
    first, second = marked(left, "h")
    np.testing.assert_allclose(second.get_ydata(), first.get_ydata() / 2)
    assert [first.get_label(), second.get_label()] == ["phase = 0", "phase = 0.5"]
    assert first.get_marker() != second.get_marker()


def test_two_valued_quality_is_drawn_as_bars_up_to_t_star() -> None:
    right = plot_sweep(stepped()).axes[1]
    np.testing.assert_allclose(
        [line.get_xydata()[1] for line in marked(right, "bar")], [[2, 0], [2, 20], [1, 40], [0.5, 60]]
    )
    np.testing.assert_allclose(xy(marked(right, "t_star")), [[1.0, 40.0], [0.5, 60.0]])
    assert right.get_ylabel() == "sim.sys.payload.mass [kg]"


def landscape(conditions: int = 1) -> tuple[Sweep, np.ndarray]:
    points = np.array([[m, f] for m in (0.0, 30.0, 60.0) for f in (0.0, 0.5)])
    h = np.array([0.0, 1.0, 2.0, 3.0, 5.0, 4.0])
    results = [rollout(np.full(3, value) / (1 + c)) for value in h for c in range(conditions)]
    return sweep(points, results, [{}] * conditions, (MASS, FRICTION), ("kg", "1")), h


@pytest.mark.parametrize("conditions", [1, 2])
def test_landscape_is_the_worst_h_with_the_best_point(conditions: int) -> None:
    data, h = landscape(conditions)
    axes = plot_sweep(data).axes[0]
    (mesh,) = [c for c in axes.collections if c.get_gid() == "h"]
    np.testing.assert_allclose(mesh.get_array(), h.reshape(3, 2).T / conditions)
    np.testing.assert_array_equal(xy(marked(axes, "best")), [[60.0, 0.0]])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("sim.sys.payload.mass [kg]", "sim.env.ground.friction")


def test_cells_of_a_logarithmic_parameter_end_at_geometric_means() -> None:
    parameters = (Parameter("x", 1.0, 100.0, log=True), FRICTION)
    points = np.array([[x, y] for x in (1.0, 10.0, 100.0) for y in (0.2, 0.8)])
    results = [rollout(np.full(3, value)) for value in range(6)]
    axes = plot_sweep(sweep(points, results, parameters=parameters, units=("1", "1"))).axes[0]
    (mesh,) = [c for c in axes.collections if c.get_gid() == "h"]
    corners = mesh.get_coordinates()
    np.testing.assert_allclose(corners[0, :, 0], np.sqrt([0.1, 10.0, 1e3, 1e5]))
    np.testing.assert_allclose(corners[:, 0, 1], [-0.1, 0.5, 1.1])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("failed", [(), (1, 4)])
def test_failed_points_of_a_landscape_are_crosses(failed: tuple[int, ...]) -> None:
    points = [(m, f) for m in (0.0, 30.0, 60.0) for f in (0.2, 0.8)]
    rollouts = [rollout(m / 60 * np.sin(TIMES) + f, failed=i in failed) for i, (m, f) in enumerate(points)]
    axes = plot_sweep(sweep(points, rollouts, parameters=(MASS, FRICTION), units=("kg", "1"))).axes[0]
    crosses = [tuple(point) for line in marked(axes, "failed") for point in line.get_xydata()]
    assert crosses == [points[i] for i in failed]
    assert len(marked(axes, "failed")) == (1 if failed else 0)


def test_points_off_a_grid_are_drawn_where_they_are() -> None:
    points = np.array([[1.0, 0.1], [2.0, 0.7], [5.0, 0.4]])
    results = [rollout(np.full(2, value)) for value in (1.0, 3.0, 2.0)]
    axes = plot_sweep(sweep(points, results, ({},), (MASS, FRICTION), ("kg", "1"))).axes[0]
    (scatter,) = [c for c in axes.collections if c.get_gid() == "h"]
    np.testing.assert_array_equal(scatter.get_offsets(), points)
    np.testing.assert_array_equal(scatter.get_array(), [1.0, 3.0, 2.0])


def test_three_parameters_are_refused() -> None:
    data = sweep(np.zeros((1, 3)), [rollout(TIMES)], ({},), (MASS, FRICTION, Parameter("x", 0, 1)), ("kg", "1", "m"))
    with pytest.raises(ValueError, match=r"one or two parameters can be drawn, not over 3 \(sim.sys.payload.mass"):
        plot_sweep(data)


def test_sweep_without_rollouts_is_refused() -> None:
    with pytest.raises(ValueError, match="no finished rollouts"):
        plot_sweep(sweep(np.zeros((0, 1)), []))


def test_figure_5_has_trajectories_threshold_g1_and_t_star() -> None:
    results = [rollout(0.4 * TIMES, 0.5, mass=1.0), rollout(0.2 * TIMES, 0.5, mass=2.0)]
    axes = plot_quality(results).axes[0]
    for line, result in zip(marked(axes, "trajectory"), results, strict=True):
        np.testing.assert_array_equal(line.get_ydata(), result.quality)
    np.testing.assert_allclose(xy(marked(axes, "t_star")), [[1.3, 0.52], [2.0, 0.4]])
    np.testing.assert_allclose(xy(marked(axes, "G1")), [[1.3, 0.52]])
    assert [line.get_ydata()[0] for line in marked(axes, "threshold")] == [0.5]
    assert [line.get_label() for line in marked(axes, "trajectory")] == ["mass = 1", "mass = 2"]


def test_two_valued_qualities_have_a_row_each() -> None:
    axes = plot_quality(stepped().rollouts).axes[0]
    np.testing.assert_allclose(xy(marked(axes, "t_star")), [[1.0, 2.0], [0.5, 3.0]])


def test_quality_of_no_rollout_is_refused() -> None:
    without = replace(rollout(TIMES), times=np.zeros(0), quality=np.zeros(0))
    for rollouts in ([], [rollout(TIMES), without], [without]):
        with pytest.raises(ValueError, match="at least one sample"):
            plot_quality(rollouts)


@pytest.mark.slow
def test_notebook_shows_the_figure_once() -> None:
    code = (
        "import sys; from tests.visualization.test_plots import smooth, plot_sweep; figure = plot_sweep(smooth());"
        "assert 'matplotlib.pyplot' not in sys.modules;"
        "from IPython.core.formatters import DisplayFormatter; import matplotlib.pyplot as plt;"
        "data, _ = DisplayFormatter().format(figure); print(plt.get_fignums(), data['image/png'][1:4])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["[]", "b'PNG'"]


def of_cost(cost: np.ndarray, threshold: float = np.inf, **parameters: float) -> RolloutResult:
    """A rollout as a runner returns it of a cost: the trajectory is 1 / (1 + cost)."""
    below = np.flatnonzero(cost < (threshold if np.isfinite(threshold) else -1.0))
    best = below[0] if below.size else int(np.argmin(cost))
    return RolloutResult(
        parameters=parameters,
        end="horizon",
        times=TIMES,
        quality=1.0 / (1.0 + cost),
        t_star=TIMES[best],
        h=1.0 / (1.0 + cost[best]),
        value=cost[best],
        threshold=1.0 / (1.0 + threshold) if np.isfinite(threshold) else np.inf,
        exceedances=TIMES[below[:1]],
    )


COSTS = [40.0 - 10.0 * TIMES, 30.0 + 5.0 * TIMES]


def test_a_cost_is_drawn_as_a_cost_with_its_unit() -> None:
    def effort(x: float) -> float:
        return x

    axes = plot_quality(
        [of_cost(COSTS[0], 25.0, mass=1.0)], quality=Quality(effort, "x", minimize=True, unit="J")
    ).axes[0]
    (line,) = marked(axes, "trajectory")
    np.testing.assert_allclose(line.get_ydata(), COSTS[0], rtol=1e-12)
    np.testing.assert_allclose(xy(marked(axes, "t_star")), [[1.6, 24.0]])
    assert [line.get_ydata()[0] for line in marked(axes, "threshold")] == pytest.approx([25.0])
    assert axes.get_ylabel() == "effort: cost c(s⁰, t) [J]"
    assert "c_m = 25" in [text.get_text() for text in axes.get_legend().get_texts()]


def test_a_sweep_of_a_cost_is_drawn_as_costs() -> None:
    one = replace(sweep([0, 20], [of_cost(cost) for cost in COSTS]), minimize=(True,))
    left, right = plot_sweep(one).axes[:2]
    (line,) = marked(left, "h")
    np.testing.assert_allclose(line.get_ydata(), [20.0, 30.0])
    assert left.get_ylabel() == "cost c(s⁰, t*)"
    for line, cost in zip(marked(right, "trajectory"), COSTS, strict=True):
        np.testing.assert_allclose(line.get_ydata(), cost, rtol=1e-12)


def test_the_worst_cost_of_several_conditions_is_the_largest() -> None:
    rollouts = [of_cost(cost) for cost in [*COSTS, COSTS[0], COSTS[0]]]
    grid = sweep([[0, 0], [1, 0]], rollouts, conditions=({}, {}), parameters=(MASS, FRICTION), units=("kg", ""))
    axes = plot_sweep(replace(grid, minimize=(True,))).axes[0]
    (points,) = [artist for artist in axes.collections if artist.get_gid() == "h"]
    np.testing.assert_allclose(points.get_array(), [30.0, 20.0])


def test_a_rollout_of_a_cost_shows_the_cost_in_a_notebook() -> None:
    problem = pendulum_problem()
    shown = problem.rollout([0.5, 0.0])
    (line,) = marked(shown.plot().axes[0], "trajectory")
    theta = problem.rollout([0.5, 0.0], record=[THETA]).record[THETA]
    np.testing.assert_allclose(line.get_ydata(), np.abs(theta - 0.3), rtol=1e-9)
    assert shown.plot().axes[0].get_ylabel() == "gap: cost c(s⁰, t)"
