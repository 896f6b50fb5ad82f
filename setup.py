"""What pyproject.toml cannot say: every .pyx of both packages becomes a compiled module, with numpy at hand."""

from pathlib import Path

import numpy as np
from setuptools import Extension, setup

_ROOT = Path(__file__).parent
_PACKAGES = ("vtbdrake", "vtbdrake_diagrams")
_SOURCES, _DECLARATIONS = (
    sorted(path.relative_to(_ROOT) for package in _PACKAGES for path in (_ROOT / package).rglob(name))
    for name in ("*.pyx", "*.pxd")
)

# The part that Cython would repeat in every module: compiled once, it saves a third of the time.
_SHARED = "vtbdrake._cyutility"

setup(
    ext_modules=[
        Extension(_SHARED, ["vtbdrake/_cyutility.c"], extra_compile_args=["-O2", "-g0"]),
        *(
            Extension(
                ".".join(source.with_suffix("").parts),
                [str(source)],
                depends=[str(path) for path in _DECLARATIONS],
                include_dirs=[np.get_include()],
                define_macros=[("NPY_NO_DEPRECATED_API", "NPY_1_7_API_VERSION")],
                # The same rounding on every processor: no product and sum in one. No debug information, which takes a
                # quarter of the time to compile.
                extra_compile_args=["-O2", "-g0", "-ffp-contract=off"],
            )
            for source in _SOURCES
        ),
    ],
    options={
        "build_ext": {
            # The folder of temporary files belongs to one version of Python: several share a checkout.
            "cython_c_in_temp": True,
            "shared_utility_qualified_name": _SHARED,
            "cython_directives": {
                "language_level": "3",
                "boundscheck": False,
                "wraparound": False,
                "cdivision": True,
            },
        }
    },
)
