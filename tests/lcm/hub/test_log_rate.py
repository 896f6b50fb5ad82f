"""How often the same thing is logged."""

import logging

import pytest

from vtbdrake.lcm.hub import log_rate


def test_of_one_kind_few_are_logged_and_the_rest_is_counted(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr(log_rate.time, "monotonic", lambda: now)
    logger = log_rate.limited_logger(f"{__name__}.limited")
    assert log_rate.limited_logger(logger.name) is logger
    assert len(logger.filters) == 1
    for second in range(9):
        now = float(second)
        logger.warning("refused: %s", second)
    logger.warning("another kind")
    now = 10.0
    logger.warning("refused: %s", 10)
    assert [record.getMessage() for record in caplog.records] == [
        *(f"refused: {second}" for second in range(5)),
        "another kind",
        "refused: 10 (4 more like this one were not logged)",
    ]
    assert logging.getLogger(__name__).filters == []
