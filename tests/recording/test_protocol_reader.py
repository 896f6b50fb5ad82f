"""Logs of lcm-logger, whose messages Drake's publishers fill: the samples, what is missing, and what they serve."""

from __future__ import annotations

from pathlib import Path

import lcm
import numpy as np
import pytest

from tests.calibration.pendulum import ARM, COULOMB, MASS, PendulumScenario, recorded
from tests.recording.lcm_logger import BEGIN, PERIOD, LcmPendulum, write_log
from vtbdrake.calibration import calibrate, compare
from vtbdrake.lcm.protocol import ProtocolError
from vtbdrake.optimization import Parameter
from vtbdrake.recording import DrivenScenario, Log, LogError, feed, read_log, read_table
from vtbdrake.recording.export import export
from vtbdrake.recording.log_format import EVENT
from vtbdrake.recording.replay import replay
from vtbdrake_diagrams.cart_pole import CartPoleScenario


@pytest.fixture(scope="module")
def truth() -> Log:
    return recorded({MASS: 1.4}, 0, seconds=0.4, noise=0.0)


@pytest.fixture(scope="module")
def path(truth: Log, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "lcmlog-2026-11-29.00", truth)


def test_samples_are_those_that_drake_has_published(path: Path, truth: Log) -> None:
    log = read_log(path, LcmPendulum())
    for read, published in ((log.sense["position"], truth.sense["position"]), (log.act["torque"], truth.act["torque"])):
        assert np.array_equal(read.values, published.values)
        np.testing.assert_allclose(read.times, published.times, rtol=0.0, atol=1e-12)
    said = "\n".join(log.remarks)
    assert "recorded by another program: no switches, and no state of the DPS" in said
    assert "2023-11-14T22:13:20.000000 UTC" in said and "channels without a map: CAMERA" in said
    assert "rejected" not in said and "missing" not in said


def test_damaged_events_are_skipped_and_counted(path: Path, truth: Log, tmp_path: Path) -> None:
    events = [event for event in lcm.EventLog(str(path)) if event.channel == "IIWA_STATUS"]
    content = bytearray(path.read_bytes())
    at = [content.index(event.data) - len("IIWA_STATUS") for event in events]
    content[at[20] - EVENT.size] ^= 0xFF  # No sync word any more.
    content[at[40] - EVENT.size + 12] ^= 0x40  # Centuries later.
    content[at[60] + len("IIWA_STATUS")] ^= 0xFF  # Another fingerprint.
    (tmp_path / "damaged").write_bytes(content[: at[90]])
    log = read_log(tmp_path / "damaged", LcmPendulum())
    left = np.delete(np.arange(90), [20, 40, 60])
    assert np.array_equal(log.sense["position"].values, truth.sense["position"].values[left])
    said = "\n".join(log.remarks)
    assert "2 damaged places skipped, the first at byte" in said
    assert "1 event left out, whose times run backwards" in said
    assert "position: 1 of 88 messages on IIWA_STATUS rejected: of another message type" in said


def test_what_a_log_lacks_is_said(path: Path, tmp_path: Path) -> None:
    out = lcm.EventLog(str(tmp_path / "commands"), "w")
    for event in lcm.EventLog(str(path)):
        if event.channel == "IIWA_COMMAND":
            out.write_event(event.timestamp, event.channel, event.data)
    out.close()
    log = read_log(tmp_path / "commands", LcmPendulum())
    assert not log.sense and len(log.act["torque"]) == 100
    assert any("no message on IIWA_STATUS, which carries position" in remark for remark in log.remarks)


def test_log_drives_a_testbed_to_the_recorded_motion(path: Path, truth: Log) -> None:
    log = read_log(path, LcmPendulum())
    testbed = DrivenScenario(scenario=LcmPendulum(), log=log, period=PERIOD).build()
    context = testbed.default_context()
    testbed.write(context, {MASS: 1.4})
    simulator, simulated = testbed.simulator(context), []
    for time in truth.sense["position"].times:
        simulator.AdvanceTo(time)
        simulated.append(float(testbed.read(context, f"{ARM}.pivot.position")))
    columns = {"time": truth.sense["position"].times, "q": np.array(simulated)}
    compared = compare(log, read_table(columns, sense={"position": "q"})).signals["position"]
    assert compared.rmse < 1e-12


def test_dps_runs_on_a_log_that_can_be_replayed(path: Path, truth: Log, tmp_path: Path) -> None:
    fed = feed(read_log(path, LcmPendulum()), LcmPendulum(), tmp_path / "fed.lcm")
    # The DPS of the pendulum holds what it senses.
    seen = fed.actuation["torque"][:, 0]
    assert np.isin(seen[np.isfinite(seen)], truth.sense["position"].values).all() and np.isfinite(seen).sum() > 90
    assert replay(fed).identical
    part = read_table({"time": np.arange(5.0), "q": np.zeros((5, 2))}, sense={"joint_position": "q"})
    with pytest.raises(LogError, match="the table does not feed the DPS of .*CartPoleScenario: after .*joint_velocity"):
        feed(part, CartPoleScenario(), tmp_path / "no.lcm")


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_exported_samples_are_read_back(path: Path, tmp_path: Path, suffix: str) -> None:
    log = read_log(path, LcmPendulum())
    export(log, tmp_path / f"run{suffix}")
    path = tmp_path / f"run{suffix}"
    back = read_table(path, sense={"position": "sense.position"}, act={"torque": "sent.torque"})
    assert back == log


def test_log_of_a_recorder_has_the_same_form(path: Path, tmp_path: Path) -> None:
    fed = feed(read_log(path, LcmPendulum()), LcmPendulum(), tmp_path / "fed.lcm")
    assert read_log(tmp_path / "fed.lcm", LcmPendulum()) == fed.signals


@pytest.mark.slow
def test_mass_is_calibrated_from_a_log(tmp_path: Path) -> None:
    recording = recorded({MASS: 1.4, COULOMB: 0.2}, 0)
    log = read_log(write_log(tmp_path / "swing.01", recording), LcmPendulum())
    parameters = [Parameter(MASS, 0.3, 3.0), Parameter(COULOMB, 0.0, 1.0)]
    result = calibrate(LcmPendulum(), log, parameters, position="position", torque="torque")
    assert result.accepted and result.parameters[MASS].value == pytest.approx(1.4, rel=0.02)
    assert any("recorded by another program" in remark for remark in result.remarks)


def test_log_that_does_not_fit_is_refused_in_one_sentence(path: Path, tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no sample .* no message on CART_POLE_STATE, .* messages on CAMERA, IIWA_COMM"):
        read_log(path, CartPoleScenario())
    with pytest.raises(ProtocolError, match="PendulumScenario has no protocol"):
        read_log(path, PendulumScenario())
    with pytest.raises(LogError, match=r"read through the protocol of its machine: read_log\(path, scenario\)"):
        read_log(path)
    other = lcm.EventLog(str(tmp_path / "other"), "w")
    other.write_event(BEGIN, "IIWA_STATUS", b"\0" * 100)
    other.close()
    with pytest.raises(LogError, match="1 of 1 message on IIWA_STATUS rejected: of another message type"):
        read_log(tmp_path / "other", LcmPendulum())
    (tmp_path / "text").write_text("no log at all")
    with pytest.raises(LogError, match="is not an LCM log: it has no whole event"):
        read_log(tmp_path / "text", LcmPendulum())
