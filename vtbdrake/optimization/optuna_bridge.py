"""Studies in Optuna's storage, for its dashboard and its plots; and points from there."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vtbdrake.common.json_data import plain
from vtbdrake.optimization.identity import differences
from vtbdrake.optimization.parameter import Choice, Dimension
from vtbdrake.optimization.records import Outcome, Trial
from vtbdrake.optimization.solvers.optuna_samplers import distribution, import_optuna, quiet
from vtbdrake.optimization.solvers.solver import Point
from vtbdrake.optimization.study.study_error import StudyError
from vtbdrake.optimization.study.study_file import encode

if TYPE_CHECKING:
    import optuna
    from optuna.distributions import BaseDistribution
    from optuna.storages import BaseStorage
    from optuna.trial import FrozenTrial

    from vtbdrake.optimization.study import Study

# Identifies a study besides its problem: the same one may be exported again.
_IDENTITY = ("solver", "seed", "options", "parallel")


def to_optuna(study: Study, storage: str | BaseStorage, *, name: str) -> optuna.Study:
    """Write a study into Optuna's storage. See `Study.to_optuna`.

    Args:
        study: The study to export.
        storage: A URL, such as ``sqlite:///study.db``, or a storage of Optuna's.
        name: The name of the study there.

    Raises:
        ModuleNotFoundError: Optuna is not installed.
        StudyError: The storage cannot be opened, or is the file of this study; or ``name`` is another study there.
    """
    optuna = import_optuna("an export to Optuna")
    trials, outcomes, finished = study.trials, study.rollouts, study.finished
    with quiet():
        opened = _open(optuna, storage, but=study.path)
        exported = _exported(optuna, opened, study, name)
        distributions = {parameter.address: _distribution(optuna, parameter) for parameter in study.parameters}
        ours = [t for t in exported.get_trials(deepcopy=False) if "batch" in t.user_attrs]
        there = Counter(_key(t.user_attrs["batch"], t.params) for t in ours)
        conditions = range(len(study.record["problem"]["conditions"]))
        new = []
        for trial in trials:
            params = dict(trial.parameters)
            key = _key(trial.batch, params)
            if there[key]:
                there[key] -= 1
            else:
                rows = [(trial.point, condition) for condition in conditions if (trial.point, condition) in outcomes]
                rollouts = [outcomes[row] for row in rows]
                frozen = _frozen(optuna, trial, params, distributions, rollouts, objectives=len(study.names))
                _date(frozen, [(outcomes[row].wall_time, finished[row]) for row in rows if row in finished])
                new.append(frozen)
        exported.add_trials(new)
    return exported


def points_from_optuna(study: Study, storage: str | BaseStorage, *, name: str) -> list[Point]:
    """Return the points of a study in Optuna's storage that ``study`` has neither evaluated nor in its queue.

    See `Study.import_optuna`.

    Args:
        study: The study whose parameters, trials and queue count.
        storage: A URL, such as ``sqlite:///study.db``, or a storage of Optuna's.
        name: The name of Optuna's study.

    Raises:
        ModuleNotFoundError: Optuna is not installed.
        StudyError: The storage cannot be opened or has no study ``name``, or that study varies other parameters.
        ValueError: A point lies outside its range.
    """
    optuna = import_optuna("an import from Optuna")
    with quiet():
        opened = _open(optuna, storage, but=study.path)
        try:
            source = optuna.load_study(study_name=name, storage=opened)
        except KeyError as error:
            names = ", ".join(optuna.get_all_study_names(opened)) or "none"
            raise StudyError(f"Optuna's storage has no study {name!r}; it has {names}") from error
        trials = source.get_trials(deepcopy=False)
    # By their text: 1 and True are equal as numbers.
    present = {encode(trial.point) for trial in study.trials}
    present |= {encode(tuple(parameters.values())) for parameters in study.queue.values()}
    points = [point for trial in trials if (point := _point(study, trial, name)) is not None]
    return [point for text, point in {encode(point): point for point in points}.items() if text not in present]


def _open(optuna: Any, storage: str | BaseStorage, *, but: Path | None) -> BaseStorage:
    if not isinstance(storage, str):
        return storage
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import SQLAlchemyError

    try:
        database = make_url(storage).database
        # Optuna would put its tables beside ours.
        if but is not None and database and Path(database).resolve() == but.resolve():
            raise StudyError(f"{but} is the study itself: give Optuna another file")
        opened: BaseStorage = optuna.storages.RDBStorage(storage)
    except SQLAlchemyError as error:
        reason = str(error).partition("\n")[0]
        raise StudyError(
            f"Optuna cannot open the storage {storage!r} ({reason}): give a URL such as 'sqlite:///study.db' in a "
            "folder that exists, or one of Optuna's storages"
        ) from error
    return opened


def _exported(optuna: Any, storage: BaseStorage, study: Study, name: str) -> optuna.Study:
    """Return the study in the storage; create it if it is missing."""
    record = json.loads(json.dumps(study.record))
    if name in optuna.get_all_study_names(storage):
        exported = optuna.load_study(study_name=name, storage=storage)
        there = exported.user_attrs
        same = all(there.get(key) == record.get(key) for key in _IDENTITY)
        # Its code may have changed since, see `Problem.study`.
        if not same or "problem" not in there or differences(there["problem"], record["problem"]):
            raise StudyError(
                f"Optuna's storage has another study {name!r} already: export this one by another name, or delete "
                "the other"
            )
    else:
        exported = optuna.create_study(storage=storage, study_name=name, directions=study.directions)
        exported.set_metric_names(list(study.names))
    for key, value in record.items():
        if exported.user_attrs.get(key) != value:
            exported.set_user_attr(key, value)
    return exported


def _key(batch: int, params: Mapping[str, Any]) -> tuple[int, str]:
    return batch, json.dumps(params, sort_keys=True)


def _frozen(
    optuna: Any,
    trial: Trial,
    params: Mapping[str, Any],
    distributions: Mapping[str, BaseDistribution],
    rollouts: Sequence[Outcome],
    *,
    objectives: int,
) -> FrozenTrial:
    states = optuna.trial.TrialState
    failed = any(math.isnan(value) for value in trial.values)
    state = states.FAIL if failed else states.COMPLETE if trial.exact else states.PRUNED
    attributes: dict[str, Any] = {
        "batch": trial.batch,
        "origin": trial.origin,
        "method": trial.method,
        # By condition, in the order of the problem; without those that racing has left out.
        "values": [plain((outcome.value, *outcome.measures[: objectives - 1])) for outcome in rollouts],
        "t_star": plain([outcome.t_star for outcome in rollouts]),
        "end": [outcome.end for outcome in rollouts],
        "wall_time": plain([outcome.wall_time for outcome in rollouts]),
    }
    if state is states.PRUNED:
        attributes["bound"] = plain(trial.values)
    if trial.attributes:
        attributes["attributes"] = dict(trial.attributes)
    messages = [outcome.message for outcome in rollouts if outcome.message]
    if messages:
        attributes["messages"] = messages
    frozen: FrozenTrial = optuna.create_trial(
        state=state,
        values=list(trial.values) if state is states.COMPLETE else None,
        params=dict(params),
        distributions=dict(distributions),
        user_attrs=attributes,
        # The dashboard reads only a list; Optuna reads the list and its newer form, one attribute each.
        system_attrs={} if failed or not trial.violations else {"constraints": list(trial.violations)},
    )
    return frozen


def _date(frozen: FrozenTrial, rollouts: Sequence[tuple[float, datetime]]) -> None:
    """Set start and end of a trial by its rollouts, each (duration in seconds, time of its end)."""
    # Optuna's times are local, without a zone.
    local = [(seconds, at.astimezone().replace(tzinfo=None)) for seconds, at in rollouts if math.isfinite(seconds)]
    if local:
        frozen.datetime_start = min(at - timedelta(seconds=seconds) for seconds, at in local)
        frozen.datetime_complete = max(at for _, at in local)


def _distribution(optuna: Any, parameter: Dimension) -> BaseDistribution:
    if not isinstance(parameter, Choice):
        return distribution(parameter, optuna)
    categorical: BaseDistribution = optuna.distributions.CategoricalDistribution(parameter.options)
    return categorical


def _point(study: Study, trial: FrozenTrial, name: str) -> Point | None:
    """Return the point of a trial; None if its parameters are not all drawn yet."""
    params = {**trial.system_attrs.get("fixed_params", {}), **trial.params}
    parameters = study.parameters
    addresses = [parameter.address for parameter in parameters]
    foreign = [key for key in params if key not in addresses]
    missing = [address for address in addresses if address not in params]
    if foreign or (missing and trial.state.is_finished()):
        raise StudyError(
            f"trial {trial.number} of Optuna's study {name!r} sets {', '.join(params) or 'nothing'}, but this study "
            f"varies {', '.join(addresses)}: the names must be the same"
        )
    if missing:
        return None
    return tuple(p.as_value(params[p.address]) for p in parameters)
