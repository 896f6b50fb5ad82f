"""Tests of your own testbeds: checks that every scenario can be put through, and a plugin for pytest.

`__init__.pyi` lists the public names. They are imported when they are first used: pytest loads the plugin in every run,
also where nothing of Drake is tested.
"""

from vtbdrake.common.lazy_names import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)
