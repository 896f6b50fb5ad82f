"""vtbdrake: virtual testbeds on Drake. One model to develop, optimize, reason and control.

`__init__.pyi` lists the public names. They are imported when they are first used, so that importing the package costs
next to nothing.
"""

import vtbdrake.child_process as _child_process  # noqa: F401  It notes the directory to which sys.path refers.
from vtbdrake.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
