"""How often the same thing is logged."""

import logging

import pytest

from vtbdrake.lcm.hub import server


def test_of_one_kind_few_are_logged_and_the_rest_is_counted(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr(server.time, "monotonic", lambda: now)
    logger = logging.getLogger(f"{__name__}.limited")
    logger.addFilter(server.RateLimitFilter())
    for second in range(9):
        now = float(second)
        logger.warning("refused: %s", second)
    logger.warning("another kind")
    now = 10.0
    logger.warning("refused: %s", 10)
    assert [record.getMessage() for record in caplog.records] == [
        *(f"refused: {second}" for second in range(5)),
        "another kind",
        "refused: 10 (4 more messages like this one were suppressed)",
    ]
