"""The C loop beside which ours is measured."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.bare_loop import NoCompilerError, bare_loop

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")


@needs_compiler
def test_bare_loop_misses_the_whole_periods_that_it_wakes_up_late():
    with bare_loop() as loop:
        # So short a period that every cycle is late by many.
        run = loop.run(priority=1, period=1e-6, cycles=200)
    assert run.lateness.shape == (200,)
    assert run.missed == np.sum(np.round(run.lateness * 1e9) // 1000)
    assert run.missed > 0


@needs_compiler
def test_bare_loop_never_wakes_up_early():
    with bare_loop() as loop:
        assert loop.run(priority=1, period=1e-4, cycles=100).lateness.min() >= 0.0


def test_bare_loop_without_a_compiler_says_what_to_install(monkeypatch, tmp_path: Path):
    monkeypatch.setenv("CC", str(tmp_path / "cc"))
    with pytest.raises(NoCompilerError, match="install gcc or clang"), bare_loop():
        pass
