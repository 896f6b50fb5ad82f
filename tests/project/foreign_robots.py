"""Robots of others: is a project written for each, does it pass its own tests, does it drive its simulated machine?

Run ``python -m tests.project.foreign_robots``, for a few with ``--only TEXT``. The packages are fetched by pip, once,
into the folder of ``--cache``. A model that cannot be a robot is not in the list: worlds, objects, and a file that is
empty (``ur3.urdf``).
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass
from io import StringIO
from multiprocessing.connection import Connection
from pathlib import Path

import pydrake
import pytest

from vtbdrake.project import ProjectError, RobotFileError, read_robot, write_project

ROOT = Path(__file__).parents[2]
CACHE = Path(tempfile.gettempdir()) / "vtbdrake-foreign-robots"

EXAMPLE_ROBOT_DATA = "example-robot-data"
ROBOSUITE = "robosuite"
GYMNASIUM = "gymnasium"
GYMNASIUM_ROBOTICS = "gymnasium-robotics"
DRAKE = "drake"
# Source -> what pip fetches.
PACKAGES = {
    EXAMPLE_ROBOT_DATA: "example-robot-data==6.0.0",
    ROBOSUITE: "robosuite==1.5.2",
    GYMNASIUM: "gymnasium==1.4.0",
    GYMNASIUM_ROBOTICS: "gymnasium-robotics==1.4.2",
}

# Source -> folder in the package, and the models in it.
_MODELS = {
    EXAMPLE_ROBOT_DATA: (
        "cmeel.prefix/share/example-robot-data/robots",
        """
        a1_description/urdf/a1.urdf
        alex_description/urdf/alex_nub_hands.urdf
        alex_description/urdf/alex_psyonic_hands.urdf
        alex_description/urdf/alex_sake_hands.urdf
        alexander_description/urdf/alexander_v1.lowerBodyOnly.urdf
        allegro_hand_description/urdf/allegro_left_hand.urdf
        allegro_hand_description/urdf/allegro_right_hand.urdf
        anymal_b_simple_description/robots/anymal-kinova.urdf
        anymal_b_simple_description/robots/anymal.urdf
        anymal_c_simple_description/urdf/anymal.urdf
        asr_twodof_description/urdf/TwoDofs.urdf
        b1_description/urdf/b1-z1.urdf
        b1_description/urdf/b1.urdf
        baxter_description/urdf/baxter.urdf
        bolt_description/robots/bolt.urdf
        borinot_description/urdf/borinot_flying_arm_2.urdf
        cassie_description/robots/cassie.sdf
        cassie_description/robots/cassie_v2.sdf
        centauro_description/urdf/centauro.urdf
        double_pendulum_description/urdf/double_pendulum.urdf
        double_pendulum_description/urdf/double_pendulum_continuous.urdf
        double_pendulum_description/urdf/double_pendulum_simple.urdf
        finger_edu_description/robots/finger_edu.urdf
        g1_description/urdf/g1_29dof_rev_1_0.urdf
        g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf
        go1_description/urdf/go1.urdf
        go2_description/urdf/go2.urdf
        hector_description/robots/quadrotor_base.urdf
        hextilt_description/urdf/hextilt_flying_arm_5.urdf
        human_description/robots/human.urdf
        hyq_description/robots/hyq_no_sensors.urdf
        icub_description/robots/icub.urdf
        icub_description/robots/icub_reduced.urdf
        iris_description/robots/iris.urdf
        iris_description/robots/iris_simple.urdf
        kinova_description/robots/kinova.urdf
        laikago_description/urdf/laikago.urdf
        panda_description/urdf/panda.urdf
        panda_description/urdf/panda_collision.urdf
        pr2_description/urdf/pr2.urdf
        quadruped_description/urdf/quadruped.urdf
        romeo_description/urdf/romeo.urdf
        romeo_description/urdf/romeo_laas_small.urdf
        romeo_description/urdf/romeo_small.urdf
        simple_humanoid_description/urdf/simple_humanoid.urdf
        simple_humanoid_description/urdf/simple_humanoid_classical.urdf
        so_arm_description/urdf/so100.urdf
        so_arm_description/urdf/so101.urdf
        solo_description/robots/solo.urdf
        solo_description/robots/solo12.urdf
        talos_data/robots/talos_full_v2.urdf
        talos_data/robots/talos_full_v2_box.urdf
        talos_data/robots/talos_left_arm.urdf
        talos_data/robots/talos_reduced.urdf
        talos_data/robots/talos_reduced_box.urdf
        talos_data/robots/talos_reduced_corrected.urdf
        tiago_description/robots/tiago.urdf
        tiago_description/robots/tiago_dual.urdf
        tiago_description/robots/tiago_no_hand.urdf
        tiago_pro_description/robots/tiago_pro.urdf
        ur_description/urdf/ur10_joint_limited_robot.urdf
        ur_description/urdf/ur10_robot.urdf
        ur_description/urdf/ur3_gripper.urdf
        ur_description/urdf/ur3_joint_limited_robot.urdf
        ur_description/urdf/ur3_robot.urdf
        ur_description/urdf/ur5_gripper.urdf
        ur_description/urdf/ur5_joint_limited_robot.urdf
        ur_description/urdf/ur5_robot.urdf
        xarm_description/urdf/xarm7.urdf
        z1_description/urdf/z1.urdf
        """,
    ),
    ROBOSUITE: (
        "robosuite/models/assets",
        """
        grippers/bd_gripper.xml
        grippers/fourier_left_hand.xml
        grippers/inspire_left_hand.xml
        grippers/jaco_three_finger_gripper.xml
        grippers/panda_gripper.xml
        grippers/rethink_gripper.xml
        grippers/robotiq_gripper_140.xml
        grippers/robotiq_gripper_85.xml
        grippers/robotiq_gripper_s.xml
        grippers/xarm7_gripper.xml
        robots/baxter/robot.xml
        robots/gr1/robot.xml
        robots/iiwa/robot.xml
        robots/jaco/robot.xml
        robots/kinova3/robot.xml
        robots/panda/robot.xml
        robots/sawyer/robot.xml
        robots/spot/robot.xml
        robots/spot_arm/robot.xml
        robots/tiago/robot.xml
        robots/ur5e/robot.xml
        robots/xarm7/robot.xml
        """,
    ),
    GYMNASIUM: (
        "gymnasium/envs/mujoco/assets",
        """
        ant.xml
        half_cheetah.xml
        hopper.xml
        humanoid.xml
        inverted_double_pendulum.xml
        inverted_pendulum.xml
        point.xml
        pusher_v5.xml
        reacher.xml
        swimmer.xml
        walker2d_v5.xml
        """,
    ),
    GYMNASIUM_ROBOTICS: (
        "gymnasium_robotics/envs/assets",
        """
        adroit_hand/adroit_door.xml
        adroit_hand/adroit_hammer.xml
        fetch/pick_and_place.xml
        fetch/reach.xml
        hand/manipulate_block.xml
        hand/reach.xml
        kitchen_franka/kitchen_assets/kitchen_env_model.xml
        """,
    ),
    DRAKE: (
        "examples",
        """
        acrobot/Acrobot.sdf
        acrobot/Acrobot.urdf
        kuka_iiwa_arm/models/desk/transcendesk55inch.sdf
        multibody/cart_pole/cart_pole.sdf
        pendulum/Pendulum.urdf
        planar_gripper/planar_brick.sdf
        planar_gripper/planar_gripper.sdf
        """,
    ),
}


# The tests that depend on the robot; the others test what is the same for all.
OF_THE_ROBOT = "holds or stands or hovers or moves or shifts or believed or drives"
# The time after which a robot is given up, in s.
_LONGEST = 1800.0
# A server that has imported everything; every robot gets a fork.
_FORKS = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(["vtbdrake.project", "vtbdrake.testing.checks", "vtbdrake.testing.lock_step", "pytest"])


@dataclass(frozen=True)
class ForeignRobot:
    """A model file of a package.

    Attributes:
        source: The package.
        path: The path within the package's folder of models.
    """

    source: str
    path: str

    def __str__(self) -> str:
        return f"{self.source}:{self.path}"

    def file(self, cache: Path) -> Path:
        """Return the model file, which `fetch` has brought."""
        package = Path(pydrake.getDrakePath()) if self.source == DRAKE else cache / self.source
        return (package / _MODELS[self.source][0] / self.path).resolve()

    @property
    def name(self) -> str:
        """The name of its project."""
        words = [word for word in re.split(r"\W", self.path) if word not in ("urdf", "xml", "sdf", "robots", "models")]
        return "_".join(["my", *(word for word in words[-2:] if word)]).lower()


ROBOTS = [ForeignRobot(source, path) for source, (_, paths) in _MODELS.items() for path in paths.split()]


@dataclass
class Outcome:
    """Result of a robot: whether its project was written, and passes its tests.

    Attributes:
        robot: The robot, as ``SOURCE:PATH``.
        joints: The number of its joints.
        written: Whether its project was written.
        refused: The message with which its file was refused.
        built: Whether its testbed can be built.
        tests: Whether its tests pass.
        driven: Whether it drives its simulated machine.
        failures: The tests that fail, and what they raise.
        seconds: Its processor time, with the processes that it starts, in s.
    """

    robot: str
    joints: int = 0
    written: bool = False
    refused: str = ""
    built: bool = False
    tests: bool = False
    driven: bool = False
    failures: str = ""
    seconds: float = 0.0


def fetch(cache: Path, sources: Sequence[str]) -> None:
    """Bring the packages by pip, those that are not in the cache.

    Raises:
        ConnectionError: pip cannot bring one of them.
    """
    for source in sources:
        if source not in PACKAGES or (cache / source).is_dir():
            continue
        with tempfile.TemporaryDirectory(dir=cache.parent) as folder:
            command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", f"{folder}/package"]
            done = subprocess.run([*command, PACKAGES[source]], capture_output=True, text=True)
            if done.returncode != 0:
                raise ConnectionError(f"pip cannot bring {PACKAGES[source]}: {done.stderr.strip().splitlines()[-1:]}")
            cache.mkdir(exist_ok=True)
            try:
                (Path(folder) / "package").rename(cache / source)
            except OSError:  # Another process has brought it meanwhile.
                if not (cache / source).is_dir():
                    raise


def try_robot(robot: ForeignRobot, cache: Path, folder: Path, *, tests: str | None = "") -> Outcome:
    """Write the project of a robot, and run its tests in a process of their own.

    Args:
        robot: The robot.
        cache: The folder of `fetch`.
        folder: Where its project is written.
        tests: Which of its tests run, as pytest's ``-k`` selects them; None for none.
    """
    receiver, sender = _FORKS.Pipe(duplex=False)
    process = _FORKS.Process(target=_try_robot, args=(sender, robot, cache, folder, tests))
    process.start()
    sender.close()
    failures = f"it takes longer than {_LONGEST:g} s"
    try:
        if receiver.poll(_LONGEST):
            return Outcome(**receiver.recv())
    except EOFError:
        failures = "its process has died"
    finally:
        process.kill()
        process.join()
    return Outcome(str(robot), failures=failures)


def _try_robot(sender: Connection, robot: ForeignRobot, cache: Path, folder: Path, tests: str | None) -> None:
    outcome = Outcome(str(robot))
    try:
        model = read_robot(robot.file(cache))
        project = write_project(folder, robot.name, model)
    except (RobotFileError, ProjectError) as error:
        outcome.refused = str(error)
    else:
        outcome.written, outcome.joints = True, len(model.joints)
        if tests is not None:
            _run_tests(project, outcome, tests)
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    outcome.seconds = round(sum(usage.ru_utime + usage.ru_stime for usage in usages), 2)
    sender.send(asdict(outcome))


class _Results:
    """A plugin of pytest: how many tests passed, and the last line of what each other one raised."""

    def __init__(self) -> None:
        self.passed = 0
        self.failures: dict[str, str] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Take note of a test."""
        self.passed += report.passed and report.when == "call"
        if report.failed:
            self._note(report)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Take note of a module that cannot be imported."""
        if report.failed:
            self._note(report)

    def _note(self, report: pytest.TestReport | pytest.CollectReport) -> None:
        raised = [line[1:].strip() for line in report.longreprtext.splitlines() if line.startswith("E ")]
        self.failures[report.nodeid.rpartition("::")[2]] = (raised or [report.longreprtext])[0]


def _run_tests(project: Path, outcome: Outcome, selection: str) -> None:
    results = _Results()
    os.chdir(project)
    sys.path[:0] = [str(project), str(ROOT)]
    with redirect_stdout(StringIO()):
        status = pytest.main(["-q", "-p", "no:cacheprovider", "--tb=short", "-k", selection], plugins=[results])
    outcome.tests = status == pytest.ExitCode.OK
    outcome.built = results.passed > 0
    outcome.driven = outcome.built and not any("machine" in test for test in results.failures)
    outcome.failures = "; ".join(f"{test}: {raised}" for test, raised in results.failures.items())


def table(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Yield the lines of the table of outcomes, by source."""
    yield "| source | models | written | pass their tests | drive their machine | refused |"
    yield "|---|---|---|---|---|---|"
    for source in [*_MODELS, "all"]:
        rows = [o for o in outcomes if source == "all" or o.robot.startswith(f"{source}:")]
        if rows:
            counts = [sum(bool(getattr(o, name)) for o in rows) for name in ("written", "tests", "driven", "refused")]
            yield f"| {source} | {len(rows)} | " + " | ".join(map(str, counts)) + " |"


def read_outcomes(file: Path, *, again: bool = False) -> list[Outcome]:
    """Return the outcomes in a file.

    Args:
        file: The file, with an outcome in JSON on each line.
        again: Whether the file forgets those that do not pass.
    """
    outcomes = [Outcome(**json.loads(line)) for line in file.read_text("utf-8").splitlines()]
    if again:
        outcomes = [outcome for outcome in outcomes if not (outcome.refused or outcome.failures)]
        file.write_text("".join(json.dumps(asdict(outcome)) + "\n" for outcome in outcomes), "utf-8")
    return outcomes


def main() -> None:
    """Try the robots, one after the other, and print what became of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="TEXT", action="append", help="only robots with this text in their name")
    parser.add_argument("--quick", action="store_true", help="only the tests that depend on the robot, and the machine")
    parser.add_argument("--no-tests", action="store_true", help="write the projects only")
    parser.add_argument("--shuffle", metavar="SEED", type=int, help="try them in this random order")
    parser.add_argument("--cache", type=Path, default=CACHE, help="where the packages are kept [%(default)s]")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the outcomes there, and go on where it ends")
    parser.add_argument("--again", action="store_true", help="try again those in FILE that do not pass")
    arguments = parser.parse_args()
    robots = [robot for robot in ROBOTS if not arguments.only or any(text in str(robot) for text in arguments.only)]
    if arguments.shuffle is not None:
        random.Random(arguments.shuffle).shuffle(robots)
    fetch(arguments.cache, sorted({robot.source for robot in robots}))
    file: Path | None = arguments.json
    outcomes = read_outcomes(file, again=arguments.again) if file and file.exists() else []
    done = {outcome.robot for outcome in outcomes}
    selection = None if arguments.no_tests else OF_THE_ROBOT if arguments.quick else ""
    with tempfile.TemporaryDirectory() as folder:
        for robot in robots:
            if str(robot) in done:
                continue
            place = Path(tempfile.mkdtemp(dir=folder))
            outcome = try_robot(robot, arguments.cache, place, tests=selection)
            outcomes.append(outcome)
            if file:
                with file.open("a") as stream:
                    stream.write(json.dumps(asdict(outcome)) + "\n")
            what = outcome.refused or outcome.failures or "passes"
            print(f"{robot}: {outcome.seconds:.0f} s: {what}", flush=True)
    for line in table(outcomes):
        print(line)
    for outcome in outcomes:
        if outcome.refused or outcome.failures:
            print(f"{outcome.robot}: {outcome.refused or outcome.failures}")


if __name__ == "__main__":
    main()
