"""FMUs for all tests of this folder, built when they are first used."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fmi.models import compiled
from vtbdrake.components.casadi_system.compiler import compiler_command


@pytest.fixture(scope="session")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Returns the file of one of `MODELS`."""
    if shutil.which(compiler_command()[0]) is None:
        pytest.skip("there is no C compiler")
    folder = tmp_path_factory.mktemp("fmu")
    return lambda name: compiled(folder, name)
