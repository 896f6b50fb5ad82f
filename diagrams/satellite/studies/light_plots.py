"""The picture of application O3: the front of the screening, the judgement and the sensitivities."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vtbdrake.visualization.plots import Picture, finish
from vtbdrake.visualization.study_plots import BEST
from vtbdrake_diagrams.satellite.studies.grips import FAILURE
from vtbdrake_diagrams.satellite.studies.light_answer import TELLING, LightingAnswer
from vtbdrake_diagrams.satellite.studies.light_cases import (
    BY_HAND,
    LIGHTS,
    OTHER_LIGHTS,
    PARAMETERS,
    TODAY,
    UNFINISHED,
    VARIED_ON,
    short,
)


def plot_answer(answer: LightingAnswer) -> Figure:
    """Draw the front of the screening, the judgement under each light, and the sensitivities if there are any."""
    pictures = [_draw_front, _draw_judgement, *([_draw_sensitivities] if answer.telling else [])]
    figure = Picture(5.0 * len(pictures), 4.6)
    for axes, draw in zip(figure.subplots(1, len(pictures)), pictures, strict=True):
        draw(axes, answer)
        finish(axes)
    return figure


def _draw_front(axes: Axes, answer: LightingAnswer) -> None:
    screening = answer.screening
    time, error = screening.costs[:, 0], 1e3 * screening.costs[:, 1]
    axes.plot(time, error, "o", color="0.6", label="candidates")
    front = sorted((time[k], error[k]) for k, v in enumerate(screening.candidates) if v in screening.front)
    axes.plot(*np.array(front).T, drawstyle="steps-post", color="black", lw=1.0, label="front")
    for number, (name, values) in enumerate({**BY_HAND, "choice": answer.choice}.items()):
        if values in screening.candidates:
            k = screening.candidates.index(values)
            is_choice = name == "choice"
            color, marker, size = (BEST, "*", 14.0) if is_choice else (f"C{number}", "s", 7.0)
            axes.plot(time[k], error[k], marker, color=color, ms=size, label=name)
    axes.set(xlabel="mean time to grip, 60 s for a failure [s]", ylabel="mean error of the bar [mm]")
    axes.set_title(f"screening: {len(screening.candidates)} candidates, each light once", fontsize="small")
    axes.legend(fontsize="x-small")


def _draw_judgement(axes: Axes, answer: LightingAnswer) -> None:
    lights = [*LIGHTS, *OTHER_LIGHTS]
    styles = {"today": (TODAY, -0.12, "o", "C0"), "choice": (answer.choice, 0.12, "*", BEST)}
    for name, (values, offset, marker, color) in styles.items():
        spots = [(lights.index(case.light) + offset, answer.captures[values, case].time) for case in answer.judged]
        axes.plot(*np.reshape(spots, (-1, 2)).T, marker, color=color, alpha=0.7, label=name)
    axes.axhline(FAILURE, color="0.5", ls=":", lw=1.0)
    axes.set_xticks(range(len(lights)), [light.replace(", ", ",\n") for light in lights], fontsize="xx-small")
    axes.set(ylabel="time to grip, 60 s for a failure [s]", ylim=(0.0, 1.1 * UNFINISHED))
    axes.set_title(f"judgement: {len(answer.judged)} other starts", fontsize="small")
    axes.legend(fontsize="x-small", loc="lower right")


def _draw_sensitivities(axes: Axes, answer: LightingAnswer) -> None:
    rows, width = np.arange(len(PARAMETERS)), 0.8 / len(VARIED_ON)
    for number, case in enumerate(VARIED_ON):
        before = answer.captures[TODAY, case].time
        changes = [
            captures[case].time - before if case in captures else 0.0 for captures in answer.sensitivities.values()
        ]
        axes.barh(rows + (number - 0.5) * width, changes, width, label=f"{case.light}, from {before:.1f} s")
    for limit in (-TELLING, TELLING):
        axes.axvline(limit, color="black", ls=":", lw=1.0)
    labels = [f"{short(p)} {today:g} to {p.upper:g}" for p, today in zip(PARAMETERS, TODAY, strict=True)]
    axes.set_yticks(rows, labels, fontsize="x-small")
    axes.set(xlabel="later by [s]", ylim=(len(rows) - 0.5, -0.5))
    axes.set_title("one parameter at the upper end of its range", fontsize="small")
    axes.legend(fontsize="x-small")
