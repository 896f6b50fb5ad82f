"""The public names of packages."""

from importlib import import_module

import pytest

pytestmark = pytest.mark.one_python


@pytest.mark.parametrize(
    ("package", "name", "meant"),
    [
        ("vtbdrake", "Scenaro", "Scenario"),
        ("vtbdrake", "load_scenaro", "load_scenario"),
        ("vtbdrake.reasoning", "Reasner", "Reasoner"),
        ("vtbdrake.control", "Runtme", "Runtime"),
    ],
)
def test_misspelt_name_gets_a_suggestion(package: str, name: str, meant: str) -> None:
    module = import_module(package)
    with pytest.raises(AttributeError, match=rf"module '{package}' has no attribute '{name}'; did you mean {meant}\b"):
        getattr(module, name)
    assert not hasattr(module, name) and hasattr(module, meant)


def test_name_like_no_other_gets_none() -> None:
    with pytest.raises(AttributeError, match="has no attribute '__wrapped__'$"):
        _ = import_module("vtbdrake").__wrapped__
