"""The part of the build that pyproject.toml cannot declare: the modules of every .pyx and of every .lcm."""

import subprocess
import sys
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


def make_message_types(source: Path) -> None:
    """Make the Python modules of an .lcm file beside it, by the lcm-gen of the wheel `lcm`, where they are older."""
    program = "import sys, lcm; sys.exit(lcm.run_script('lcm-gen', sys.argv[1:]))"
    options = ["--lazy", "--python", "--python-no-init", "--ppath", str(source.parent)]
    made = subprocess.run([sys.executable, "-c", program, *options, str(source)])
    if made.returncode != 0:
        raise SystemExit(f"lcm-gen makes no modules of {source}, see above; it needs GLib (Debian's libglib2.0-0)")


for path in sorted((_ROOT / "vtbdrake").rglob("*.lcm")):
    make_message_types(path)

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
