"""The versions of Drake with which the tests run, and a warning about others.

The requirements of the package exclude no newer version: most work, and whoever installs one can go back.
"""

import warnings

TESTED_DRAKE = ("1.51.1", "1.58.0")
"""The versions of Drake with which the tests run."""


class UntestedDrakeWarning(UserWarning):
    """The tests of this version of vtbdrake have not run with the installed version of Drake."""


def warn_if_untested(version: str) -> None:
    """Warn if a version of Drake is not one of `TESTED_DRAKE`, apart from its last number."""
    if version.rpartition(".")[0] not in {tested.rpartition(".")[0] for tested in TESTED_DRAKE}:
        warnings.warn(
            f"drake {version} is installed, and vtbdrake is tested with {' and '.join(TESTED_DRAKE)}: if something "
            f"fails, try pip install drake=={TESTED_DRAKE[-1]} ({TESTED_DRAKE[0]} for Python 3.11)",
            UntestedDrakeWarning,
            stacklevel=2,
        )
