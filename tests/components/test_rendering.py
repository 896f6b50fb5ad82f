"""Whether this machine can render is found out in another process."""

from __future__ import annotations

import os

import pytest

from vtbdrake.components.rendering import RenderingError, check_rendering


# As if the packages were not there: where libEGL finds Mesa, and Mesa its drivers.
@pytest.mark.slow_cases
@pytest.mark.parametrize("variable", ["__EGL_VENDOR_LIBRARY_FILENAMES", "LIBGL_DRIVERS_PATH"])
def test_missing_package_is_an_error_that_names_it(variable: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("VTBDRAKE_RENDERING", raising=False)
    monkeypatch.setenv(variable, "/nonexistent")
    with pytest.raises(RenderingError, match="libegl1 libgl1-mesa-dri"):
        check_rendering()
    assert "VTBDRAKE_RENDERING" not in os.environ


def test_success_is_remembered_for_child_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("VTBDRAKE_RENDERING", raising=False)
    check_rendering()
    assert os.environ["VTBDRAKE_RENDERING"] == "EGL"
