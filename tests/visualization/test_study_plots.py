"""Plots of studies show their numbers: drawn data are compared with points that are stated."""

import subprocess
import sys
from math import inf, nan

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.cbook import STEP_LOOKUP_MAP
from matplotlib.figure import Figure

from tests.optimization.recorded import point, recorded
from tests.optimization.studies import RATE, THETA, pendulum_problem
from vtbdrake.optimization import Choice, Parameter, Study
from vtbdrake.visualization.study_plots import (
    plot_history,
    plot_importances,
    plot_landscape,
    plot_pareto,
    plot_slices,
)

PERIOD = Parameter("dps.period", 0.5, 4.0)
FRICTION = Parameter("sim.ground.friction", 1e-3, 1.0, log=True)
LEGS = Parameter("scenario.legs", 4, 8, integer=True)
TERRAIN = Choice("scenario.terrain", ["flat", "stairs", True])
SPEED = {"speed": "maximize"}


def drawn(axes: Axes, gid: str) -> np.ndarray:
    """The points of what is drawn under a name, shape (n, 2)."""
    lines = [line.get_xydata() for line in axes.get_lines() if line.get_gid() == gid]
    return np.concatenate(
        [np.empty((0, 2)), *lines, *(c.get_offsets() for c in axes.collections if c.get_gid() == gid)]
    )


def legend(figure: Figure) -> list[str]:
    return [
        text.get_text() for box in (*figure.legends, figure.axes[0].get_legend()) if box for text in box.get_texts()
    ]


def one_of_each(**more: object) -> Study:
    """Kept: 1, 3, 2; then one that breaks a constraint, one dropped at 5, one dropped without a bound, one failed."""
    points = [
        point((1.0,), 1.0, violations=(-1.0,)),
        point((2.0,), 3.0, violations=(0.0,), method="CMA-ES"),
        point((3.0,), 2.0, violations=(-1.0,), method="CMA-ES"),
        point((3.5,), 9.0, violations=(0.1,)),
        point((3.6,), 5.0, violations=(-1.0,), exact=False),
        point((3.7,), inf, violations=(-1.0,), exact=False),
        point((3.8,), violations=(nan,)),
    ]
    return recorded([PERIOD], points, **{"qualities": SPEED, "units": ["s"], **more})


# -- history


def test_history_shows_every_point_by_what_is_known_of_it():
    axes = plot_history(one_of_each()).axes[0]
    np.testing.assert_array_equal(drawn(axes, "kept"), [[0, 1], [1, 3], [2, 2]])
    np.testing.assert_array_equal(drawn(axes, "broken"), [[3, 9]])
    np.testing.assert_array_equal(drawn(axes, "dropped"), [[4, 5]])
    np.testing.assert_array_equal(drawn(axes, "unbounded")[:, 0], [5])
    np.testing.assert_array_equal(drawn(axes, "failed")[:, 0], [6])


def test_best_so_far_is_monotonic():
    rising, falling = plot_history(one_of_each()), plot_history(one_of_each(qualities={"energy": "minimize"}))
    np.testing.assert_array_equal(drawn(rising.axes[0], "best so far"), [[0, 1], [1, 3], [2, 3], [6, 3]])
    np.testing.assert_array_equal(drawn(falling.axes[0], "best so far"), [[0, 1], [1, 1], [2, 1], [6, 1]])


def test_point_that_has_been_forbidden_is_not_the_best_so_far():
    study = one_of_each()
    study.intervene("forbid", region={PERIOD.address: [1.5, 2.5]})
    np.testing.assert_array_equal(drawn(plot_history(study).axes[0], "best so far"), [[0, 1], [2, 2], [6, 2]])
    assert study.best.value == 2.0
    study.intervene("forbid", region={PERIOD.address: [0.5, 3.2]})
    history = plot_history(study)
    assert not drawn(history.axes[0], "best so far").size and "best so far" not in legend(history)


def test_history_counts_methods_and_what_went_wrong():
    assert legend(plot_history(one_of_each())) == [
        "TPE (5)",
        "CMA-ES (2)",
        "best so far",
        "breaks a constraint (1)",
        "dropped by racing: no better than this (2)",
        "simulation failed (1)",
    ]


def test_axis_label_names_cost_and_risk():
    study = one_of_each(qualities={"energy": "minimize"}, conditions=5, risk="CVaR(level=0.2)")
    assert plot_history(study).axes[0].get_ylabel() == "energy (cost, CVaR(level=0.2) of 5 conditions)"
    assert plot_history(one_of_each(conditions=3)).axes[0].get_ylabel() == "speed (worst of 3 conditions)"


def test_every_quality_has_a_history():
    study = recorded(
        [PERIOD],
        [point((1.0,), 1.0, 5.0), point((2.0,), 2.0, 7.0), point((3.0,), 0.0, 2.0)],
        qualities={"speed": "maximize", "energy": "minimize"},
    )
    speed, energy = plot_history(study).axes
    np.testing.assert_array_equal(drawn(speed, "best so far")[:3, 1], [1, 2, 2])
    np.testing.assert_array_equal(drawn(energy, "best so far")[:3, 1], [5, 5, 2])


# -- slices


def mixed() -> Study:
    at = [(1.0, 0.001, 4, "flat"), (2.0, 0.1, 8, True), (3.0, 1.0, 5, "stairs")]
    units = ["s", "1", "", ""]
    return recorded(
        [PERIOD, FRICTION, LEGS, TERRAIN],
        [point(a, v) for a, v in zip(at, (1.0, 3.0, 2.0), strict=True)],
        qualities=SPEED,
        units=units,
    )


def test_slices_show_numbers_logarithms_integers_and_options():
    period, friction, legs, terrain = plot_slices(mixed()).axes[:4]
    np.testing.assert_array_equal(drawn(period, "kept"), [[1, 1], [2, 3], [3, 2]])
    np.testing.assert_array_equal(drawn(friction, "kept")[:, 0], [0.001, 0.1, 1.0])
    np.testing.assert_array_equal(drawn(legs, "kept")[:, 0], [4, 8, 5])
    np.testing.assert_array_equal(drawn(terrain, "kept")[:, 0], [0, 2, 1])
    assert [axes.get_xscale() for axes in (period, friction)] == ["linear", "log"]
    assert all(float(tick).is_integer() for tick in legs.get_xticks())
    assert [tick.get_text() for tick in terrain.get_xticklabels()] == ["flat", "stairs", "True"]
    labels = [axes.get_xlabel() for axes in (period, friction, legs, terrain)]
    assert labels == ["dps.period [s]", "sim.ground.friction", "scenario.legs", "scenario.terrain"]


def test_slices_mark_the_best_and_colour_by_order():
    axes = plot_slices(mixed()).axes[0]
    np.testing.assert_array_equal(drawn(axes, "best"), [[2, 3]])
    (scatter,) = [c for c in axes.collections if c.get_gid() == "kept"]
    np.testing.assert_array_equal(scatter.get_array(), [0, 1, 2])


def test_many_parameters_with_long_addresses_fit(recwarn):
    space = [Parameter(f"sim.sys.climber.left_arm_{k}.damping_coefficient", 0.0, 1.0) for k in range(6)]
    figure = plot_slices(recorded(space, [point((0.1,) * 6, 1.0), point((0.9,) * 6, 0.0)], qualities=SPEED))
    figure.canvas.draw()
    assert not recwarn.list
    boxes = [axes.xaxis.label.get_window_extent() for axes in figure.axes[:6]]
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


# -- landscape


def grid() -> tuple[Study, np.ndarray]:
    xs, ys = [0.5, 1.0, 2.0], [0.001, 0.01, 0.1, 1.0]
    h = np.arange(12.0).reshape(3, 4)
    points = [point((x, y), h[i, j]) for i, x in enumerate(xs) for j, y in enumerate(ys)]
    points[5] = point((1.0, 0.01))
    h[1, 1] = nan
    return recorded([PERIOD, FRICTION], points[::-1], qualities=SPEED, units=["s", "1"]), h


def mesh(axes: Axes):
    (found,) = [c for c in axes.collections if c.get_gid() == "h"]
    return found


def test_a_grid_is_an_image_with_a_hole_where_it_failed():
    study, h = grid()
    axes = plot_landscape(study).axes[0]
    np.testing.assert_array_equal(mesh(axes).get_array().filled(nan), h.T)
    np.testing.assert_array_equal(drawn(axes, "failed"), [[1.0, 0.01]])
    np.testing.assert_array_equal(drawn(axes, "best"), [[2.0, 1.0]])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("dps.period [s]", "sim.ground.friction")
    assert legend(axes.figure) == ["s⁰* = [2, 1], speed = 11", "simulation failed (1)"]


def test_cells_of_a_logarithmic_parameter_lie_around_their_points():
    corners = mesh(plot_landscape(grid()[0]).axes[0]).get_coordinates()
    np.testing.assert_allclose(corners[:, 0, 1], 10.0 ** np.array([-3.5, -2.5, -1.5, -0.5, 0.5]))
    np.testing.assert_allclose(corners[0, :, 0], [0.25, 0.75, 1.5, 2.5])


def test_points_off_a_grid_are_coloured_between_contours():
    at = [(0.6, 0.002), (3.0, 0.005), (1.0, 0.5), (3.5, 0.9), (2.0, 0.05)]
    axes = plot_landscape(
        recorded([PERIOD, FRICTION], [point(a, k, violations=(k - 3.5,)) for k, a in enumerate(at)], qualities=SPEED)
    ).axes[0]
    order = np.argsort(mesh(axes).get_array())
    np.testing.assert_array_equal(mesh(axes).get_offsets()[order], at)
    # One that breaks a constraint has a value, but is not the best.
    np.testing.assert_array_equal(drawn(axes, "broken"), at[4:])
    np.testing.assert_array_equal(drawn(axes, "best"), at[3:4])
    assert any(type(c).__name__ == "TriContourSet" for c in axes.collections)


@pytest.mark.parametrize(("direction", "expected"), [("maximize", [5.0, 3.0]), ("minimize", [1.0, 3.0])])
def test_where_more_varies_each_place_shows_its_best(direction, expected):
    at = [(1.0, 0.01, 4), (1.0, 0.01, 5), (1.0, 0.01, 6), (2.0, 0.5, 4)]
    study = recorded(
        [PERIOD, FRICTION, LEGS],
        [point(a, v) for a, v in zip(at, (1.0, 5.0, 2.0, 3.0), strict=True)] + [point((1.0, 0.01, 8))],
        qualities={"h": direction},
    )
    axes = plot_landscape(study, PERIOD.address, FRICTION.address).axes[0]
    order = np.argsort(mesh(axes).get_offsets()[:, 0])
    np.testing.assert_array_equal(mesh(axes).get_array()[order], expected)
    assert axes.get_title() == "at each place, the best over 1 other parameter"
    # One failure at a place where others did not fail says nothing about the place.
    assert not len(drawn(axes, "failed"))
    # Points that differ in more than these two are not interpolated.
    assert not any(type(c).__name__ == "TriContourSet" for c in axes.collections)


def test_of_equal_places_one_that_keeps_the_constraints_counts():
    points = [point((1.0, 4), 9.0, violations=(1.0,)), point((1.0, 5), 2.0, violations=(-1.0,)), point((2.0, 5), 1.0)]
    axes = plot_landscape(recorded([PERIOD, LEGS], points, qualities=SPEED), PERIOD.address).axes[0]
    np.testing.assert_array_equal(drawn(axes, "best"), [[1.0, 2.0]])
    np.testing.assert_array_equal(drawn(axes, "broken"), [[1.0, 9.0]])


def test_landscape_of_one_parameter_is_a_line():
    points = [point((x,), v) for x, v in [(3.0, 2.0), (1.0, 1.0), (2.0, 3.0)]]
    axes = plot_landscape(recorded([PERIOD], points, qualities=SPEED, units=["s"])).axes[0]
    np.testing.assert_array_equal(drawn(axes, "h"), [[1, 1], [2, 3], [3, 2]])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("dps.period [s]", "speed")


def test_the_line_over_one_of_several_is_the_best():
    study, h = grid()
    axes = plot_landscape(study, FRICTION.address).axes[0]
    np.testing.assert_array_equal(drawn(axes, "h"), np.column_stack([[0.001, 0.01, 0.1, 1.0], np.nanmax(h, axis=0)]))


def test_options_lie_side_by_side():
    axes = plot_landscape(mixed(), TERRAIN.address, PERIOD.address).axes[0]
    np.testing.assert_array_equal(np.sort(mesh(axes).get_offsets()[:, 0]), [0, 1, 2])
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["flat", "stairs", "True"]


@pytest.mark.parametrize(
    ("addresses", "message"),
    [
        ((), "over one or two different parameters, not over dps.period, sim.ground.friction, scenario.legs"),
        (("dps.period", "dps.period"), "over one or two different parameters"),
        (("dps.speed",), "dps.speed is no parameter of the study; those are dps.period, sim.ground.friction"),
    ],
)
def test_a_landscape_over_other_than_one_or_two_parameters_is_refused(addresses, message):
    with pytest.raises(ValueError, match=message):
        plot_landscape(mixed(), *addresses)


# -- Pareto front


def front_of(directions: list[str], rows: list[tuple[float, ...]]) -> Figure:
    qualities = {f"q{k}": direction for k, direction in enumerate(directions)}
    return plot_pareto(
        recorded([PERIOD], [point((1.0 + k / 9,), *row) for k, row in enumerate(rows)], qualities=qualities)
    )


@pytest.mark.parametrize(
    ("directions", "expected"),
    [
        (["maximize", "maximize"], [[1, 4], [4, 3]]),
        (["minimize", "minimize"], [[1, 4], [2, 1]]),
        (["maximize", "minimize"], [[2, 1], [4, 3]]),
    ],
)
def test_the_front_is_what_nothing_dominates(directions, expected):
    axes = front_of(directions, [(2, 1), (4, 3), (1, 4), (2, 4.5 if directions == ["minimize"] else 2)]).axes[0]
    np.testing.assert_array_equal(drawn(axes, "front"), expected)
    assert len(drawn(axes, "kept")) == 4


@pytest.mark.parametrize("first", ["maximize", "minimize"])
@pytest.mark.parametrize("second", ["maximize", "minimize"])
def test_no_point_lies_beyond_the_line_of_the_front(first, second):
    rows = [tuple(row) for row in np.random.default_rng(0).uniform(size=(60, 2))]
    figure = front_of([first, second], rows)
    (line,) = [line for line in figure.axes[0].get_lines() if line.get_gid() == "front"]
    steps = STEP_LOOKUP_MAP[line.get_drawstyle()](*line.get_xydata().T)
    signs = np.array([1.0 if d == "maximize" else -1.0 for d in (first, second)])
    corners = signs * np.transpose(steps)
    front = signs * line.get_xydata()
    # The corners between them are dominated by points of the front.
    assert all((corner <= front).all(axis=1).any() for corner in corners)


def test_three_qualities_are_drawn_pair_by_pair():
    figure = front_of(["maximize"] * 3, [(1, 2, 3), (3, 2, 1), (0, 0, 0)])
    assert [(a.get_xlabel(), a.get_ylabel()) for a in figure.axes] == [("q0", "q1"), ("q0", "q2"), ("q1", "q2")]
    np.testing.assert_array_equal(drawn(figure.axes[1], "front"), [[1, 3], [3, 1]])


@pytest.mark.parametrize("count", [1, 4])
def test_a_front_of_one_or_more_than_three_qualities_is_refused(count):
    with pytest.raises(ValueError, match=f"of two or three qualities, but the study has {count}: plot_"):
        front_of(["maximize"] * count, [(1.0,) * count])


# -- importances


def explained_by_one(direction: str) -> Study:
    """The value is the first parameter's, whatever the others are."""
    at = np.random.default_rng(1).uniform(size=(200, 3))
    space = [Parameter(name, 0.0, 1.0) for name in "abc"]
    return recorded(space, [point(tuple(x), x[0]) for x in at.tolist()], qualities={"h": direction})


@pytest.mark.parametrize("direction", ["maximize", "minimize"])
def test_the_parameter_that_explains_all_has_nearly_all_of_the_importance(direction, recwarn):
    axes = plot_importances(explained_by_one(direction)).axes[0]
    assert not recwarn.list
    shares = [bar.get_width() for bar in axes.patches]
    names = [tick.get_text() for tick in axes.get_yticklabels()]
    assert names[0] == "a" and shares[0] > 0.95
    assert sum(shares) == pytest.approx(1.0)
    assert [text.get_text() for text in axes.texts] == [f"{share:.1%}" for share in shares]


def test_every_quality_has_its_importances():
    at = np.random.default_rng(1).uniform(size=(200, 2)).tolist()
    study = recorded(
        [Parameter(name, 0.0, 1.0) for name in "ab"],
        [point((a, b), a, b) for a, b in at],
        qualities={"first": "maximize", "second": "minimize"},
    )
    first, second = plot_importances(study).axes
    assert [axes.get_yticklabels()[0].get_text() for axes in (first, second)] == ["a", "b"]


def test_importances_of_few_or_equal_points_are_refused():
    with pytest.raises(ValueError, match="at least 10 points with a value, but the study has 4"):
        plot_importances(one_of_each())
    level = recorded([PERIOD], [point((1.0 + k / 20,), 2.0) for k in range(20)], qualities=SPEED)
    with pytest.raises(ValueError, match="speed is 2 at all points"):
        plot_importances(level)


# -- all


@pytest.mark.parametrize("plot", [plot_history, plot_slices, plot_landscape, plot_pareto])
def test_a_study_without_points_is_refused(plot):
    with pytest.raises(ValueError, match="no judged points yet"):
        plot(recorded([PERIOD], [], qualities=SPEED))


@pytest.mark.parametrize("plot", [plot_history, plot_slices, plot_landscape])
def test_a_study_whose_every_point_failed_is_drawn(plot):
    axes = plot(recorded([PERIOD], [point((1.0,)), point((2.0,))], qualities=SPEED)).axes[0]
    assert len(drawn(axes, "failed")) == 2


def test_a_study_draws_itself():
    study = pendulum_problem().study(solver="sobol").run(rollouts=32, executor="serial", progress=False)
    np.testing.assert_array_equal(
        drawn(study.plot_history().axes[0], "kept")[:, 1], [trial.value for trial in study.trials]
    )
    assert study.plot_slices().axes[1].get_xlabel().replace("\n", "") == f"{RATE} [rad/s]"
    axes = study.plot_landscape().axes[0]
    np.testing.assert_array_equal(drawn(axes, "best"), [list(study.best.parameters.values())])
    assert axes.get_xlabel() == f"{THETA} [rad]"


@pytest.mark.slow
def test_no_window_is_opened():
    code = (
        "import sys; from tests.visualization.test_study_plots import one_of_each;"
        "one_of_each().plot_history(); assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
