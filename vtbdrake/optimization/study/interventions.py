"""Interventions: what people change in a study while it runs, and the search that follows from their changes."""

from __future__ import annotations

import getpass
import inspect
import math
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from vtbdrake.common.argument_checks import as_number, as_whole
from vtbdrake.common.failures import safe_text
from vtbdrake.optimization.identity import plain
from vtbdrake.optimization.parameter import Choice, Dimension, Parameter, checked_point
from vtbdrake.optimization.records import CONTROLS, PAUSE, RESUME, STOP, TRY, Intervention
from vtbdrake.optimization.study.forbidden_regions import checked_side, overlaps
from vtbdrake.optimization.study.study_error import StudyError
from vtbdrake.optimization.study.study_file import BUDGET, SOLVER, TARGET, StudyFile
from vtbdrake.optimization.study.study_search import StudySearch


class FollowedSearch:
    """The search of a study's file as its interventions leave it.

    Interventions are read once, those that are added meanwhile when `now` is called. A point that is tried changes no
    search, so that the points of a queue may be edited at no cost.

    Args:
        file: The file of the study.
    """

    def __init__(self, file: StudyFile) -> None:
        self._file = file
        # The search before all interventions, how often one had been changed, the last one, and the search behind it.
        # They are replaced together, so that threads need no lock.
        self._read: tuple[StudySearch, int, int, StudySearch] | None = None

    def now(self) -> StudySearch:
        """Return the search behind the interventions so far."""
        # First the number of changes: a change that happens now is noticed next time.
        begun, changes = StudySearch.of(self._file.meta), self._file.changes_of_search
        last, search = 0, begun
        if self._read is not None and self._read[:2] == (begun, changes):
            last, search = self._read[2:]
        new = self._file.interventions(after=last)
        if new:
            last, search = new[-1].number, search_after(search, new)
        self._read = begun, changes, last, search
        return search


class Interventions:
    """The interventions in a study's file: made and taken back, each one checked before it is written.

    Args:
        file: The file of the study.
    """

    def __init__(self, file: StudyFile) -> None:
        self._file = file
        self._followed = FollowedSearch(file)

    @property
    def search(self) -> StudySearch:
        """Return the search behind the interventions so far."""
        return self._followed.now()

    def make(self, kind: str, payloads: Sequence[dict[str, Any]], *, name: str) -> list[Intervention]:
        """Make interventions of a kind, all or none.

        Args:
            kind: Their kind.
            payloads: The arguments of each.
            name: Who makes them.

        Raises:
            ValueError: There is no such kind, it takes other arguments, or nothing would be left to search.
            SolverError: The solver cannot search what would be left.
            StudyError: The study is finished, nobody runs what is to be stopped, or the file cannot be written.
        """
        for payload in payloads:
            _check_arguments(kind, payload)
        self._refuse_if_finished(kind)
        stored = [plain(payload, f"the arguments of {kind}") for payload in payloads]
        return self._file.intervene(kind, stored, name=name, check=self._check_added)

    def change_waiting(self, number: int, payload: Mapping[str, Any] | None, *, kind: str | None = None) -> None:
        """Replace the arguments of an intervention that waits for its batch, or remove it.

        Args:
            number: Its number.
            payload: Its new arguments; None: it is removed.
            kind: The kind that it must have; None: any.

        Raises:
            StudyError: No intervention of that number and kind waits.
            ValueError: A later intervention makes no sense then.
        """
        self._file.change_waiting(number, payload, kind=kind, check=self._check_changed)

    def _check_added(self, interventions: Sequence[Intervention]) -> None:
        """Check interventions behind all others. Points that wait stay valid: the widest ranges only grow."""
        search = search_after(self.search, interventions)
        if any(intervention.kind != TRY for intervention in interventions):
            search.check()
        _check_points(search, interventions)

    def _check_changed(self, before: Intervention, after: Intervention | None) -> None:
        """Check what an intervention that waits has become."""
        if before.kind == TRY:
            _check_points(self.search, [] if after is None else [after])
            return
        # Not by what was read before: the change may be taken back.
        search = search_after(StudySearch.of(self._file.meta), self._file.interventions())
        search.check()
        # A range may not be that wide any more.
        _check_points(search, self._file.interventions(waiting=True))

    def _refuse_if_finished(self, kind: str) -> None:
        if self._file.is_running:
            return
        study = self._file.path or "the study"
        if kind == STOP:
            raise StudyError(f"no process runs {study}: there is nothing to stop")
        if kind in (RESUME, TRY, "budget") or self._budget_waits():
            return
        session = self._file.last_session()
        reason = session["reason"] if session is not None else None
        if reason not in (BUDGET, TARGET, SOLVER):
            return
        if kind == PAUSE or reason == BUDGET:
            raise StudyError(
                f"{study} is finished (its last run ended by {reason}, with {self._file.count()} rollouts): give it a "
                "larger budget first"
            )

    def _budget_waits(self) -> bool:
        """Return whether the newest budget waits for a batch; if any waits, it does."""
        number = self.search.budget_from
        budget = None if number is None else self._file.intervention(number)
        return budget is not None and budget.batch is None


def search_after(search: StudySearch, interventions: Iterable[Intervention]) -> StudySearch:
    """Return a search after interventions.

    Args:
        search: The search before them.
        interventions: The interventions, in their order.

    Raises:
        ValueError: One of them makes no sense at its place; the message names it.
    """
    for intervention in interventions:
        try:
            search = _KINDS[intervention.kind](search, intervention.number, **intervention.payload)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{intervention.kind} (intervention {intervention.number}): {error}") from error
    return search


def repeated_interventions(
    begun: StudySearch, interventions: Iterable[Intervention], *, without: Collection[int]
) -> list[Intervention]:
    """Return the interventions that a replay of a study repeats: those that had an effect on its points.

    Args:
        begun: The search with which the study begins.
        interventions: All interventions of the study, in their order.
        without: The numbers of those to leave out.

    Raises:
        ValueError: There is no such intervention, or a later one makes no sense without it.
    """
    changes = [i for i in interventions if i.kind not in CONTROLS and i.batch is not None]
    numbers = [intervention.number for intervention in changes]
    for number in without:
        if number not in numbers:
            raise ValueError(f"no intervention {number} can be left out; those with an effect are: {numbers}")
    repeated = [intervention for intervention in changes if intervention.number not in without]
    search = begun
    for intervention in repeated:
        search = search_after(search, [intervention])
        if intervention.kind != TRY:
            search.check()
        _check_points(search, [intervention])
    return repeated


def name_of_person(by: str | None) -> str:
    """Return the name under which a change is recorded: the one that is given, or the user of this process."""
    if by:
        return safe_text(by)
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # A container may have a user without a name.
        return f"user {os.getuid()}"


def _check_points(search: StudySearch, interventions: Sequence[Intervention]) -> None:
    """Check that the points that interventions try lie within the widest ranges.

    Raises:
        ValueError: One does not.
    """
    for intervention in interventions:
        if intervention.kind == TRY:
            checked_point(search.widest, intervention.payload["point"])


# -- the kinds


def _pause(search: StudySearch, _: int) -> StudySearch:
    if search.paused:
        raise ValueError("the study is paused already: resume or stop it")
    return replace(search, paused=True)


def _resume(search: StudySearch, _: int) -> StudySearch:
    if not search.paused:
        raise ValueError("the study is not paused")
    return replace(search, paused=False)


def _stop(search: StudySearch, _: int) -> StudySearch:
    return replace(search, paused=False)


def _range(
    search: StudySearch, _: int, *, address: str, lower: Any = None, upper: Any = None, options: Any = None
) -> StudySearch:
    index, parameter = search.parameter(address)
    narrowed: Dimension
    if isinstance(parameter, Choice):
        if options is None or lower is not None or upper is not None:
            raise ValueError(f"{address} is a choice: give options=[option, option, ...], not a range")
        declared = search.widest[index]
        narrowed = Choice(address, [declared.as_value(option) for option in options])
    else:
        if options is not None:
            raise ValueError(f"{address} is a number: give lower= and upper=, not options")
        lower = parameter.lower if lower is None else as_number(f"the lower end of {address}", lower)
        upper = parameter.upper if upper is None else as_number(f"the upper end of {address}", upper)
        narrowed = replace(parameter, lower=lower, upper=upper)
        limits = search.limits[index]
        widest = search.widest[index]
        assert isinstance(widest, Parameter)
        if limits is None:
            if narrowed.lower < widest.lower or narrowed.upper > widest.upper:
                raise ValueError(
                    f"the range {narrowed.range_text} of {address} exceeds {widest.range_text}, the problem's range; "
                    "a field of the scenario is only checked there"
                )
        elif narrowed.lower < limits[0] or narrowed.upper > limits[1]:
            raise ValueError(
                f"the range {narrowed.range_text} of {address} exceeds its bounds [{limits[0]:g}, {limits[1]:g}]"
            )
        hull = replace(widest, lower=min(widest.lower, narrowed.lower), upper=max(widest.upper, narrowed.upper))
        search = replace(search, widest=_placed(search.widest, index, hull))
    return replace(search, ranges=_placed(search.ranges, index, narrowed))


def _placed(space: tuple[Dimension, ...], index: int, parameter: Dimension) -> tuple[Dimension, ...]:
    return (*space[:index], parameter, *space[index + 1 :])


def _freeze(search: StudySearch, _: int, *, address: str, value: Any) -> StudySearch:
    _, parameter = search.parameter(address)
    return replace(search, frozen={**search.frozen, address: parameter.as_value(value)})


def _unfreeze(search: StudySearch, _: int, *, address: str) -> StudySearch:
    search.parameter(address)
    if address not in search.frozen:
        raise ValueError(f"{address} is not frozen; frozen are: {', '.join(search.frozen) or 'none'}")
    return replace(search, frozen={key: v for key, v in search.frozen.items() if key != address})


def _forbid(search: StudySearch, number: int, *, region: Any) -> StudySearch:
    if not isinstance(region, Mapping) or not region:
        raise ValueError(f"a region is given as {{address: [lower, upper], ...}}, not as {region!r}")
    sides = {address: checked_side(search.parameter(address)[1], side) for address, side in region.items()}
    if not overlaps(sides, search.by_address, search.box):
        raise ValueError("the region lies outside of all that is searched, and forbids nothing")
    return replace(search, forbidden={**search.forbidden, number: sides})


def _allow(search: StudySearch, _: int, *, number: Any) -> StudySearch:
    if number not in search.forbidden:
        regions = ", ".join(str(region) for region in search.forbidden) or "none"
        raise ValueError(f"there is no forbidden region {number!r}; the forbidden regions are: {regions}")
    return replace(search, forbidden={key: r for key, r in search.forbidden.items() if key != number})


def _budget(search: StudySearch, number: int, *, rollouts: Any) -> StudySearch:
    if rollouts is not None and as_whole("a budget of rollouts", rollouts) < 1:
        raise ValueError(f"a budget is at least one rollout, not {rollouts}")
    return replace(search, budget=None if rollouts is None else int(rollouts), budget_from=number)


def _solver(search: StudySearch, _: int, *, solver: Any, options: Any = None) -> StudySearch:
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"the options of a solver are given as {{name: value, ...}}, not as {options!r}")
    options = plain(options or {}, "the options of its solver")
    return replace(search, solver=solver, options=options, solver_changed=True)


def _try(search: StudySearch, _: int, *, point: Any) -> StudySearch:
    return search  # The point was checked where it was written.


def _aspiration(search: StudySearch, _: int, *, targets: Any) -> StudySearch:
    if len(search.signs) < 2:
        raise ValueError("an aspiration belongs to several qualities, but the problem has one")
    if targets is None:
        return replace(search, aspiration=None)
    if not isinstance(targets, Sequence) or isinstance(targets, str) or len(targets) != len(search.signs):
        raise ValueError(f"an aspiration has one value per quality, {len(search.signs)}, not {targets!r}")
    values = tuple(as_number("a value of an aspiration", target) for target in targets)
    if not all(math.isfinite(value) for value in values):
        raise ValueError(f"the values of an aspiration are finite, not {list(values)}")
    return replace(search, aspiration=values)


# A kind is a function of the search before it, the number of the intervention, and its payload.
_KINDS: Mapping[str, Callable[..., StudySearch]] = {
    PAUSE: _pause,
    RESUME: _resume,
    STOP: _stop,
    "range": _range,
    "freeze": _freeze,
    "unfreeze": _unfreeze,
    "forbid": _forbid,
    "allow": _allow,
    "budget": _budget,
    "solver": _solver,
    TRY: _try,
    "aspiration": _aspiration,
}


def _check_arguments(kind: Any, payload: Mapping[str, Any]) -> None:
    """Check the arguments of an intervention by their names; their values are not checked.

    Raises:
        ValueError: There is no such kind, or it takes other arguments.
    """
    if kind not in _KINDS:
        raise ValueError(f"there is no intervention {kind!r}; there are {', '.join(_KINDS)}")
    _, _, *parameters = inspect.signature(_KINDS[kind]).parameters.values()
    names = [parameter.name for parameter in parameters]
    missing = [p.name for p in parameters if p.default is p.empty and p.name not in payload]
    if missing or not payload.keys() <= set(names):
        takes = ", ".join(f"{name}=" for name in names) or "no arguments"
        raise ValueError(f"{kind} takes {takes}, not {', '.join(f'{name}=' for name in payload) or 'none'}")
