"""``vtbdrake doctor`` on this computer, and on one that lacks something."""

import json
import os
import shutil
import subprocess
import sys
from itertools import chain
from pathlib import Path
from typing import Any

import pytest

from tests.cli.program import ROOT, error_of
from vtbdrake.cli.doctor import CHECKS, file_system_type

MOUNTS = r"""21 1 8:1 / / rw,relatime shared:1 - ext4 /dev/sda1 rw
22 21 0:40 / /home rw,relatime shared:2 - nfs4 server:/home rw
23 22 0:41 / /home/ada/my\040disk rw - xfs /dev/sdb1 rw
24 21 0:42 / /tmp rw - ext4 /dev/sda2 rw
25 24 0:43 / /tmp rw - tmpfs tmpfs rw
"""


def diagnosis(*arguments: str, prefix: tuple[str, ...] = (), **environment: str) -> tuple[int, dict[str, list[Any]]]:
    """Run ``vtbdrake doctor --json`` in a process of its own; return its exit code and the results by check."""
    done = subprocess.run(
        [*prefix, sys.executable, "-m", "vtbdrake", "doctor", "--json", *arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
    )
    assert done.stdout, done.stderr
    results: dict[str, list[Any]] = {}
    for result in json.loads(done.stdout):
        results.setdefault(result["check"], []).append(result)
    return done.returncode, results


def test_every_check_has_a_result_and_what_is_missing_a_remedy() -> None:
    code, results = diagnosis()
    assert list(results) == list(CHECKS)
    for result in chain(*results.values()):
        assert (result["status"] == "ok") == (result["remedy"] == ""), result
    assert results["drake"][0]["status"] == "ok"
    assert code == 0


@pytest.mark.slow
def test_missing_parts_are_warnings_that_fail_if_required(tmp_path: Path) -> None:
    lacking = {"CC": str(tmp_path / "cc"), "LIBGL_DRIVERS_PATH": "/nonexistent"}
    code, results = diagnosis(**lacking)
    assert code == 0
    assert "install a C compiler" in results["compiler"][0]["remedy"]
    assert "libgl1-mesa-dri" in results["rendering"][0]["remedy"]
    assert diagnosis("--require", "compiler", **lacking)[0] == 1


@pytest.mark.slow
def test_no_network_is_a_failure() -> None:
    alone = ("unshare", "--user", "--map-root-user", "--net")
    if shutil.which("unshare") is None or subprocess.run([*alone, "true"], capture_output=True).returncode:
        pytest.skip("this user may not make a network of its own")
    code, results = diagnosis(prefix=alone)  # one whose loopback is down
    assert code == 1
    assert [results[name][0]["status"] for name in ("lcm-hub", "multicast")] == ["failure", "warning"]
    assert "127.0.0.1" in results["lcm-hub"][0]["remedy"]
    assert "vtbdrake hub" in results["multicast"][0]["remedy"]


@pytest.mark.one_python
def test_unknown_checks_cannot_be_required() -> None:
    assert "rendering" in error_of("doctor", "--require", "renderin")


@pytest.mark.one_python
@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("/var/log", "ext4"),
        ("/home/ada", "nfs4"),
        ("/homework", "ext4"),
        ("/home/ada/my disk/studies", "xfs"),
        ("/tmp", "tmpfs"),  # the later of two mounts
    ],
)
def test_a_path_has_the_file_system_of_its_innermost_mount(path: str, kind: str) -> None:
    assert file_system_type(Path(path), MOUNTS) == kind


def test_the_file_system_is_that_of_stat() -> None:
    named = subprocess.run(["stat", "-f", "-c", "%T", "/proc"], capture_output=True, text=True).stdout.strip()
    assert file_system_type(Path("/proc")) == named == "proc"
