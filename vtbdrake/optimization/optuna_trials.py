"""Many trials at once into Optuna's database, which takes them one by one, 20 ms each, by itself."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import optuna
    from optuna.storages import BaseStorage, RDBStorage
    from optuna.trial import FrozenTrial
    from sqlalchemy import Connection

# The schema of Optuna 3.2 to 5.0. Optuna itself writes into any other.
_SCHEMA = "v3.2.0.a"


def insert_trials(study: optuna.Study, storage: BaseStorage, trials: Sequence[FrozenTrial]) -> None:
    """Adds finished trials to a study, all of them or, in a database of the schema known here, none.

    They must fit the study: as many values as directions, and the distributions of the trials before.
    """
    from optuna.storages import RDBStorage

    if not trials:
        return
    if isinstance(storage, RDBStorage) and storage.get_current_version() == _SCHEMA:
        _insert(storage, study._study_id, trials)
    else:
        study.add_trials(trials)


def _insert(storage: RDBStorage, study_id: int, trials: Sequence[FrozenTrial]) -> None:
    from optuna.storages._rdb import models
    from sqlalchemy import func, insert, select, update

    studies, table = models.StudyModel.__table__, models.TrialModel.__table__
    mine = table.c.study_id == study_id
    with storage.engine.begin() as connection:
        # Changes nothing, but holds the lock: the numbers that follow are ours.
        connection.execute(
            update(studies).where(studies.c.study_id == study_id).values(study_name=studies.c.study_name)
        )
        first = connection.execute(select(func.count()).where(mine)).scalar_one()
        rows = [
            {
                "number": first + k,
                "study_id": study_id,
                "state": trial.state,
                "datetime_start": trial.datetime_start,
                "datetime_complete": trial.datetime_complete,
            }
            for k, trial in enumerate(trials)
        ]
        connection.execute(insert(table), rows)
        query = select(table.c.trial_id).where(mine, table.c.number >= first).order_by(table.c.number)
        ids = connection.execute(query).scalars().all()
        pairs = list(zip(ids, trials, strict=True))
        _fill(connection, models.TrialParamModel, (row for i, trial in pairs for row in _parameters(i, trial)))
        _fill(connection, models.TrialValueModel, (row for i, trial in pairs for row in _values(i, trial)))
        for model, attribute in (
            (models.TrialUserAttributeModel, "user_attrs"),
            (models.TrialSystemAttributeModel, "system_attrs"),
        ):
            _fill(
                connection,
                model,
                (
                    {"trial_id": i, "key": key, "value_json": json.dumps(value)}
                    for i, trial in pairs
                    for key, value in getattr(trial, attribute).items()
                ),
            )


def _fill(connection: Connection, model: Any, rows: Iterator[dict[str, Any]]) -> None:
    from sqlalchemy import insert

    if found := list(rows):
        connection.execute(insert(model.__table__), found)


def _parameters(trial_id: int, trial: FrozenTrial) -> Iterator[dict[str, Any]]:
    from optuna.distributions import distribution_to_json

    for name, distribution in trial.distributions.items():
        yield {
            "trial_id": trial_id,
            "param_name": name,
            "param_value": distribution.to_internal_repr(trial.params[name]),
            "distribution_json": distribution_to_json(distribution),
        }


def _values(trial_id: int, trial: FrozenTrial) -> Iterator[dict[str, Any]]:
    from optuna.storages._rdb.models import TrialValueModel

    for objective, value in enumerate(trial.values or ()):
        stored, kind = TrialValueModel.value_to_stored_repr(value)
        yield {"trial_id": trial_id, "objective": objective, "value": stored, "value_type": kind}
