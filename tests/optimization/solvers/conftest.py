"""Fixtures that tests of several solvers share."""

import pytest


@pytest.fixture
def short_model(monkeypatch):
    """End the Bayesian optimization of ``auto``, which thinks the longest, early: for tests of what follows it."""
    monkeypatch.setattr("vtbdrake.optimization.solvers.auto.MODEL_POINTS", 7)
