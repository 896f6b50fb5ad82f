"""Whether this machine can render is found out in another process."""

from __future__ import annotations

import os

import pytest

from vtbdrake.components.rendering import RenderingError, check_rendering


def test_missing_driver_is_an_error_that_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("VTBDRAKE_RENDERING", raising=False)
    # GLVND finds Mesa's EGL by these files: as if the package were not there.
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent.json")
    with pytest.raises(RenderingError, match="libegl1 libgl1-mesa-dri"):
        check_rendering()
    assert "VTBDRAKE_RENDERING" not in os.environ


def test_success_is_remembered_for_child_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("VTBDRAKE_RENDERING", raising=False)
    check_rendering()
    assert os.environ["VTBDRAKE_RENDERING"] == "EGL"
