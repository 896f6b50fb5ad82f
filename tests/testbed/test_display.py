"""Objects show themselves in one line, and in a notebook as a picture or a table."""

import numpy as np
import pytest
from IPython.core.completer import provisionalcompleter
from IPython.core.interactiveshell import InteractiveShell

from tests.testbeds import AcrobotScenario
from vtbdrake.rollout import Constraint, Quality, RolloutRunner, RolloutTask
from vtbdrake.testbed import DpsAlone, Interface, Signal
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

ELBOW = "sim.sys.Acrobot.elbow.position"


@pytest.fixture(scope="module")
def testbed():
    return AcrobotScenario(period=0.05).build()


def distance(x):
    return abs(x)


def rollout(quality=None, **point):
    return RolloutRunner(RolloutTask(AcrobotScenario(), 0.1, quality)).run({ELBOW: 0.5, **point})


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda testbed: testbed, "VirtualTestbed(AcrobotScenario(period=0.05), "),
        (lambda testbed: DpsAlone(AcrobotScenario()), "DpsAlone(AcrobotScenario(), "),
        (lambda testbed: testbed.variables(), " addresses that begin with "),
        (lambda testbed: testbed.variables()[ELBOW], f"Variable('{ELBOW}', kind='x', shape=(), unit='rad')"),
        (lambda testbed: testbed.snapshot(testbed.default_context()), "Snapshot(t=0 s, AcrobotScenario, "),
        (lambda testbed: testbed.interface, "Interface(sense=[joint_state], act=[torque], commands=[])"),
        (
            lambda testbed: testbed.interface.act[0],
            "Signal('torque', size=1, unit='N m', lower=-10, upper=10, idle=0)",
        ),
        (lambda testbed: Signal("q", size=9, upper=np.arange(9.0)), "Signal('q', size=9, upper=[0., ..., 8.])"),
        (lambda testbed: Signal("T", model_value=Interface((), ())), "Signal('T', model_value=<Interface>)"),
        (lambda testbed: Quality(distance, of=ELBOW), f"Quality(distance, of=['{ELBOW}'])"),
        (lambda testbed: Quality(distance, of=ELBOW, minimize=True), "minimize=True)"),
        (
            lambda testbed: Constraint(distance, of=ELBOW, at_most=1.0),
            f"Constraint(distance, of=['{ELBOW}'], at_most=1.0)",
        ),
        (lambda testbed: rollout(), f"RolloutResult({{{ELBOW}=0.5}}: horizon after 0.1 s)"),
        (lambda testbed: rollout(Quality(distance, of="time")), "horizon after 0.1 s, value 0.1 at t* = 0.1 s)"),
    ],
)
def test_repr_is_one_line(testbed, make, expected):
    shown = repr(make(testbed))
    assert expected in shown
    assert "\n" not in shown


def test_a_testbed_shows_its_diagram(testbed):
    picture = testbed._repr_html_()
    assert "<svg" in picture
    assert "joint_state" in picture


def test_variables_show_a_table(testbed):
    table = testbed.variables()._repr_html_()
    assert f"<td>{ELBOW}</td>" in table
    assert table.count("<tr>") == 1 + len(testbed.variables())


def test_a_snapshot_shows_its_values(testbed):
    table = testbed.snapshot(testbed.default_context())._repr_html_()
    assert f"<td>{ELBOW}</td><td>0.</td>" in table


def test_the_dps_alone_shows_its_signals():
    shown = DpsAlone(AcrobotScenario())._repr_html_()
    assert "<td>sensor</td><td>joint_state</td><td>4</td>" in shown
    assert "<td>actuator</td><td>torque</td><td>1</td>" in shown


@pytest.mark.parametrize("owner", ["variables", "snapshot"])
def test_ipython_completes_addresses(owner):
    climber = SpaceClimberScenario().build()
    objects = {"variables": climber.variables(), "snapshot": climber.snapshot(climber.default_context())}
    shell = InteractiveShell()
    shell.user_ns.update(objects)
    text = f'{owner}["dps.impl.gait.st'
    with provisionalcompleter():
        found = [completion.text for completion in shell.Completer.completions(text, len(text))]
    assert any("dps.impl.gait.stroke" in text for text in found)
