"""The row of application O2: scan frequencies that suffice in approaches, and whether they guide captures, too."""

from __future__ import annotations

from math import isnan

import numpy as np

from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.satellite.studies.scan_frequency import (
    CONFIDENCE,
    DESKEWED,
    QUANTILE,
    RAW,
    TOLERANCE,
    FrequencyAnswer,
    Window,
    approaches_again,
    continue_campaign,
    not_decided,
    range_text,
    read_answer,
)
from vtbdrake_diagrams.satellite.studies.scanned_captures import (
    FREQUENCIES,
    SHARE,
    ScannedCaptures,
    captures_again,
    kept_captures,
)


def frequency(full: bool) -> Answer:
    """Answer O2: what scan frequency must the laser scanner have?

    Approaches and captures are read from files, and a tenth of each is simulated again. The long version simulates
    first what is missing of the approaches.
    """
    result, captures = read_answer(), ScannedCaptures(kept_captures())
    if full:
        result = continue_campaign(result)
    repetitions = approaches_again(result), captures_again()
    shared = result.everywhere
    windows = "; ".join(
        f"{kind}, {tumble:g} deg/s: {result.window(kind, tumble)}"
        for kind in (DESKEWED, RAW)
        for tumble in result.tumbles
    )
    claims = {
        "the median raw error is once to twice v / (2 f)": result.follows,
        "de-skewed, a lower frequency suffices": result.helps,
        f"what surely suffices guides {SHARE:.0%} of the captures to success, within the tolerance at the grip": (
            guides_captures(shared, captures)
        ),
    }
    no_window = [tumble for tumble in result.tumbles if isnan(result.window(DESKEWED, tumble).lower[1])]
    return Answer(
        id="O2",
        question="What scan frequency must the laser scanner have to measure the moving target accurately?",
        answer=f"de-skewed, {range_text(shared.lower[1], shared.upper[1])} at all tumble rates",
        unit="",
        interval=(shared.lower[0], shared.upper[2]),
        paper="none given",
        cases=f"at least {result.fewest} approaches with each of {len(result.errors)} kinds of scans, tumble rates and "
        "frequencies",
        held_out="",
        baseline=f"the same scans, raw: {_shared_raw(result)}",
        refused=len(no_window),
        holds=result.holds and all(claims.values()) and all(repetition.same for repetition in repetitions),
        note=f"Frequencies for which the error at the bar is below {1e3 * TOLERANCE:.1f} mm in {QUANTILE:.0%} of the "
        f"approaches, with confidence {CONFIDENCE:.0%}; the interval's ends surely do not suffice. {windows}. "
        f"{not_decided(result)}{captures.sentence}. {'. '.join(map(str, repetitions))}. "
        + "; ".join(f"{claim}: {'yes' if true else 'NO'}" for claim, true in claims.items())
        + ".",
    )


def guides_captures(surely: Window, captures: ScannedCaptures) -> bool:
    """Return whether each frequency that surely suffices, with de-skewed scans, guides captures, too.

    Args:
        surely: The window in approaches.
        captures: The captures; those at one such frequency, at least, must be there.
    """
    sure = [frequency for frequency in FREQUENCIES if surely.lower[2] <= frequency <= surely.upper[0]]
    return bool(sure) and all(captures.suffices(DESKEWED, frequency) for frequency in sure)


def _shared_raw(answer: FrequencyAnswer) -> str:
    """Return in words which frequencies suffice at all tumble rates with raw scans."""
    windows = [answer.window(RAW, tumble) for tumble in answer.tumbles]
    first, last = (np.array([getattr(w, end)[1] for w in windows]) for end in ("lower", "upper"))
    suffices = first.max() <= last.min()  # False if an end is NaN.
    return range_text(float(first.max()), float(last.min())) if suffices else "no frequency suffices"
