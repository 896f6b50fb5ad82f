"""The result of a calibration: numbers with their uncertainty and their verdicts, and the scenario that has them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vtbdrake import upper_layers
from vtbdrake.calibration.filtering import Noise
from vtbdrake.calibration.fisher import Information
from vtbdrake.calibration.fit_curves import FitCurves
from vtbdrake.calibration.report_page import save_page
from vtbdrake.common.argument_checks import counted
from vtbdrake.testbed import Scenario
from vtbdrake.testbed.pedigree import Number, Posterior

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# A hold-out that fits worse by this factor is called worse; a test of significance rejects any real model.
WORSE = 1.3


class Verdict(StrEnum):
    """The outcome of a calibration, for one parameter."""

    ACCEPTED = "accepted"
    DISCREPANT = "discrepant"  # the model does not explain the recordings: innovations are coloured, a hold-out worse
    NOT_IDENTIFIABLE = "not identifiable"  # these recordings do not tell it apart from others
    AT_BOUND = "at a bound"
    NO_EVIDENCE = "no evidence"  # the start explains the segments that were kept back as well


@dataclass(frozen=True, eq=False)
class Calibrated:
    """One calibrated number.

    Attributes:
        address: Its address.
        start: Its value in the scenario.
        value: Its estimate.
        deviation: Its standard deviation, by the sandwich estimator over blocks of 0.2 s. If the model explains the
            recordings, it is widened by what a term would change that the model may still lack.
        lower, upper: Its interval of 95 %, within its range. At a bound it is the profile of the likelihood, one-sided.
        verdict: Whether it may be used.
    """

    address: str
    start: float
    value: float
    deviation: float
    lower: float
    upper: float
    verdict: Verdict


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of `calibrate`.

    Attributes:
        scenario: The calibrated scenario, whose testbeds begin with the estimates: all of them, as those that are not
            identifiable are right together. Its pedigree says so, and `Scenario.save` writes it.
        parameters: The results, by address. An `Inertia` appears as mass, centre of mass and moments.
        combinations: Combinations of parameters that the recordings do not determine, as sentences.
        noise: The noise that explains the innovations; None where there are none.
        fit, holdout: Root mean square of the whitened innovations (1 is expected) in the segments of the fit, and in
            those that were kept back.
        correlation: The largest autocorrelation of the whitened innovations at the first ten lags, of any joint.
        reasons: Why the model is discrepant, or there is no evidence, as sentences.
        segments: Number of segments of the fit.
        sources: The recordings.
        remarks: What the checks of the recordings have noticed, as sentences.
        information: What the recordings tell about the parameters, as far as the model holds.
        curves: The recordings beside the calibrated model, for `plot`.
    """

    scenario: Scenario
    parameters: Mapping[str, Calibrated]
    combinations: tuple[str, ...]
    noise: Noise | None
    fit: float
    holdout: float
    correlation: float
    reasons: tuple[str, ...]
    segments: int
    sources: tuple[str, ...]
    remarks: tuple[str, ...] = ()
    information: Information | None = None
    curves: FitCurves | None = None

    @property
    def accepted(self) -> bool:
        """Return whether every parameter is accepted."""
        return all(each.verdict == Verdict.ACCEPTED for each in self.parameters.values())

    @property
    def values(self) -> dict[str, float]:
        """Return the estimates by address, for `VirtualTestbed.write`; those that are not identifiable are left out."""
        return {
            address: each.value for address, each in self.parameters.items() if each.verdict != Verdict.NOT_IDENTIFIABLE
        }

    def __str__(self) -> str:
        width = max(len(address) for address in self.parameters)
        lines = [
            self.summary,
            f"{'':{width}}       start       value   deviation   interval of 95 %",
        ]
        for each in self.parameters.values():
            lines.append(
                f"{each.address:{width}}{each.start:12.5g}{each.value:12.5g}{each.deviation:12.2g}   "
                f"[{each.lower:.5g}, {each.upper:.5g}] {each.verdict}"
            )
        return "\n".join([*lines, *self.reasons, *self.combinations, *self.remarks])

    @property
    def summary(self) -> str:
        """Return the recordings and the innovations in a line."""
        return (
            f"{counted(len(self.sources), 'recording')}, {counted(self.segments, 'segment')}: innovations "
            f"{self.fit:.3g} (hold-out {self.holdout:.3g}, 1 is expected), largest autocorrelation "
            f"{self.correlation:.2g}"
        )

    def _repr_html_(self) -> str:
        return upper_layers.calibration_html(self)

    def plot(self) -> Figure:
        """Return a figure of each joint: torques beside those that the model needs, and the filter's errors.

        Raises:
            ValueError: The calibration is one by rollouts, which has no such curves.
        """
        return upper_layers.plot_calibration(self)

    def save_html(self, path: str | os.PathLike[str]) -> None:
        """Write one HTML file with the numbers, their verdicts, and plots."""
        save_page(path, "Calibration", self._repr_html_())


def calibrated_scenario(
    scenario: Scenario,
    results: Mapping[str, Calibrated],
    posterior: Posterior,
    *,
    logs: Mapping[str, str],
    reasons: Sequence[str],
) -> Scenario:
    """Return the scenario with the estimates, and their pedigree.

    Args:
        scenario: The scenario that was calibrated; it is left as it is.
        results: The estimates, by address.
        posterior: The joint distribution of the parameters, for the pedigree.
        logs: Digests of the recordings by name, for the pedigree.
        reasons: Why the model is discrepant, or there is no evidence, as sentences.
    """
    calibrated = scenario.with_values({address: each.value for address, each in results.items()})
    pedigree = calibrated.pedigree
    for address, each in results.items():
        value = pedigree.numbers[address].value if address in pedigree.numbers else None
        number = Number(source="calibrated", value=value, note=str(each.verdict))
        if each.verdict != Verdict.NOT_IDENTIFIABLE:  # Its deviation is that with combinations held.
            number = replace(number, deviation=each.deviation, lower=each.lower, upper=each.upper)
        pedigree.numbers[address] = number
    pedigree.posterior, pedigree.logs, pedigree.reasons = posterior, dict(logs), list(reasons)
    return calibrated


def kept_back(count: int, share: float) -> NDArray[np.bool]:
    """Return a mask (count,) of the parts that are kept back, spread over all; one at least, if there are several.

    Args:
        count: Number of parts.
        share: Share of the parts that is kept back, rounded to whole parts; at least one part is left.
    """
    number = min(max(round(share * count), 1), count - 1)
    held_back = np.zeros(count, bool)
    held_back[np.linspace(0, count - 1, number + 2)[1:-1].astype(int) if number else []] = True
    return held_back
