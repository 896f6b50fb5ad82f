"""The answer to application O3: what its captures show, and what must be true of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.stats import t as student

from vtbdrake_diagrams.satellite.studies.grips import FAILURE
from vtbdrake_diagrams.satellite.studies.light_campaign import Race, Screening
from vtbdrake_diagrams.satellite.studies.light_captures import Capture, Key
from vtbdrake_diagrams.satellite.studies.light_cases import (
    JUDGED_ON,
    OTHER_LIGHTS,
    PARAMETERS,
    SCREENED_ON,
    TODAY,
    VARIED,
    VARIED_ON,
    Case,
    Values,
)

ACCURACY = 0.006
"""The largest mean error of the perceived bar in any light, in m: half of what the supervisor allows the gripper to be
off, since that comes on top."""
TELLING = 0.5
"""The least difference of mean times that means anything, in s: the cost has a period of 0.2 s."""
FASTER = "faster than"
"""The comparison of the choice with today's constants if the interval of its gain is above 0, and reaches `TELLING`."""
AS_FAST = "as fast as"
"""The comparison if the interval of the gain is within `TELLING` about 0: then the parameters do not matter."""
TELLING_ERROR = 1e-3
"""The least difference of errors that means anything, in m: today's constants are about as far off."""
CONFIDENCE = 0.9
"""Confidence of the interval."""


@dataclass(frozen=True)
class LightingAnswer:
    """The answer to O3.

    Attributes:
        captures: All captures by candidate and case.
        screening: The result of the screening.
        race: The result of the race.
    """

    captures: Mapping[Key, Capture]
    screening: Screening
    race: Race

    @property
    def choice(self) -> Values:
        """Return the winner of the race."""
        return self.race.choice

    @cached_property
    def judged(self) -> tuple[Case, ...]:
        """Return the cases of the judgement that both today's constants and the choice were tried in."""
        tried = (TODAY, self.choice)
        return tuple(case for case in JUDGED_ON if all((values, case) in self.captures for values in tried))

    def of(self, values: Values, on: Sequence[Case], light: str = "") -> list[Capture]:
        """Return the captures of a candidate in some cases, by default under all lights."""
        return [self.captures[values, case] for case in on if light in ("", case.light)]

    @property
    def gain(self) -> tuple[float, float, float]:
        """Return by how much the choice is faster than today's constants where it is judged: (lower, mean, upper) in s.

        A failure costs `FAILURE`. The interval is Student's for pairs, with `CONFIDENCE`.
        """
        costs = np.array([[min(c.time, FAILURE) for c in self.of(v, self.judged)] for v in (TODAY, self.choice)])
        gains = costs[0] - costs[1]
        mean, n = float(gains.mean()), len(gains)
        half = float(student.ppf(0.5 + CONFIDENCE / 2.0, n - 1) * gains.std(ddof=1) / np.sqrt(n))
        return mean - half, mean, mean + half

    @property
    def comparison(self) -> str:
        """Return in words how the choice compares with today's constants where it is judged, by its `gain`."""
        if len(self.judged) < 2:
            return "not judged yet"
        lower, _, upper = self.gain
        if lower > -TELLING and upper < TELLING:
            return AS_FAST
        if lower > 0.0:
            return FASTER
        return "slower than" if upper < 0.0 else "not shown to be faster, slower or as fast as"

    @property
    def claims(self) -> dict[str, bool]:
        """Return what must be true of the judgement, with its truth."""
        lights = {case.light for case in self.judged}
        ends = {light: [self.of(v, self.judged, light) for v in (TODAY, self.choice)] for light in lights}
        errors = [mean_error(captures) for _, captures in ends.values()]
        return {
            "judged on 20 other starts and two other lights": len(self.judged) >= 20 and lights >= set(OTHER_LIGHTS),
            "no more failures than today in any light": all(
                sum(c.failed for c in now) <= sum(c.failed for c in before) for before, now in ends.values()
            ),
            f"the bar within {1e3 * ACCURACY:g} mm in the mean of every light": not any(e > ACCURACY for e in errors),
            f"faster than today, or as fast within {TELLING:g} s, with confidence": self.comparison
            in (FASTER, AS_FAST),
        }

    @property
    def holds(self) -> bool:
        """Return whether all `claims` are true."""
        return all(self.claims.values())

    @property
    def best_alone(self) -> dict[str, tuple[Values, float, float]]:
        """Return the fastest candidate of the screening under each light alone.

        With its time, and the time that the choice takes in the same case, both in s.
        """
        best = {}
        for case in SCREENED_ON:
            tried = [(c.time, c.error, v) for v in self.screening.candidates if (c := self.captures[v, case])]
            time, _, values = min(tried)
            best[case.light] = values, time, self.captures[self.choice, case].time
        return best

    @property
    def sensitivities(self) -> dict[str, dict[Case, Capture]]:
        """Return the captures with one parameter at the upper end of its range, by address and case.

        Those that were not simulated yet are missing.
        """
        return {
            parameter.address: {
                case: self.captures[values, case] for case in VARIED_ON if (values, case) in self.captures
            }
            for parameter, values in zip(PARAMETERS, VARIED, strict=True)
        }

    @property
    def telling(self) -> dict[str, bool]:
        """Return by address whether a parameter matters: whether its captures come out differently from today's.

        Later or earlier by more than `TELLING`, or with an error that differs by more than `TELLING_ERROR`.
        """
        return {
            address: any(
                abs(capture.time - self.captures[TODAY, case].time) > TELLING
                or abs(capture.error - self.captures[TODAY, case].error) > TELLING_ERROR
                for case, capture in captures.items()
            )
            for address, captures in self.sensitivities.items()
            if len(captures) == len(VARIED_ON)
        }

    @property
    def verdict(self) -> str:
        """Return in words what the choice is worth."""
        if self.choice == TODAY:
            return "no candidate is better than today's constants"
        if len(self.judged) < 2:
            return self.comparison
        lower, mean, upper = self.gain
        return f"{self.comparison} today's constants: {mean:.2f} s [{lower:.2f}, {upper:.2f}] faster in the mean"


def mean_error(captures: Sequence[Capture]) -> float:
    """Return the mean error of the captures that succeeded, in m; NaN if none did."""
    errors = [capture.error for capture in captures if not capture.failed]
    return float(np.mean(errors)) if errors else np.nan


def by_light(answer: LightingAnswer, values: Values, on: Sequence[Case]) -> str:
    """Return in words the captures of a candidate in some cases, by light."""
    parts = []
    for light in dict.fromkeys(case.light for case in on):
        captures = answer.of(values, on, light)
        times = [capture.time for capture in captures if not capture.failed]
        part = f"{light} {len(times)} of {len(captures)}"
        if times:
            part += f", {np.median(times):.1f} s, {1e3 * mean_error(captures):.1f} mm"
        parts.append(part)
    return "; ".join(parts)
