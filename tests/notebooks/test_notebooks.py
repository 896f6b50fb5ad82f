"""Every notebook runs, and is stored as it runs."""

from collections.abc import Mapping

import pytest

from tests.notebooks.checks import check_numbers, check_runs, check_stored
from tools.run_notebooks import FOLDER

LARGEST = 1_000_000  # bytes

# Pieces of the code of each notebook, and what replaces them, so that the same cells take less time.
SHORTER: dict[str, Mapping[str, str]] = {
    # Two recordings are fitted, and one is predicted; tests/calibration/test_calibration.py takes more.
    "calibration": {"logs[0::2]": "logs[0:4:2]", "for log in held_out])": "for log in held_out[:1]])"},
    "camera": {
        "np.geomspace(0.1, 100.0, 13)": "np.geomspace(0.1, 10.0, 3)",
        "horizon=24.0": "horizon=4.0",
        "problem.sweep(5, ": "problem.sweep(2, ",
        "tried = lights": 'tried = {"beside, 70 deg": lights["beside, 70 deg"]}',
        # Until the bar is gripped, tests/diagrams/satellite/test_lighting.py waits.
        "horizon=36.0": "horizon=3.0",
        "worst[1] < worst[0] < FAILURE": "(worst == FAILURE).all()",
    },
    "capture": {
        "[0.5, 7.0, 12.0]": "[0.5, 1.0, 1.5]",
        # Until the fingers hold the bar; tests/diagrams/satellite/test_capture.py waits longer.
        "RolloutTask(scenario, 20.0": "RolloutTask(scenario, 13.0",
        "last == Mode.HOLD": "last == Mode.RETREAT",
        "horizon=16.0": "horizon=8.5",
        "[0.5, 1.0, 2.0, 4.0, 16.0]": "[2.0]",
    },
    "cart_pole": {},
    "controller": {
        '"dps.impl.circle_duration": 1.5, "dps.impl.press_duration": 1.8': '"dps.impl.circle_duration": 1.1, '
        '"dps.impl.press_duration": 1.2',
        "(Motion.HOME, 1450)": "(Motion.HOME, 1050)",
    },
    "crater": {
        "heading_reasoner(scenario)": "heading_reasoner(scenario, candidates=3, executor='serial')",
        "import explain, passes": "import COUNTERFACTUALS, explain, passes\n\n"
        "del COUNTERFACTUALS['boulders'], COUNTERFACTUALS['the gully']",
        "explain(scenario, failing)": "explain(scenario, failing, executor='serial')",
        "most=2, count=20": "most=1, count=4",
    },
    "forest": {
        "width=640, height=400": "width=160, height=100",
        "length=25.0": "length=2.0",
        "cycles=200": "cycles=60",
        "PARTED, END = 18.0, 25.0": "PARTED, END = 3.0, 5.0",
    },
    "payload": {
        "values=[0, 20, 30, 40, 60]": "values=[0, 60]",
        "resolution=2.0, coarse=10.0": "resolution=5.0, coarse=15.0",
        "horizon=15.0": "horizon=10.0",
    },
    "perceived": {},
    "steering": {
        "study.run(rollouts=60": "study.run(rollouts=20",
        '"budget", rollouts=120': '"budget", rollouts=40',
        "study.run(rollouts=120": "study.run(rollouts=40",
        'solver="bayesian", seed=1).run(rollouts=120': 'solver="bayesian", seed=1).run(rollouts=20',
    },
}


# Numbers in the text that are neither in the code nor in what it prints: years, volumes and sections of papers; the
# tolerance and the rays of the scan frequency's study; the error of the forest's poor map.
GIVEN = {
    "calibration": {"31", "2024"},
    "camera": {"1288"},
    "capture": {"18.5", "750"},
    "cart_pole": {"2014"},
    "controller": {"2014"},
    "forest": {"6.2", "0.35"},
    "payload": {"2014"},
}


def test_every_notebook_has_a_test() -> None:
    names = {path.stem for path in FOLDER.glob("*.ipynb")}
    assert names
    assert set(SHORTER) == names


def test_every_notebook_is_smaller_than_1_mb() -> None:
    sizes = {path.name: path.stat().st_size for path in FOLDER.glob("*.ipynb")}
    assert {name: size for name, size in sizes.items() if size > LARGEST} == {}


@pytest.mark.parametrize("name", SHORTER)
def test_is_stored_with_text_and_plots(name: str) -> None:
    check_stored(name)


@pytest.mark.parametrize("name", SHORTER)
def test_numbers_in_the_text_are_those_of_the_code(name: str) -> None:
    check_numbers(name, given=GIVEN.get(name, ()))


@pytest.mark.slow
@pytest.mark.parametrize("name", SHORTER)
def test_runs(name: str) -> None:
    check_runs(name, shorter=SHORTER[name])
