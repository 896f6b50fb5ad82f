"""Application O3: which parameters of the robot are best under different lighting?

The docking camera alone leads the capture. What is decided are ten parameters of the robot: speeds, gains and
acceleration of its controller, the process noises of its filter, two settings of its marker detector and the exposure
of its camera. The lights are conditions: the sun in front of the target, where the servicer throws its shadow on it;
beside it; grazing its face; and behind it, where only a lamp on the camera helps. A candidate has two qualities: the
time until the fingers hold the bar, and how far the bar then is from where it is perceived.

The answer has four stages, and each capture of all of them is kept:

* **Screening.** A study with both qualities, of candidates by hand and of a Sobol design, in `SCREENED_ON`: every light
  once. It gives the front, and the best for each light alone.
* **Race.** The best of the screening and the constants that the robot has today are compared in `RACED_ON`, eight
  starts with each light twice, by the mean of the worst quarter (`RISK`). The error of the bar has a bound there. A
  candidate that can no longer win is dropped; what is left of the budget goes to candidates of another design.
* **Judgement.** The winner and today's constants, on `JUDGED_ON`: other starts, the same lights and two others.
* **Sensitivities.** One parameter after the other at the upper end of its range, in `VARIED_ON`: twice to four times
  today's constant, and nothing else.

All of this was fixed before the first capture. ``python -m vtbdrake_diagrams.satellite.studies.lighting --full``
simulates what is missing in ``lighting.json`` beside this module, and keeps each capture: it may be ended and
continued. Without ``--full`` the results are read. The row of the answers reads them, and simulates a tenth of the
captures again.

The problem is in ``light_cases.py`` beside this module, the captures that are kept in ``light_captures.py``, the stages
in ``light_campaign.py``, what they show in ``light_answer.py`` and ``light_plots.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.satellite.studies.grips import FAILURE
from vtbdrake_diagrams.satellite.studies.light_answer import CONFIDENCE, LightingAnswer, by_light
from vtbdrake_diagrams.satellite.studies.light_campaign import Campaign
from vtbdrake_diagrams.satellite.studies.light_captures import RESULTS, Capture, Key, Results, captures_again
from vtbdrake_diagrams.satellite.studies.light_cases import (
    BY_HAND,
    CANDIDATES,
    LIGHTS,
    OTHER_LIGHTS,
    PARAMETERS,
    SCREENED_ON,
    SEEDS,
    TODAY,
    short,
    text,
)
from vtbdrake_diagrams.satellite.studies.light_plots import plot_answer


def answer_lighting(
    captures: dict[Key, Capture],
    *,
    candidates: int = CANDIDATES,
    keep: Callable[[], Any] | None = None,
    echo: Callable[[str], Any] = lambda line: None,
) -> LightingAnswer:
    """Answer O3 from the captures so far; a missing one takes about ten seconds of processor time.

    Args:
        captures: The captures so far; new ones are added.
        candidates: The number of candidates of the screening.
        keep: Is called after each new capture; None: nothing is simulated, and the last two stages may be incomplete.
        echo: Gets a line for each new capture.

    Raises:
        KeptResultsError: Captures of screening or race are missing, and nothing is to be simulated.
    """
    campaign = Campaign(captures, keep=keep, echo=echo)
    screening = campaign.screen(candidates)
    race = campaign.race(screening)
    if keep is not None:
        campaign.judge(race.choice)
        campaign.vary()
    return LightingAnswer(captures, screening, race)


def lighting(full: bool) -> Answer:
    """Answer O3: which parameters of the robot are best under different lighting?

    The short version reads the kept captures. Both simulate a tenth of them again, drawn at random.
    """
    results = Results.read()
    captures, keep = results.captures, results.write if full else None
    answer = answer_lighting(captures, candidates=results.candidates, keep=keep)
    repetition = captures_again(captures)
    today, robust = (answer.of(values, answer.judged) for values in (TODAY, answer.choice))
    paid = "; ".join(
        f"{light} {now - time:.1f} s ({text(values)})" for light, (values, time, now) in answer.best_alone.items()
    )
    return Answer(
        id="O3",
        question="Which controller parameters are best under different lighting?",
        answer=f"{text(answer.choice)}; {answer.verdict}",
        unit="",
        interval=(answer.gain[0], answer.gain[2]) if len(answer.judged) > 1 else None,
        paper="none given",
        cases=f"{len(SEEDS)} starts, {len(LIGHTS)} lights: {len(answer.screening.candidates)} candidates screened, "
        f"{len(answer.race.candidates)} raced",
        held_out=f"{len(answer.judged)} other starts, the same lights and {len(OTHER_LIGHTS)} others",
        baseline=f"today's constants: {sum(not c.failed for c in today)} of {len(today)} grips, the choice "
        f"{sum(not c.failed for c in robust)}",
        refused=sum(capture.failed for capture in robust),
        holds=all(answer.claims.values()) and repetition.same,
        note=f"Interval: of {CONFIDENCE:.0%}, of the seconds won in the mean, a failure costs {FAILURE:g} s. "
        f"Today: {by_light(answer, TODAY, answer.judged)}. Choice: {by_light(answer, answer.choice, answer.judged)}. "
        f"What the choice pays against the best for each light alone: {paid}. {_sensitive(answer)} "
        + "; ".join(f"{claim}: {'yes' if true else 'NO'}" for claim, true in answer.claims.items())
        + f". {repetition}.",
    )


def _sensitive(answer: LightingAnswer) -> str:
    """Return in words which parameters matter, and how much."""
    if not answer.telling:
        return "Sensitivities: not simulated yet."
    words = [
        f"{short(p)} at {p.upper:g}: "
        + ", ".join(
            f"{case.light} "
            + ("failed" if c.failed else f"{c.time - answer.captures[TODAY, case].time:+.1f} s, {1e3 * c.error:.1f} mm")
            for case, c in answer.sensitivities[p.address].items()
        )
        for p in PARAMETERS
        if answer.telling.get(p.address)
    ]
    rest = [short(p) for p in PARAMETERS if not answer.telling.get(p.address, True)]
    return f"One parameter alone matters: {'; '.join(words) or 'none'}; not: {', '.join(rest) or 'none'}."


@click.command()
@click.option("--full", is_flag=True, help="Simulate what is missing first, and keep it.")
@click.option("--candidates", type=click.IntRange(len(BY_HAND) + 1), help="Screen as many, more than before.")
@click.option("--figure", default="lighting.png", help="File of the picture.", show_default=True)
def main(full: bool, candidates: int | None, figure: str) -> None:
    """Answer O3, and draw the answer."""
    results = Results.read() if RESULTS.exists() else Results()
    results.candidates = candidates or results.candidates
    answer = answer_lighting(
        results.captures,
        candidates=results.candidates,
        keep=results.write if full else None,
        echo=lambda line: click.echo(line, err=True),
    )
    for values, (time, error) in zip(answer.screening.candidates, answer.screening.costs, strict=True):
        front = ", on the front" if values in answer.screening.front else ""
        click.echo(f"screened: {time:.1f} s, {1e3 * error:.1f} mm{front}: {text(values)}")
        click.echo(f"  {by_light(answer, values, SCREENED_ON)}")
    for values, cost, exact in zip(answer.race.candidates, answer.race.costs, answer.race.exact, strict=True):
        click.echo(f"raced: {cost:.1f} s{'' if exact else ' at least, dropped'}: {text(values)}")
    for light, (values, time, now) in answer.best_alone.items():
        click.echo(f"best for {light} alone: {time:.1f} s, the choice {now:.1f} s: {text(values)}")
    click.echo(_sensitive(answer))
    for name, values in {"today": TODAY, "choice": answer.choice}.items():
        click.echo(f"judged, {name}: {by_light(answer, values, answer.judged)}")
    click.echo(f"{text(answer.choice)}; {answer.verdict}")
    click.echo("; ".join(f"{claim}: {true}" for claim, true in answer.claims.items()))
    plot_answer(answer).savefig(figure, dpi=110)


if __name__ == "__main__":
    main(prog_name="python -m vtbdrake_diagrams.satellite.studies.lighting")
