"""The part of the build that pyproject.toml cannot declare: which modules there are."""

import subprocess
import sys
import tempfile
from pathlib import Path
from sysconfig import get_path

import numpy as np
from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py
from setuptools.errors import CompileError

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

# numpy's distributions, for compiled code that draws random numbers.
_NPYRANDOM = {"libraries": ["npyrandom", "m"], "library_dirs": [str(Path(np.__file__).parent / "random" / "lib")]}
_DRAWS = {Path("vtbdrake/components/sensors/noise_kernel.pyx")}

# Modules of testbeds that read recordings, which are not part of vtbdrake: they stay in the repository.
_READ_RECORDINGS = {
    *(path.parent / path.stem for path in sorted(Path("vtbdrake_diagrams").glob("*/reality.py"))),
    *(Path("vtbdrake_diagrams/park") / name for name in ("few_landmarks", "mower", "survey")),
    *(Path("vtbdrake_diagrams/recorded_arms") / name for name in ("pendulum", "subjects")),
}


class BuildPy(build_py):
    """Leaves out the modules that read recordings, in the source distribution and in the wheel."""

    def find_package_modules(self, package: str, package_dir: str) -> list[tuple[str, str, str]]:
        """Return package, name and file of each module of a package."""
        modules = super().find_package_modules(package, package_dir)
        return [module for module in modules if Path(*package.split("."), module[1]) not in _READ_RECORDINGS]


class BuildExt(build_ext):
    """Looks for a C compiler with Python's headers before Cython translates the modules, which takes a minute."""

    command_name = "build_ext"  # By which an editable installation finds the options below.

    def build_extensions(self) -> None:
        """Compile the modules.

        Raises:
            SystemExit: There is no C compiler, or Python's headers are missing; the last line of the output says so.
        """
        with tempfile.TemporaryDirectory() as folder:
            source = Path(folder, "has_headers.c")
            source.write_text("#include <Python.h>\n")
            try:
                self.compiler.compile([str(source)], output_dir=folder, include_dirs=[get_path("include")])
            except CompileError as error:
                version = f"{sys.version_info.major}.{sys.version_info.minor}"
                raise SystemExit(
                    f"vtbdrake compiles modules: it needs a C compiler and the headers of Python {version} ({error}): "
                    f"apt-get install gcc libc6-dev python{version}-dev, or install a wheel, which needs neither"
                ) from None
        super().build_extensions()

    def run(self) -> None:
        """Compile the modules; beside their sources, those whose source is gone are removed."""
        super().run()
        if self.inplace:
            self._remove_stale_modules()

    def _remove_stale_modules(self) -> None:
        """Remove compiled modules whose source is gone: Python would prefer them to a .py of the same name."""
        built = {Path(self.get_ext_fullpath(extension.name)).resolve() for extension in self.extensions}
        suffix = self.get_ext_filename("module").removeprefix("module")
        for package in _PACKAGES:
            for path in (_ROOT / package).rglob(f"*{suffix}"):
                if path.resolve() not in built:
                    path.unlink()


setup(
    cmdclass={"build_py": BuildPy, "build_ext": BuildExt},
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
                **(_NPYRANDOM if source in _DRAWS else {}),
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
