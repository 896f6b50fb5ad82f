"""vtbdrake: virtual testbeds on Drake. One model to develop, optimize, reason and control.

`__init__.pyi` lists the public names. They are imported when they are first used, so that importing the package costs
next to nothing.
"""

import sys as _sys

import vtbdrake.common.child_process as _child_process  # noqa: F401  It notes the directory to which sys.path refers.
from vtbdrake.common.lazy_names import attach_names

if "IPython" in _sys.modules:
    from vtbdrake.common.notebook_errors import shorten_tracebacks as _shorten_tracebacks

    _shorten_tracebacks()

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)
