"""Campaigns: what they show of rollouts that are known otherwise, and how they are resumed."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from contextlib import suppress
from math import comb
from pathlib import Path
from xml.etree import ElementTree

import jsonschema
import numpy as np
import pytest
import yaml
from scipy.stats import beta

from tests.campaigns.campaign_functions import start
from tests.cli.program import ANGLE, DAMPING, RATE, ROOT, error_of, run
from tests.testbeds import PendulumScenario
from vtbdrake import Problem, Quality, Study
from vtbdrake.campaigns.campaign import Campaign, CampaignError, Criterion
from vtbdrake.campaigns.report import limits_text, range_text, reason
from vtbdrake.campaigns.results import CampaignRollout, Cell, PairedComparison, interval, largest_rate, least_rate
from vtbdrake.cli.campaign import campaign as command
from vtbdrake.optimization.study.study_error import StudyError

pytestmark = pytest.mark.one_python

FUNCTIONS = "tests.campaigns.campaign_functions"
STATED = {
    "scenario": "tests.testbeds:PendulumScenario",
    "horizon": 0.3,
    "sample_period": 0.1,
    "conditions": {"free": {}, "damped": {DAMPING: 2.0}, "pushed": {RATE: 2.0}},
    "seeds": {"first": 3, "count": 8, "draw": f"{FUNCTIONS}:start"},
    "criteria": {
        "small angle": {"of": ANGLE, "f": "builtins:abs", "at_most": 0.7, "unit": "rad"},
        "low at the end": {"of": [ANGLE], "reading": "end", "at_most": 0.3, "at_least": -0.3, "rate": 0.2},
        "speed": {"of": RATE, "reading": "end"},
    },
}


def written(folder: Path, name: str = "pendulum.yaml", **changes: object) -> Path:
    """Write the file of a campaign."""
    path = folder / name
    path.write_text(yaml.safe_dump({**STATED, **changes}, sort_keys=False))
    return path


def run_campaign(path: Path, *arguments: object, code: int = 1) -> str:
    result = run("campaign", path, "--executor", "serial", *arguments)
    assert result.exit_code == code, result.output
    return result.stdout


def results(path: Path) -> dict:
    return json.loads((path.with_suffix("") / "results.json").read_text())


def true_angles(values: dict[str, float]) -> np.ndarray:
    """Return the angles at all samples of one rollout that is stated without a campaign."""
    problem = Problem(
        scenario=PendulumScenario(),
        parameters=[],
        quality=Quality(abs, of=ANGLE),
        horizon=0.3,
        sample_period=0.1,
        conditions=[values],
    )
    return problem.rollout([], record=[ANGLE, RATE]).record[ANGLE]


@pytest.mark.parametrize(("k", "n"), [(0, 5), (5, 5), (7, 40), (39, 40), (40, 40)])
def test_intervals_are_quantiles_of_the_beta_distribution(k: int, n: int) -> None:
    low, high = interval(k, n, 0.9)
    assert low == pytest.approx(beta.ppf(0.05, k, n - k + 1) if k else 0.0)
    assert high == pytest.approx(beta.ppf(0.95, k + 1, n - k) if k < n else 1.0)
    assert least_rate(k, n, 0.9) == pytest.approx(beta.ppf(0.1, k, n - k + 1) if k else 0.0)
    assert largest_rate(k, n, 0.9) == pytest.approx(beta.ppf(0.9, k + 1, n - k) if k < n else 1.0)


@pytest.mark.parametrize(("gained", "lost"), [(0, 0), (0, 5), (6, 0), (2, 9), (10, 10), (1, 7)])
def test_mcnemar_counts_coin_tosses(gained: int, lost: int) -> None:
    n, rarer = gained + lost, min(gained, lost)
    tail = sum(comb(n, k) for k in range(rarer + 1)) / 2**n
    comparison = PairedComparison("free", "small angle", 3, gained, lost, 4)
    assert comparison.p == pytest.approx(min(1.0, 2.0 * tail))
    expected = "none shown" if comparison.p >= 0.05 else "better" if gained > lost else "worse"
    assert comparison.difference == expected


@pytest.mark.slow
def test_a_campaign_counts_what_its_rollouts_do(tmp_path: Path) -> None:
    path = written(tmp_path)
    run_campaign(path)
    reported = results(path)
    assert not reported["met"] and reported["complete"] and reported["seeds"] == [3, 10]
    assert reported["conditions"] == STATED["conditions"]
    numbers = {(r["condition"], r["seed"]): r["values"] for r in reported["rollouts"]}
    assert len(numbers) == 24
    cells = {(cell["condition"], cell["criterion"]): cell for cell in reported["cells"]}
    total = 0
    for name, values in STATED["conditions"].items():
        angles = {seed: true_angles({**values, **start(seed)}) for seed in range(3, 11)}
        for seed, angle in angles.items():
            assert numbers[name, seed]["small angle"] == np.abs(angle).max()
            assert numbers[name, seed]["low at the end"] == angle[-1]
        passed = sum(np.abs(angle).max() <= 0.7 for angle in angles.values())
        cell = cells[name, "small angle"]
        assert (cell["pass"], cell["fail"], cell["rate"]) == (passed, 8 - passed, passed / 8)
        assert cell["verdict"] == ("met" if passed == 8 else "missed")
        sizes = [np.abs(angle).max() for angle in angles.values()]
        assert (cell["least"], cell["largest"]) == (min(sizes), max(sizes))
        assert cell["mean"] == pytest.approx(np.mean(sizes))
        low = sum(abs(angle[-1]) <= 0.3 for angle in angles.values())
        shown = beta.ppf(0.05, low, 9 - low) if low else 0.0
        refuted = low < 8 and beta.ppf(0.95, low + 1, 8 - low) < 0.2
        verdict = "met" if shown >= 0.2 else "missed" if refuted else "undecided"
        assert cells[name, "low at the end"]["verdict"] == verdict
        assert "verdict" in cells[name, "speed"] and "pass" not in cells[name, "speed"]
        total += passed
    assert cells["all conditions", "small angle"]["pass"] == total
    for rollout in reported["rollouts"]:
        angle = rollout["values"]
        passes = angle["small angle"] <= 0.7 and abs(angle["low at the end"]) <= 0.3
        assert rollout["status"] == ("pass" if passes else "fail")
    assert cells["all conditions", "small angle"]["verdict"] == "reported"
    assert {cell["verdict"] for cell in cells.values()} >= {"met", "missed"}


@pytest.mark.parametrize(("unit", "shown"), [("1", "3"), ("", "3"), ("rad", "3 rad")])
def test_a_number_without_a_unit_has_none_behind_it(unit: str, shown: str) -> None:
    criterion = Criterion(of=ANGLE, at_most=3.0, unit=unit)
    rollout = CampaignRollout(condition="free", seed=1, end="horizon", message="", values={"angle": 3.0})
    cell = Cell("angle", criterion, "free", (rollout,))
    assert limits_text(criterion) == f"at most {shown}, in every rollout"
    assert range_text(cell) == reason(cell, rollout) == shown


def test_junit_has_a_case_for_every_requirement(tmp_path: Path) -> None:
    path = written(tmp_path)
    run_campaign(path, "--no-evidence")
    verdicts = {(c["condition"], c["criterion"]): c["verdict"] for c in results(path)["cells"]}
    root = ElementTree.parse(path.with_suffix("") / "junit.xml").getroot()
    assert root.tag == "testsuites"
    cases = {(suite.get("name"), case.get("name")): case for suite in root for case in suite.iter("testcase")}
    judged = {key: verdict for key, verdict in verdicts.items() if verdict != "reported"}
    assert cases.keys() == judged.keys()
    for key, verdict in judged.items():
        outcomes = [child.tag for child in cases[key]]
        assert outcomes == ([] if verdict == "met" else ["failure"])
        assert cases[key].get("classname") == f"pendulum.{key[0]}"
    failures = sum(verdict != "met" for verdict in judged.values())
    assert (root.get("tests"), root.get("failures"), root.get("errors")) == (str(len(judged)), str(failures), "0")
    for suite in root:
        assert suite.get("tests") == str(len(list(suite.iter("testcase"))))
        assert suite.get("failures") == str(len(list(suite.iter("failure"))))


def test_seeds_that_change_nothing_are_named(tmp_path: Path) -> None:
    path = written(tmp_path, conditions={"free": {}, "damped": {DAMPING: 1.0}}, seeds={"count": 3, "set": [RATE]})
    assert "Warning" not in run_campaign(path)
    path = written(tmp_path, "still.yaml", seeds={"count": 3, "set": ["u.angle"]}, conditions={"free": {ANGLE: 0.5}})
    warning = "All seeds give the same numbers under: free. If they change nothing there"
    assert warning in run_campaign(path, code=0)
    assert warning in (path.with_suffix("") / "index.html").read_text()


def test_a_failed_rollout_is_an_error_and_has_not_passed(tmp_path: Path) -> None:
    criteria = {"scale": {"of": ANGLE, "f": f"{FUNCTIONS}:small", "at_most": 1.0}}
    path = written(tmp_path, criteria=criteria, conditions={"far": {RATE: 6.0}, "still": {RATE: 0.0}})
    printed = run_campaign(path)
    cells = {(c["condition"], c["criterion"]): c for c in results(path)["cells"]}
    far, still = cells["far", "scale"], cells["still", "scale"]
    assert far["error"] + far["pass"] == 8 and far["error"] and not far["fail"] and far["verdict"] == "missed"
    assert still["error"] == sum(abs(a) > 0.9 for seed in range(3, 11) for a in start(seed).values())
    assert "beyond the scale" in printed
    root = ElementTree.parse(path.with_suffix("") / "junit.xml").getroot()
    assert (
        root.get("errors") == str(bool(far["error"]) + bool(still["error"]))
        and "beyond the scale" in root.find(".//error").text
    )
    page = (path.with_suffix("") / "index.html").read_text()
    assert "ArithmeticError: beyond the scale" in page and 'class="error"' in page


@pytest.mark.one_python
@pytest.mark.slow
def test_a_rollout_that_kills_its_process_does_not_kill_the_campaign(tmp_path: Path) -> None:
    criteria = {"safe": {"of": ANGLE, "f": f"{FUNCTIONS}:crashing", "at_most": 2.0}}
    conditions = {"far": {ANGLE: 1.0}, "near": {ANGLE: 0.1}}
    path = written(tmp_path, criteria=criteria, conditions=conditions, seeds={"count": 1})
    printed = run("campaign", path, "--executor", "processes", "--workers", 1)
    assert printed.exit_code == 1, printed.output
    cells = {c["condition"]: c for c in results(path)["cells"]}
    assert (cells["far"]["error"], cells["near"]["verdict"]) == (1, "met")
    assert "far/0: failed: its worker process died" in printed.stdout
    assert "its worker process died" in (path.with_suffix("") / "index.html").read_text()


@pytest.mark.slow
def test_a_red_cell_has_its_command_log_and_animation(tmp_path: Path) -> None:
    path = written(tmp_path)
    run_campaign(path)
    folder, reported = path.with_suffix(""), results(path)
    first = next(r for r in reported["rollouts"] if r["condition"] == "pushed" and r["values"]["small angle"] > 0.7)
    name = f"pushed/{first['seed']}"
    page = (folder / "index.html").read_text()
    assert f"vtbdrake campaign {path} --rollout {name}" in page
    (log,) = folder.glob(f"*-pushed-{first['seed']}.npz")
    assert f'href="{log.name}"' in page and f'href="{log.with_suffix(".html").name}"' in page
    assert "setMeshcat" in (animation := log.with_suffix(".html").read_text()) or "meshcat" in animation
    angles = true_angles({RATE: 2.0, **start(first["seed"])})
    recorded = np.load(log)
    assert (recorded[ANGLE] == angles).all() and recorded["t"][-1] == pytest.approx(0.3)
    log.unlink()
    alone = run("campaign", path, "--rollout", name)
    assert alone.exit_code == 1 and log.exists()
    since = 0.1 * int(np.argmax(np.abs(angles) > 0.7))
    (row,) = [line for line in alone.stdout.splitlines() if line.startswith("small angle")]
    assert "fail" in row and float(row.split()[-2]) == pytest.approx(since)
    assert f"{first['values']['small angle']:.6g} rad" in row


@pytest.mark.slow
def test_a_killed_campaign_is_resumed_to_the_same_bytes(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in "ab"]
    for folder in folders:
        folder.mkdir()
    whole, killed = (written(folder, seeds={**STATED["seeds"], "count": 30}) for folder in folders)
    run_campaign(whole, "--no-evidence")
    study = killed.with_suffix("") / "study.db"
    process = subprocess.Popen(
        [sys.executable, "-m", "vtbdrake", "campaign", killed, "--executor", "serial", "--no-evidence"],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    count = 0
    while count < 20:
        with suppress(subprocess.TimeoutExpired):
            raise AssertionError(f"the campaign ended with {process.wait(0.02)} before it was killed")
        if study.exists():
            with suppress(StudyError), Study.open(study) as opened:  # It may be just being created.
                count = len(opened)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (killed.with_suffix("") / "results.json").exists()
    with Study.open(study) as opened:
        assert 20 <= len(opened) < 90
        before = opened.finished
    run_campaign(killed, "--no-evidence")
    with Study.open(study) as opened:
        assert len(opened) == 90 and before.items() <= opened.finished.items()
    for name in ("results.json", "junit.xml", "index.html"):
        resumed = (killed.with_suffix("") / name).read_bytes()
        assert resumed.replace(bytes(folders[1]), bytes(folders[0])) == (whole.with_suffix("") / name).read_bytes()


def test_rollouts_that_were_not_run_yet_are_reported(tmp_path: Path) -> None:
    path = written(tmp_path)
    assert "--seconds" in [option for p in command.params for option in p.opts]
    run_campaign(path, "--seconds", 1e-9)
    reported = results(path)
    assert not reported["complete"] and {c["not run"] for c in reported["cells"] if "pass" in c} == {8, 24}
    root = ElementTree.parse(path.with_suffix("") / "junit.xml").getroot()
    assert root.get("skipped") == "6" and root.get("failures") == "0"
    run_campaign(path, "--no-evidence")
    assert results(path)["complete"]


@pytest.mark.slow
def test_more_seeds_and_other_limits_keep_the_rollouts(tmp_path: Path) -> None:
    path, other = written(tmp_path), written(tmp_path, "other.yaml", seeds={**STATED["seeds"], "count": 10})
    run_campaign(path, "--no-evidence")
    study = path.with_suffix("") / "study.db"
    with Study.open(study) as opened:
        before = opened.finished
    written(tmp_path, seeds={**STATED["seeds"], "count": 10})
    run_campaign(path, "--no-evidence")
    run_campaign(other, "--no-evidence")
    assert results(path)["rollouts"] == results(other)["rollouts"]
    with Study.open(study) as opened:
        assert len(opened) == 30 and before.items() <= opened.finished.items()
        after = opened.finished
    loose = {"small angle": {**STATED["criteria"]["small angle"], "at_most": 3.0}}
    criteria = {**STATED["criteria"], **loose}
    criteria["low at the end"] = {**criteria["low at the end"], "rate": 1e-3}
    written(tmp_path, seeds={**STATED["seeds"], "count": 10}, criteria=criteria)
    run_campaign(path, code=0)
    with Study.open(study) as opened:
        assert opened.finished == after
    assert results(path)["met"]


@pytest.mark.slow
def test_a_baseline_is_compared_pair_by_pair(tmp_path: Path) -> None:
    base = written(tmp_path, "base.yaml")
    run_campaign(base, "--no-evidence")
    path = written(tmp_path, conditions={"free": {DAMPING: 3.0}, "damped": {DAMPING: 2.0}, "pushed": {RATE: -2.0}})
    run_campaign(path, "--against", base, "--no-evidence")
    here, there = ({(r["condition"], r["seed"]): r["values"] for r in results(p)["rollouts"]} for p in (path, base))
    for comparison in results(path)["comparisons"]:
        if comparison["criterion"] != "small angle":
            continue
        keys = [key for key in here if comparison["condition"] in (key[0], "all conditions")]
        passes = [(here[key]["small angle"] <= 0.7, there[key]["small angle"] <= 0.7) for key in keys]
        expected = [passes.count(pair) for pair in ((True, True), (True, False), (False, True), (False, False))]
        assert [comparison[key] for key in ("both", "gained", "lost", "neither")] == expected
    with_yaml = results(path)
    run_campaign(path, "--against", base.with_suffix("") / "study.db", "--no-evidence")
    assert results(path) == with_yaml
    assert "McNemar" in (path.with_suffix("") / "index.html").read_text()


def test_a_criterion_over_all_conditions_is_judged_once(tmp_path: Path) -> None:
    pooled = {**STATED["criteria"]["small angle"], "over": "all", "rate": 0.2, "conditions": ["free", "damped"]}
    path = written(tmp_path, criteria={"small angle": pooled})
    run_campaign(path, code=0)
    cells = {c["condition"]: c for c in results(path)["cells"]}
    assert cells.keys() == {"free", "damped", "all conditions"}
    assert {name: cell["verdict"] for name, cell in cells.items()} == {
        "free": "reported",
        "damped": "reported",
        "all conditions": "met",
    }
    assert cells["all conditions"]["pass"] == cells["free"]["pass"] + cells["damped"]["pass"]


def test_a_rollout_stops_above_its_threshold(tmp_path: Path) -> None:
    duration = {"duration": {"of": "time", "reading": "end", "at_most": 0.25}}
    path = written(tmp_path, criteria=duration, stop={"of": ANGLE, "f": "builtins:abs", "above": 0.8})
    run_campaign(path, "--no-evidence")
    ends = {(r["condition"], r["seed"]): r["values"]["duration"] for r in results(path)["rollouts"]}
    angles = true_angles({RATE: 2.0, **start(5)})
    beyond = np.flatnonzero(np.abs(angles) > 0.8)
    assert ends["pushed", 5] == pytest.approx(0.1 * beyond[0] if beyond.size else 0.3)
    assert len({round(end, 6) for end in ends.values()}) > 1


def test_the_schema_accepts_what_can_be_loaded(tmp_path: Path) -> None:
    printed = run("campaign", "--schema")
    schema = json.loads(printed.stdout)
    jsonschema.validate(STATED, schema)
    for wrong in ({"criterion": {}}, {"criteria": {"a": {"atmost": 1.0}}}, {"horizon": -1.0}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**STATED, **wrong}, schema)


SMALL = STATED["criteria"]["small angle"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scenario": ""}, "a campaign has a scenario"),
        ({"scenario": "tests.testbeds:PendulumScenari"}, "has no scenario 'PendulumScenari'"),
        ({"scenario": "tests.nowhere:Scenario"}, "cannot import tests.nowhere"),
        ({"conditions": {}}, "a campaign has conditions"),
        ({"conditions": {"far": {"sim.sys.Pendulum.theta.positon": 1.0}}}, "did you mean sim.sys.Pendulum.theta.posi"),
        ({"conditions": {"far": {RATE: "fast"}}}, f"{RATE} takes numbers"),
        ({"conditions": {"far": {"scenario.stifness": 1.0}}}, "stiffness"),
        ({"conditions": {"far": 3}}, "Campaign.conditions[far] must be a mapping, not 3"),
        ({"conditions": {"a/b": {}}}, "names without a slash, other than 'all conditions', not 'a/b'"),
        ({"conditions": {"all conditions": {}}}, "not 'all conditions'"),
        ({"conditions": {"far": {1: 2.0}}}, "there is no variable '1'"),
        ({"criteria": {1: {**SMALL, "f": "builtins:absolute"}}}, "criteria.1: builtins has no function 'absolute'"),
        ({"criteria": {"a": None}}, "criteria.a is a mapping of of, f, at_most"),
        ({"values": {1: 2.0}}, "there is no variable '1'"),
        ({"values": 3}, "Campaign.values must be a mapping, not 3"),
        ({"seeds": 5}, "seeds is a mapping of first, count, set, draw, not 5"),
        ({"scenario": None}, "a campaign has a scenario"),
        ({"conditions": {"far": {ANGLE: 1.0}}}, "is set by the seeds, and by the condition 'far'"),
        ({"criteria": {}}, "a campaign has criteria"),
        (
            {"criteria": {"a": {**SMALL, "atmost": 1.0}}},
            "Criterion has no field 'criteria.a.atmost'; did you mean at_m",
        ),
        ({"criteria": {"a": {**SMALL, "f": "builtins:absolute"}}}, "criteria.a: builtins has no function 'absolute'"),
        ({"criteria": {"a": {**SMALL, "f": "no such function"}}}, "criteria.a: a function is named package.module"),
        ({"criteria": {"a": {**SMALL, "of": "sim.nothing"}}}, "sim.nothing"),
        ({"criteria": {"a": {"at_most": 1.0}}}, "criteria.a: a quality needs at least one quality variable"),
        ({"criteria": {"a": {**SMALL, "rate": 1.5}}}, "Campaign.criteria[a].rate must be a number"),
        ({"criteria": {"a": {**SMALL, "reading": "last"}}}, "reading must be one of best, worst, end, integral"),
        ({"criteria": {"a": {**SMALL, "at_least": 0.1}}}, "criteria.a: at_most and at_least have different worst num"),
        ({"criteria": {"a": {**SMALL, "conditions": ["wet"]}}}, "there is no condition 'wet'; there are: free, damped"),
        ({"criteria": {"a": 3}}, "criteria.a is a mapping of of, f, at_most"),
        ({"criteria": [3]}, "criteria must be a mapping"),
        ({"seeds": {"count": 3}}, "3 seeds change nothing"),
        ({"seeds": {"count": 0, "set": [RATE]}}, "count must be a whole number of at least 1, not 0"),
        ({"seeds": {"set": ["nowhere"], "count": 2}}, "nowhere"),
        ({"seeds": {"draw": "builtins:draw"}}, "builtins has no function 'draw'"),
        ({"seeds": {"draw": "builtins:len"}}, "builtins:len(0) raises TypeError"),
        ({"seeds": {"draw": "builtins:abs"}}, "returns {address: value}, not 0"),
        (
            {"conditions": {"free": {ANGLE: float("nan")}}},
            f"Campaign.conditions[free][{ANGLE}] must be finite, not nan",
        ),
        ({"horizon": "long"}, "horizon must be a finite number above 0 s, not 'long'"),
        ({"stop": {"above": 1.0}}, "a quality needs at least one quality variable"),
        ({"condition": {}}, "Campaign has no field 'condition'; did you mean conditions?"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path: Path, changes: dict, message: str) -> None:
    path = written(tmp_path, **changes)
    printed = error_of("campaign", path)
    assert message in printed and "pendulum.yaml" in printed
    assert not path.with_suffix("").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "its content is no mapping"),
        ("[1, 2]", "its content is no mapping"),
        ("scenario: [", "is not YAML"),
        ("conditions: {far: {}, near: {}, far: {}}", "has the key 'far' twice"),
        ("criteria: {a: {}, a: {}}", "has the key 'a' twice"),
    ],
)
def test_a_file_that_is_no_campaign_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "pendulum.yaml"
    path.write_text(text)
    printed = error_of("campaign", path)
    assert message in printed and printed.count("pendulum.yaml") == 1


def test_names_of_conditions_are_kept_as_they_stand(tmp_path: Path) -> None:
    path = written(tmp_path, conditions={})
    path.write_text(path.read_text().replace("conditions: {}", "conditions: {no: {}, 010: {}, 1e-3: {}}"))
    assert [*Campaign.load(path).conditions] == ["no", "010", "1e-3"]


def test_a_missing_file_and_a_missing_rollout_are_named(tmp_path: Path) -> None:
    assert "there is no campaign file nowhere.yaml" in error_of("campaign", "nowhere.yaml")
    path = written(tmp_path)
    assert "there is no rollout wet/3: the conditions are free" in error_of("campaign", path, "--rollout", "wet/3")
    assert "the seeds 3 to 10" in error_of("campaign", path, "--rollout", "free/11")
    assert "expected CONDITION/SEED" in error_of("campaign", path, "--rollout", "free")
    assert "does not exist" in error_of("campaign", path, "--against", tmp_path / "none.db")


def test_a_baseline_without_pairs_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path)
    fewer = written(tmp_path, "fewer.yaml", seeds={**STATED["seeds"], "count": 7})
    renamed = written(tmp_path, "renamed.yaml", criteria={"angle": SMALL})
    turned = {**STATED["criteria"], "speed": {"of": RATE, "reading": "end", "at_least": -9.0}}
    other = written(tmp_path, "turned.yaml", criteria=turned)
    assert "fewer.yaml has other rollouts" in (printed := error_of("campaign", path, "--against", fewer))
    assert "it lacks free/10, damped/10, pushed/10" in printed
    printed = error_of("campaign", path, "--against", renamed)
    assert "other criteria" in printed and "it lacks small angle, low at the end, speed; it has angle" in printed
    assert "'speed' is read in another way there (end, at_least)" in error_of("campaign", path, "--against", other)
    study = tmp_path / "plain.db"
    Problem(scenario=PendulumScenario(), parameters=[], quality=Quality(abs, of=ANGLE), horizon=0.3).study(
        study, solver="grid"
    ).close()
    assert "not one of a campaign" in error_of("campaign", path, "--against", study)


def test_a_study_of_other_rollouts_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path)
    run_campaign(path, "--no-evidence")
    written(tmp_path, seeds={**STATED["seeds"], "count": 7})
    assert "has other rollouts, 24 from free/3 to pushed/10" in error_of("campaign", path)
    written(tmp_path, conditions={**STATED["conditions"], "damped": {DAMPING: 1.0}})
    assert f"was made with other values of {DAMPING} in damped/3" in error_of("campaign", path)
    written(tmp_path, horizon=0.2)
    assert "another problem (horizon: 0.3 there, 0.2 here)" in error_of("campaign", path)


def test_a_campaign_is_an_object(tmp_path: Path) -> None:
    campaign = Campaign.load(written(tmp_path))
    result = campaign.run(executor="serial", progress=False)
    assert result.is_complete and not result.is_met
    assert campaign.run_again("free", 3).rollout == result.rollouts[0]
    with pytest.raises(CampaignError, match="no rollout free/99"):
        campaign.run_again("free", 99)
