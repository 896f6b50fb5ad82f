"""Everything that a user can get wrong is one line on stderr, and an exit code."""

import socket
from pathlib import Path

import pytest

from tests.cli.program import ACROBOT, ANGLE, PENDULUM, RATE, error_of, run
from tests.folders import open_folder, that_cannot_be_written

SERVO, BUS = "tests.control.servo_machine:ServoMachineScenario", ["--url", "tcpq://127.0.0.1:1"]
VARY = ["--vary", f"{ANGLE}=0:1:2", "--horizon", "1"]
NEGATIVE = ["--quality", f"{__name__}:negative", "--of", RATE]
SWEEP = ["sweep", PENDULUM, *VARY, "--quality", RATE]
ROLLOUT = ["rollout", ACROBOT, "--horizon", "0.1"]
BOUNDARY = ["boundary", PENDULUM, "--vary", f"{ANGLE}=0:1", "--horizon", "1", "--quality", RATE, "--threshold", "1"]


def negative(_: float) -> float:
    """No quality."""
    return -1.0


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["variables", "nowhere.at_all:Scenario"], "cannot import nowhere.at_all"),
        (["variables", "tests.testbeds:Pendulum"], "it has: PendulumScenario"),
        (["variables", "tests.testbeds"], "package.module:Class"),
        (["variables", "tests.testbeds:Scenario"], "is abstract: it lacks the methods add_world, interface, make_dps"),
        (["variables", "none.yaml"], "no scenario file none.yaml"),
        (["variables", PENDULUM, "--match", "thetta"], "no address contains 'thetta'"),
        (
            ["variables", PENDULUM, "--field", "stifness=2"],
            "'stifness' of a plain type; did you mean stiffness?",
        ),
        (["variable", PENDULUM], "No such command 'variable'"),
        (["view", PENDULUM, "--certificate", __file__], "--certificate and --key go with --tls"),
        (["view", PENDULUM, "--host", "0.0.0.0"], "expected NAME:PORT of a proxy that offers the page"),
        (["view", PENDULUM, "--host", "0.0.0.0:80"], "this is no address to listen on"),
        (["view", PENDULUM, "--key", __file__], "--certificate and --key go with --tls"),
        ([*ROLLOUT, "--set", "dps.gian=1"], "did you mean dps.gain"),
        ([*ROLLOUT, "--set", "dps.gain=[1,2]"], "has shape (4,)"),
        ([*ROLLOUT, "--set", "dps.gain=[1,2,3,NaN]"], "must be finite"),
        ([*ROLLOUT, "--set", "dps.gain=stiff"], "a number or a JSON list of numbers, not 'stiff'"),
        ([*ROLLOUT, "--set", "dps.gain=1,2"], "in brackets, and in quotes for the shell: 'dps.gain=[1,2]'"),
        ([*ROLLOUT, "--set", "dps.ticks=true"], "a number or a JSON list of numbers, not 'true'"),
        ([*ROLLOUT, "--set", "dps.gain"], "ADDRESS=VALUE, not 'dps.gain'"),
        ([*ROLLOUT, "--set", "dps.ticks=1", "--set", "dps.ticks=2"], "dps.ticks is set twice"),
        ([*ROLLOUT, "--set", "time=1"], "derived"),
        ([*ROLLOUT, "--set", "sim.sys.Acrobot.upper_link.mass=-1"], "must lie in [0, inf] kg"),
        ([*ROLLOUT, "--record", "dps.torqe"], "did you mean dps.torque"),
        ([*ROLLOUT, "--record", "plant.body_poses", "--save", "a.csv"], "plant.body_poses is not numeric"),
        ([*ROLLOUT, "--save", "a.csv"], "nothing is recorded"),
        ([*ROLLOUT, "--record", "dps.torque", "--save", "a.txt"], ".csv or .npz"),
        ([*ROLLOUT, "--snapshot", "no/such/folder/s"], "a folder that does not exist"),
        ([*ROLLOUT, "--snapshot", "."], "is a folder"),
        ([*ROLLOUT, "--start", "none.vtb"], "none.vtb: No such file"),
        ([*ROLLOUT, "--sample-period", "1"], "at most the horizon"),
        (["rollout", ACROBOT, "--horizon", "-1"], "the horizon t_m must be positive"),
        (["rollout", ACROBOT], "Missing option '--horizon'"),
        (["rollout", "--horizon", "1"], "Missing argument 'SCENARIO'"),
        ([*SWEEP, "--threshold", "-1"], "must not be negative"),
        ([*SWEEP, "--executor", "cluster"], "'auto', 'serial', 'threads', 'processes'"),
        ([*SWEEP, "--executor", "serial", "--workers", "2"], "executor='serial' has no workers, but workers=2"),
        ([*SWEEP, "--workers", "0"], "x>=1"),
        ([*SWEEP, "--of", RATE], "--of belongs to a quality module:function"),
        ([*SWEEP, "--vary", f"{ANGLE}=0:2:2"], "a parameter is given twice"),
        ([*SWEEP, "--set", f"{ANGLE}=1"], "no condition can set it"),
        ([*SWEEP, "--condition", f"{RATE}=1;{RATE}=2"], "is set twice"),
        ([*SWEEP, "--set", f"{RATE}=1", "--condition", f"{RATE}=2"], "is set twice"),
        ([*SWEEP, "--plot", "a.txt"], ".png or .svg or .pdf"),
        (["sweep", PENDULUM, *VARY, "--quality", "math:hypo", "--of", RATE], "math has no function 'hypo'"),
        (["sweep", PENDULUM, *VARY, "--quality", "nowhere:f", "--of", RATE], "cannot import nowhere"),
        (["sweep", PENDULUM, *VARY, "--quality", "math:hypot"], "needs its arguments: add --of ADDRESS"),
        (["sweep", PENDULUM, *VARY, "--quality", "sim.sys.Pendulum.theta.velocty"], "did you mean"),
        (["sweep", PENDULUM, *VARY, *NEGATIVE, "--on-error", "raise"], "finite and not negative"),
        (["sweep", PENDULUM, "--horizon", "1", "--quality", RATE, "--vary", f"{ANGLE}=0:1"], "LOWER:UPPER:POINTS"),
        (["sweep", PENDULUM, "--horizon", "1", "--quality", RATE, "--vary", f"{ANGLE}=a:1:2"], "with numbers"),
        (["sweep", PENDULUM, "--horizon", "1", "--quality", RATE, "--vary", f"{ANGLE}=1:0:2"], "lower < upper"),
        (["sweep", PENDULUM, "--horizon", "1", "--quality", RATE, "--vary", f"{ANGLE}=0:1:1"], "at least two points"),
        ([*BOUNDARY, "--resolution", "0.5", "--coarse", "0.1"], "0 < resolution <= coarse"),
        ([*BOUNDARY, "--resolution", "0.5"], "Missing option '--coarse'"),
        (["get", "a", "--url", "nonsense"], "such as tcpq://127.0.0.1:7700, not 'nonsense'"),
        (["run", SERVO, "--url", "memq://"], "'memq://' is private to this process and reaches no other"),
        (["diagram", PENDULUM, "-o", "pendulum.xyz"], "expected a file name that ends in .svg, not 'pendulum.xyz'"),
        (["watch", "a", "--url", ""], "such as tcpq://127.0.0.1:7700, not ''"),
        (
            ["machine", SERVO, "--url", "tcpq://127.0.0.1:99999"],
            "'tcpq://127.0.0.1:99999' has no valid port",
        ),
        (["machine", SERVO, *BUS, "--noise", "position"], "expected SIGNAL=STD, a number, not 'position'"),
        (["get", "a", *BUS, "--timeout", "nan"], "'--timeout': expected a positive time in seconds, not nan"),
        (["run", SERVO, *BUS, "--seconds", "-1"], "'--seconds': expected a positive time in seconds, not -1"),
        (["run", SERVO, *BUS, "--wait", "0"], "'--wait': expected a positive time in seconds, not 0"),
        (["diagram", PENDULUM, "--mode", "dream"], "'sim', 'shadow', 'real', 'twin'"),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], expected: str, tmp_path: Path) -> None:
    assert expected in error_of(*arguments, cwd=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_recording_is_not_overwritten(tmp_path: Path) -> None:
    (log := tmp_path / "run.lcm").write_text("dear")
    error = error_of("run", SERVO, *BUS, "--record", log)
    assert f"{log} exists, and is not overwritten: give another name" in error
    assert log.read_text() == "dear"


def test_where_nothing_can_be_written_is_told_before_anything_is_done() -> None:
    with open_folder() as folder, that_cannot_be_written(folder):
        error = error_of(*SWEEP, "--csv", f"{folder}/a.csv")
    assert "'--csv'" in error and f"{folder}/a.csv lies in a folder that you cannot write to" in error


def test_scenario_file_with_an_unknown_key(tmp_path: Path) -> None:
    path = tmp_path / "typo.yaml"
    path.write_text(f"{PENDULUM}:\n  stiffnes: 3.0\n")
    assert "stiffnes" in error_of("variables", path)


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("{file}", "names the scenario never.imported:Scenario, and to import its module runs its code"),
        (PENDULUM + "@{file}", f"is of the scenario never.imported:Scenario, not of {PENDULUM}"),
        (PENDULUM + "@{folder}", "after package.module:Class@ comes the name of a .yaml file"),
        (PENDULUM + "@none.yaml", "there is no scenario file none.yaml"),
        (PENDULUM + "@/dev/null/a.yaml", "there is no scenario file /dev/null/a.yaml"),
    ],
)
def test_a_file_has_no_module_imported(tmp_path: Path, source: str, expected: str) -> None:
    (tmp_path / "s.yaml").write_text("never.imported:Scenario:\n  a: 1\n")
    given = source.format(file=tmp_path / "s.yaml", folder=tmp_path)
    assert expected in error_of("variables", given)


def test_scenario_file_that_names_no_class_is_named(tmp_path: Path) -> None:
    path = tmp_path / "odd.yaml"
    path.write_text("a: {b: 1}\n")
    assert error_of("variables", path).startswith(f"Error: {path}: a scenario is named package.module:Class")


def test_snapshot_of_another_scenario(tmp_path: Path) -> None:
    path = str(tmp_path / "s")
    assert run(*ROLLOUT, "--snapshot", path).exit_code == 0
    assert "of another scenario" in error_of("rollout", PENDULUM, "--horizon", "1", "--start", path)


def test_damaged_snapshot(tmp_path: Path) -> None:
    path = tmp_path / "s"
    path.write_bytes(b"PK\x03\x04 and no more")
    assert "damaged" in error_of(*ROLLOUT, "--start", path)


SERIAL = ("--executor", "serial")


def test_sweep_without_a_success_has_exit_code_1() -> None:
    vary = ["--vary", "sim.sys.Acrobot.elbow.position=0:1:2", "--set", "sim.sys.Acrobot.lower_link.mass=0"]
    error = error_of("sweep", ACROBOT, *vary, "--quality", "dps.torque", "--horizon", "1", *SERIAL, code=1)
    assert "all 2 rollouts failed; the first: RuntimeError: An internal mass matrix" in error


def test_failures_are_listed_below_the_table_once() -> None:
    vary = ["--vary", "sim.sys.Acrobot.lower_link.mass=0:1:2", "--quality", "dps.torque", "--horizon", "0.1"]
    result = run("sweep", ACROBOT, *vary, *SERIAL)
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert [line.split()[-1] for line in lines[2:4]] == ["failed", "horizon"]
    assert lines[4].startswith("failed (1): RuntimeError: An internal mass matrix")
    assert lines[-1] == "best: h = 0 at sim.sys.Acrobot.lower_link.mass = 1 kg (the upper end of its range)"


def test_a_quality_that_fails_everywhere_is_told_below_the_table() -> None:
    result = run("sweep", PENDULUM, *VARY, *NEGATIVE)
    assert result.exit_code == 1
    assert "failed (2): QualityError: the quality function negative" in result.stdout
    assert "Error: all 2 rollouts failed; the first: QualityError" in result.stderr


def test_traceback_on_request() -> None:
    result = run("--traceback", "variables", "none.yaml")
    assert type(result.exception).__name__ == "ScenarioError"


def test_a_port_that_is_taken_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        message = error_of("view", PENDULUM, "--port", port, "--no-browser")
    assert f"port {port} cannot be used" in message and "or 0 for any that is free" in message
