"""Reports of a campaign: a page for people, and JUnit's XML for servers of continuous integration."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from xml.etree import ElementTree

from vtbdrake.campaigns.campaign import Criterion, Rerun
from vtbdrake.campaigns.results import (
    ALL,
    COMPARED,
    ERROR,
    FAIL,
    INCOMPLETE,
    MET,
    MISSED,
    NOT_RUN,
    UNDECIDED,
    CampaignResult,
    CampaignRollout,
    Cell,
    PairedComparison,
    interval,
    least_rate,
)
from vtbdrake.common.failures import one_line, safe_text
from vtbdrake.common.summary_html import image_html
from vtbdrake.state.variables import with_unit

_MOST_DOTS = 400
"""The number of rollouts of a cell that are drawn as dots, at most."""
_MOST_NAMES = 20
"""The number of failed rollouts of a cell that are listed, at most."""
_WORDS = {
    MET: "met",
    MISSED: "missed",
    UNDECIDED: "undecided: more seeds would decide",
    INCOMPLETE: "not all rollouts were run yet",
}


@dataclass(frozen=True)
class Evidence:
    """What was kept of a failed rollout that was run again.

    Attributes:
        rerun: The rollout.
        log: The name of the file with its record, relative to the page; empty if there is none.
        animation: The name of its animation, relative to the page; empty if there is none.
        note: The reason why something is missing, or what differs from the campaign.
    """

    rerun: Rerun
    log: str = ""
    animation: str = ""
    note: str = ""


def limits_text(criterion: Criterion) -> str:
    """Return the limits and the required rate of a criterion in words."""
    if not criterion.is_limited:
        return "reported only"
    limits = [("at least", criterion.at_least), ("at most", criterion.at_most)]
    words = " and ".join(f"{word} {limit:g}" for word, limit in limits if limit is not None)
    words = with_unit(words, criterion.unit)
    where = " over all conditions" if criterion.over == "all" else ""
    if criterion.rate == 1.0:
        return f"{words}, in every rollout{where}"
    return f"{words}, in {criterion.rate:.4g} of the rollouts with {criterion.confidence:.4g} confidence{where}"


def passed_text(result: CampaignResult) -> str:
    """Return the number of rollouts that pass all criteria, in words."""
    return f"{result.passed} of {result.count} rollouts pass all their criteria"


def warning(result: CampaignResult) -> str:
    """Return a warning if something may make the rates meaningless, else an empty text."""
    if not (conditions := result.unvaried):
        return ""
    return (
        f"All seeds give the same numbers under: {', '.join(conditions)}. If they change nothing there, the rollouts "
        "are one trial, whatever their number, and rates and intervals say nothing."
    )


def cell_text(cell: Cell) -> str:
    """Return the rate of a cell with its interval, or the range of its numbers, in a few words."""
    if not cell.criterion.is_limited:
        return range_text(cell)
    errors = cell.statuses.count(ERROR)
    extra = f", {errors} failed" if errors else ""
    return f"{cell.passed}/{cell.count}{extra} {interval_text(cell)}"


def interval_text(cell: Cell) -> str:
    """Return the two-sided interval of the rate of a cell."""
    low, high = interval(cell.passed, cell.count, cell.criterion.confidence)
    return f"[{low:.3f}, {high:.3f}]"


def range_text(cell: Cell) -> str:
    """Return the range of the numbers of a cell with their unit, and their mean; empty without any."""
    numbers = cell.numbers
    if not numbers:
        return ""
    ends = list(dict.fromkeys(f"{number:.4g}" for number in (min(numbers), max(numbers))))
    words = with_unit(" to ".join(ends), cell.criterion.unit)
    return words if len(ends) == 1 else f"{words}, mean {fmean(numbers):.4g}"


def reason(cell: Cell, rollout: CampaignRollout) -> str:
    """Return the reason for which a rollout does not pass.

    Args:
        cell: The criterion by which the rollout is judged.
        rollout: A rollout that failed, or that does not pass the criterion.
    """
    if rollout.status(cell.name, cell.criterion) == ERROR:
        return f"failed: {one_line(rollout.message)}"
    return with_unit(f"{rollout.values[cell.name]:.6g}", cell.criterion.unit)


def failed_cells(result: CampaignResult) -> list[Cell]:
    """Return the judged cells that are not met and have rollouts that do not pass."""
    return [c for c in result.cells() if c.is_judged and c.verdict != MET and c.having(FAIL, ERROR)]


def junit_xml(result: CampaignResult, commands: Mapping[str, str]) -> str:
    """Return JUnit's XML: a test suite per condition, and one of all together, with a test case per judged criterion.

    Args:
        result: The results.
        commands: By the name of a rollout, the command that runs it again.
    """
    root = ElementTree.Element("testsuites", name=result.campaign.path.stem)
    totals = {"tests": 0, "failures": 0, "errors": 0, "skipped": 0}
    for condition in [*result.campaign.conditions, ALL]:
        cells = [cell for cell in result.cells() if cell.condition == condition and cell.is_judged]
        if not cells:
            continue
        suite = ElementTree.SubElement(root, "testsuite", name=_xml_text(condition))
        counts = dict.fromkeys(totals, 0)
        for cell in cells:
            case = ElementTree.SubElement(
                suite,
                "testcase",
                classname=_xml_text(f"{result.campaign.path.stem}.{condition}"),
                name=_xml_text(cell.name),
            )
            kind = _add_outcome(case, cell, commands)
            for count in ("tests", kind) if kind else ("tests",):
                counts[count] += 1
        for name, number in counts.items():
            suite.set(name, str(number))
            totals[name] += number
    for name, number in totals.items():
        root.set(name, str(number))
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_outcome(case: ElementTree.Element, cell: Cell, commands: Mapping[str, str]) -> str:
    """Say how a test case ended if it did not pass; return the kind of its end, by the name of JUnit's counts."""
    if cell.verdict == MET:
        return ""
    if cell.verdict == INCOMPLETE:
        ElementTree.SubElement(case, "skipped", message=_WORDS[INCOMPLETE])
        return "skipped"
    wrong = cell.having(FAIL, ERROR)
    is_error = cell.passed + cell.statuses.count(ERROR) == cell.count
    message = f"{cell_text(cell)}; required: {limits_text(cell.criterion)}"
    kind = "error" if is_error and wrong else "failure"
    element = ElementTree.SubElement(case, kind, message=_xml_text(message), type=cell.verdict)
    lines = [f"{rollout.name}: {reason(cell, rollout)}" for rollout in wrong[:_MOST_NAMES]]
    lines += [f"and {len(wrong) - _MOST_NAMES} more"] if len(wrong) > _MOST_NAMES else []
    lines += [commands[wrong[0].name]] if wrong else []
    element.text = _xml_text("\n".join(lines))
    return f"{kind}s"


def _xml_text(text: str) -> str:
    """Return a text without the characters that XML cannot hold."""
    return "".join(
        c if c in "\t\n" or " " <= c <= "\ud7ff" or "\ue000" <= c <= "\ufffd" or c > "\uffff" else "?" for c in text
    )


def html_page(
    result: CampaignResult,
    *,
    commands: Mapping[str, str],
    evidence: Mapping[str, Evidence] | None = None,
    comparisons: Sequence[PairedComparison] = (),
    baseline: str = "",
) -> str:
    """Return the report as one page that needs nothing else; logs and animations are files beside it.

    Args:
        result: The results.
        commands: By the name of a rollout, the command that runs it again.
        evidence: By the name of a rollout, what was kept of it.
        comparisons: The comparison with a baseline.
        baseline: The name of the baseline.
    """
    campaign, evidence = result.campaign, evidence or {}
    title = html.escape(campaign.path.stem)
    judged = [cell for cell in result.cells() if cell.is_judged]
    met = sum(cell.verdict == MET for cell in judged)
    word = MET if result.is_met else MISSED if any(cell.verdict == MISSED for cell in judged) else UNDECIDED
    summary = (
        f"{met} of {len(judged)} requirements met. {passed_text(result)}. {result.count} of {len(result.rollouts)} "
        f"rollouts of <code>{html.escape(campaign.scenario)}</code>: {len(campaign.conditions)} conditions, seeds "
        f"{campaign.seeds.numbers[0]} to {campaign.seeds.numbers[-1]}."
    )
    sections = [
        f'<h1>{title} <span class="{word}">{"met" if result.is_met else "not met"}</span></h1><p>{summary}</p>',
        f'<p class="undecided">{html.escape(caution)}</p>' if (caution := warning(result)) else "",
        _table(result),
        _legend(),
        *(_failure(cell, commands, evidence) for cell in failed_cells(result)),
    ]
    if comparisons:
        sections.append(_comparison_table(comparisons, baseline))
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title><style>{_STYLE}</style></head>
<body>{"".join(sections)}</body></html>
"""


_STYLE = """
:root{color-scheme:light;--met:#d8f0dd;--missed:#f9d5d0;--undecided:#fdeec4;--incomplete:#e8e8e8}
body{font:15px/1.45 system-ui,sans-serif;color:#1d1d1f;max-width:76rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.6rem}h1 span{font-size:1rem;padding:.2rem .6rem;border-radius:1rem;vertical-align:middle}
h2{font-size:1.1rem;margin:2rem 0 .4rem}code,pre{font:13px/1.4 ui-monospace,monospace}
pre{background:#f5f5f7;padding:.6rem .8rem;border-radius:6px;overflow-x:auto;margin:.5rem 0}
.wide{overflow-x:auto}table{border-collapse:collapse}
th,td{border:1px solid #d2d2d7;padding:.45rem .7rem;text-align:left;vertical-align:top}
thead th{background:#f5f5f7}th small,td small{display:block;font-weight:400;color:#55555a}
td b{font-size:1.05rem}tr.all th,tr.all td{border-top:3px double #86868b}
.met{background:var(--met)}.missed{background:var(--missed)}.undecided{background:var(--undecided)}
.incomplete{background:var(--incomplete)}
.dots{display:block;max-width:14rem;line-height:0;margin-top:.35rem}
.dots i{display:inline-block;width:7px;height:7px;margin:0 1px 1px 0;border-radius:1px}
i.pass{background:#2f9e55}i.fail{background:#d1372a}i.error{background:#7a1fa2}i.not{background:#c7c7cc}
.legend i{display:inline-block;width:9px;height:9px;margin:0 .25rem 0 .8rem}
img{display:block;max-width:100%;height:auto;margin:.6rem 0}.number{text-align:right}
"""


def _legend() -> str:
    marks = [("pass", "passes"), ("fail", "does not pass"), ("error", "failed to simulate"), ("not", "not run yet")]
    dots = "".join(f'<i class="{mark}"></i>{words}' for mark, words in marks)
    return (
        f'<p class="legend">Each square is a rollout:{dots}. Intervals are by Clopper and Pearson, two-sided; a '
        "required rate is met if the lower limit of the one-sided interval reaches it. A rollout that failed to "
        "simulate has not passed.</p>"
    )


def _table(result: CampaignResult) -> str:
    campaign = result.campaign
    head = "".join(
        f"<th>{html.escape(name)}<small>{html.escape(limits_text(criterion))}</small></th>"
        for name, criterion in campaign.criteria.items()
    )
    rows = []
    for condition in [*campaign.conditions, ALL]:
        values = campaign.conditions.get(condition, {})
        about = "".join(f"<small>{html.escape(f'{a} = {_short(v)}')}</small>" for a, v in values.items())
        cells = (result.cell(condition, name) for name in campaign.criteria)
        body = "".join("<td></td>" if cell is None else _td(cell) for cell in cells)
        kind = ' class="all"' if condition == ALL else ""
        rows.append(f"<tr{kind}><th>{html.escape(condition)}{about}</th>{body}</tr>")
    return (
        f'<div class="wide"><table><thead><tr><th>condition</th>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _short(value: object) -> str:
    text = safe_text(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _td(cell: Cell) -> str:
    if not cell.criterion.is_limited:
        return f"<td>{html.escape(range_text(cell))}</td>"
    errors = cell.statuses.count(ERROR)
    lines = [f"<b>{cell.passed}/{cell.count}</b> {interval_text(cell)}"]
    if cell.is_judged and cell.criterion.rate < 1.0:
        shown = least_rate(cell.passed, cell.count, cell.criterion.confidence)
        lines.append(f"<small>shown: at least {shown:.3f}</small>")
    lines += [f"<small>{errors} failed to simulate</small>"] if errors else []
    lines += [f"<small>{html.escape(range_text(cell))}</small>"] if cell.numbers else []
    if cell.is_judged and cell.verdict != MET:
        lines.append(f"<small>{_WORDS[cell.verdict]}</small>")
    if len(cell.rollouts) <= _MOST_DOTS and cell.condition != ALL:
        lines.append(f'<span class="dots">{"".join(_dot(cell, rollout) for rollout in cell.rollouts)}</span>')
    kind = f' class="{cell.verdict}"' if cell.is_judged else ""
    return f"<td{kind}>{''.join(lines)}</td>"


def _dot(cell: Cell, rollout: CampaignRollout) -> str:
    status = rollout.status(cell.name, cell.criterion)
    text = rollout.name if status == NOT_RUN else f"{rollout.name}: {reason(cell, rollout)}"
    return f'<i class="{status.split()[0]}" title="{html.escape(text, quote=True)}"></i>'


def _failure(cell: Cell, commands: Mapping[str, str], evidence: Mapping[str, Evidence]) -> str:
    """Return the section of a cell that is not met: which rollouts, and the first of them in detail."""
    wrong = cell.having(FAIL, ERROR)
    first = wrong[0]
    more = [rollout.name for rollout in wrong[1:_MOST_NAMES]]
    rest = f", and {len(wrong) - _MOST_NAMES} more" if len(wrong) > _MOST_NAMES else ""
    others = f"<p>Also: {html.escape(', '.join(more))}{rest}.</p>" if more else ""
    kept = evidence.get(first.name)
    details = ""
    if kept is not None:
        time = kept.rerun.first_violation(cell.name, cell.criterion)
        when = f"<p>Violated first at t = {time:g} s.</p>" if time is not None else ""
        links = [
            f'<a href="{html.escape(file, quote=True)}">{word}</a>'
            for word, file in (("animation", kept.animation), ("log", kept.log))
            if file
        ]
        note = f"<p>{html.escape(kept.note)}</p>" if kept.note else ""
        shown = f"<p>{', '.join(links)}</p>" if links else ""
        details = when + _curve(cell, kept.rerun) + shown + note
    return (
        f"<h2>{html.escape(cell.condition)}: {html.escape(cell.name)}</h2>"
        f"<p>{html.escape(first.name)}: {html.escape(reason(cell, first))}; required: "
        f"{html.escape(limits_text(cell.criterion))}.</p>"
        f"<pre>{html.escape(commands[first.name])}</pre>{details}{others}"
    )


def _curve(cell: Cell, rerun: Rerun) -> str:
    """Draw the samples of a criterion over time, with its limits."""
    from vtbdrake.visualization.plots import FAILED, Picture, finish, label

    samples, times = rerun.samples[cell.name], rerun.result.times
    count = min(len(samples), len(times))
    if count < 2:
        return ""
    figure = Picture(8.0, 2.6)
    axes = figure.add_subplot()
    axes.plot(times[:count], samples[:count], lw=1.4)
    for limit in (cell.criterion.at_least, cell.criterion.at_most):
        if limit is not None and cell.criterion.reading != "integral":  # Its limit is not one of its samples.
            axes.axhline(limit, color=FAILED, lw=1.2, ls=(0, (4, 2)))
    axes.set(xlabel="time t [s]", ylabel=label(cell.name, cell.criterion.unit))
    finish(axes)
    return image_html(figure)


def _comparison_table(comparisons: Sequence[PairedComparison], baseline: str) -> str:
    colour = {"better": "met", "worse": "missed"}
    rows = []
    for each in comparisons:
        classes = ["", "", *["number"] * (len(each.row) - 3), colour.get(each.difference, "")]
        cells = (f'<td class="{name}">{html.escape(text)}</td>' for name, text in zip(classes, each.row, strict=True))
        rows.append(f"<tr{' class=all' if each.condition == ALL else ''}>{''.join(cells)}</tr>")
    head = "".join(f"<th>{title}</th>" for title in COMPARED)
    return (
        f"<h2>Against {html.escape(baseline)}</h2><p>Rollouts with the same condition and seed are compared in pairs, "
        "by McNemar's exact test.</p>"
        f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
    )
