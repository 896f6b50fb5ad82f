"""Recorded arms and legs: fitted by inverse dynamics with a part of the recordings, and what that says of the rest.

``python -m vtbdrake_diagrams.recorded_arms.reality FOLDER`` prints it. FOLDER holds the folders of the recordings:
dfki_simple_pendulum, panda_gaz2019, figaroh, kuka_kr300 and go2_leg; see docs/reality_arms.md for their sources.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import click
import numpy as np
from matplotlib.figure import Figure

from vtbdrake.calibration import Regression, RegressionEquations, regress
from vtbdrake.common.arrays import Array
from vtbdrake_diagrams.recorded_arms import pendulum, subjects
from vtbdrake_diagrams.recorded_arms.subjects import Prediction, Subject

FRICTION = ("viscous", "coulomb", "rotor")


def fits(subject: Subject) -> tuple[Regression, Regression]:
    """Return the fit of the base parameters, and the one of bodies that can exist."""
    free = regress(subject.model, subject.fitted, block=subject.block)
    return free, regress(subject.model, subject.fitted, consistent=True, prior=subject.prior, block=subject.block)


def residuals(subject: Subject, predictions: Mapping[str, Prediction]) -> dict[str, Array]:
    """Return root mean squares by joint of what models leave of the torques that were held out, in N m."""

    def left(predict: Prediction) -> Array:
        errors = np.concatenate([predict(each) - each.tau for each in subject.held_out])
        each = np.sqrt(np.mean(errors**2, axis=0))
        return each if subject.joints is None else each[list(subject.joints)]

    return {name: left(predict) for name, predict in predictions.items()}


def compared(subject: Subject) -> dict[str, Array]:
    """Return the held-out residuals by joint of our two fits and of the published models, and of no model at all."""
    free, consistent = fits(subject)

    def nothing(each: RegressionEquations) -> Array:
        return np.broadcast_to(each.tau.mean(axis=0), each.tau.shape)

    models = {"torques themselves": nothing, "ours": free.torques, "ours, of real bodies": consistent.torques}
    if subject.published_saw_all:
        models["ours, fitted to all"] = regress(subject.model, (*subject.fitted, *subject.held_out)).torques
    return residuals(subject, {**models, **subject.published})


def relative(rows: Mapping[str, Array]) -> dict[str, float]:
    """Return one number by model: the root mean square over joints of residuals relative to the torques."""
    first = rows["torques themselves"]
    return {name: float(np.sqrt(np.mean((row / first) ** 2))) for name, row in rows.items()}


def scatter(subject: Subject) -> dict[str, float]:
    """Return the scatter from run to run of friction and rotors, relative to their means, median over the joints."""
    values: dict[str, list[Array]] = {}
    runs = [regress(subject.model, run, block=subject.block) for run in subject.runs]
    for name in runs[0].names:
        term = name.rsplit(".", 1)[-1]
        if term in FRICTION and " " not in name:
            values.setdefault(term, []).append(np.array([run.values[run.names.index(name)] for run in runs]))
    return {
        term: float(np.median([each.std(ddof=1) / abs(each.mean()) for each in lists]))
        for term, lists in values.items()
    }


def recorded_subjects(folder: Path) -> Iterator[Subject]:
    """Yield all subjects in a folder."""
    yield subjects.panda(folder / "panda_gaz2019")
    yield subjects.tx40(folder / "figaroh")
    yield subjects.tiago(folder / "figaroh")
    yield from subjects.kr300(folder / "kuka_kr300").values()
    yield from subjects.go2(folder / "go2_leg").values()


def draw(rows_by_subject: Mapping[str, Mapping[str, Array]], path: Path) -> None:
    """Draw the relative residuals of our fits and of published models."""
    figure = Figure(figsize=(7.0, 3.2), layout="constrained")
    axes = figure.add_subplot()
    for place, rows in enumerate(rows_by_subject.values()):
        shares = relative(rows)
        ours = shares.pop("ours, of real bodies")
        published = [share for name, share in shares.items() if not name.startswith(("torques", "ours"))]
        axes.bar(place - 0.2, 100.0 * ours, 0.4, color="tab:blue", label="" if place else "ours")
        axes.bar(place + 0.2, 100.0 * min(published), 0.4, color="tab:gray", label="" if place else "best published")
    axes.set_xticks(range(len(rows_by_subject)), [name.replace(", movement", "") for name in rows_by_subject])
    axes.tick_params("x", rotation=30)
    axes.set_ylabel("left of the torques\nof other movements, %")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=80)


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--figure", type=click.Path(dir_okay=False, path_type=Path), help="Where to draw the comparison.")
def main(folder: Path, figure: Path | None) -> None:
    """Fit the recorded arms and legs in FOLDER, and compare what is left of the torques of other movements."""
    pendulum.report(folder / "dfki_simple_pendulum")
    rows_by_subject = {}
    for subject in recorded_subjects(folder):
        rows = rows_by_subject[subject.name] = compared(subject)
        free = regress(subject.model, subject.fitted, block=subject.block)
        print(
            f"\n{subject.name}: {len(free.names)} base parameters, condition number {free.condition:.3g}; what is left "
            "of the torques of other movements, by joint in N m, and relative"
        )
        for (name, row), share in zip(rows.items(), relative(rows).values(), strict=True):
            print(f"  {name:26}" + "".join(f"{value:9.3f}" for value in row) + f"{100.0 * share:8.1f} %")
        spread = ", ".join(f"{term} {100.0 * value:.0f} %" for term, value in scatter(subject).items())
        print(f"  scatter from run to run ({len(subject.runs)}): {spread}")
    if figure is not None:
        draw(rows_by_subject, figure)


if __name__ == "__main__":
    main()
