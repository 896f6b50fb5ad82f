"""The documented commands keep the pace of their scenario: real processes of hub, machine and loop."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.cli.program import ROOT, run
from vtbdrake.lcm.hub import Hub

CART_POLE = "vtbdrake_diagrams.cart_pole:CartPoleScenario"
PERIOD = 0.02  # s, of the cart-pole
PLAIN = ("--priority", 0, "--no-lock-memory")


@contextmanager
def machine(url: str, *options: object) -> Iterator[None]:
    command = [sys.executable, "-u", "-m", "vtbdrake.cli", "machine", CART_POLE, "--url", url, *map(str, options)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == f"ready on {url}\n"
        try:
            yield
        finally:
            program.terminate()
            program.communicate(timeout=60)


def test_machine_has_the_period_of_its_scenario(tmp_path: Path) -> None:
    with Hub(port=0) as hub, machine(hub.url):
        begin = time.monotonic()
        program = run("run", CART_POLE, "--url", hub.url, "--seconds", 0.5, *PLAIN, "--statistics", tmp_path / "s.json")
        took = time.monotonic() - begin
    # On a busy computer, the machine may be held up for longer than the guards allow.
    assert program.exit_code == 0 or " is stale: " in program.stderr, program.stderr
    statistics = json.loads((tmp_path / "s.json").read_text())
    # More cycles than periods would mean that the DPS is ahead of the time.
    assert 0 < sum(statistics["histograms"]["cycle"]["bins"].values()) <= took / PERIOD
    assert statistics["off_pace"] == 0


@pytest.mark.slow
def test_machine_at_another_pace_is_not_commanded() -> None:
    with Hub(port=0) as hub, machine(hub.url, "--period", 0.002):
        program = run("run", CART_POLE, "--url", hub.url, "--wait", 1.5, *PLAIN)
    assert program.exit_code == 1
    assert "but the period of the DPS is 20 ms" in program.stderr
