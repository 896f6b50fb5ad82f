"""The checks of a calibration, on recorded pendulums, arms and legs whose columns are as they should be.

``python -m vtbdrake_diagrams.recorded_arms.alarms FOLDER`` prints it. FOLDER holds the folders of the recordings, as
for `vtbdrake_diagrams.recorded_arms.reality`, dfki_double_pendulum and cassie_impact. Nothing is fitted but inverse
dynamics. Cassie's legs are closed by rods and springs, so that their torques have no inverse dynamics here: of these
landings, clock and columns are checked, as of the others, and with ``--cassie MODEL`` the refusal of its model is
printed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import click
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, RevoluteJoint

import vtbdrake as vtb
from vtbdrake.calibration import CalibrationError, JointModel, JointRecording
from vtbdrake.calibration.inverse_dynamics import InverseDynamics
from vtbdrake.calibration.log_checks import check_log, check_torques, currents
from vtbdrake.cli.output import table
from vtbdrake.common.settings import setting
from vtbdrake.recording import Log, Series
from vtbdrake.recording.log import GAP
from vtbdrake.testbed import Interface, Signal
from vtbdrake_diagrams.cassie_landing import CassieLandingScenario
from vtbdrake_diagrams.cassie_landing import reality as cassie
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario
from vtbdrake_diagrams.double_pendulum import reality as double
from vtbdrake_diagrams.recorded_arms import pendulum, plants, subjects
from vtbdrake_diagrams.torque_driven import TorqueDrivenScenario

PLANTS: dict[str, Callable[[], MultibodyPlant]] = {
    "Panda": plants.panda,
    "TX40": plants.tx40,
    "TIAGo": plants.tiago,
    "KR300": plants.kr300,
    "Go2 left": plants.go2_leg,
    "Go2 right": partial(plants.go2_leg, -1.0),
}
"""The plants of the arms and legs, by the names of their scenarios."""
POSITION = "joint_position"
"""The name of the measured positions in a recording."""
TORQUE = "torque"
"""The name of the torques in a recording."""

# Time between two positions that are used, in s.
_PERIOD = 0.01


@dataclass
class RecordedArmScenario(TorqueDrivenScenario):
    """An arm or leg of `PLANTS`, with a motor at each joint."""

    arm: str = setting("Panda", "Its name.", choices=tuple(PLANTS))
    torque_limit: float = setting(1e5, "The largest torque of a motor: none is known.", unit="N m", gt=0)

    @property
    def size(self) -> int:  # type: ignore[override]
        return PLANTS[self.arm]().num_positions()

    def add_links(self, plant: MultibodyPlant) -> list[RevoluteJoint]:
        published, joints = PLANTS[self.arm](), []
        instance, parent = plant.AddModelInstance("arm"), plant.world_body()
        for index in published.GetJointIndices():
            joint = published.get_joint(index)
            body = plant.AddRigidBody(joint.child_body().name(), instance, joint.child_body().default_spatial_inertia())
            X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
            mount = plant.AddFrame(FixedOffsetFrame(f"{joint.name()}_mount", parent.body_frame(), X_PF, instance))
            kind = PrismaticJoint if isinstance(joint, PrismaticJoint) else RevoluteJoint
            axis = joint.translation_axis() if kind is PrismaticJoint else joint.revolute_axis()
            joints.append(plant.AddJoint(kind(joint.name(), mount, body.body_frame(), axis)))
            plant.AddJointActuator(joint.name(), joints[-1], self.torque_limit)
            parent = body
        return joints


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recording with a scenario of its machine.

    Attributes:
        name: Its name.
        log: The recording, with positions and torques.
        scenario: The scenario.
        parameters: The numbers that are fitted.
        period: The time between two positions that are used, in s.
    """

    name: str
    log: Log
    scenario: TorqueDrivenScenario
    parameters: tuple[vtb.Parameter, ...]
    period: float = _PERIOD

    def alarms(self) -> tuple[float, list[str]]:
        """Return the share of the torques' power that is not explained, and what the checks say, as sentences."""
        model = JointModel(self.scenario.build(), self.parameters, measured_torque=True)
        share = float("nan")
        try:
            checks = [check_log(self.log, self.scenario.interface(), position=POSITION, torque=TORQUE)]
            whole = JointRecording.of(self.log, model, position=POSITION, torque=TORQUE, period=self.period)
            recordings, dynamics = whole.pieces(longest=GAP), InverseDynamics(model)
            fit = dynamics.fit(recordings, start=model.start)
            share = fit.share
            checks.append(check_torques(model, dynamics, recordings, fit))
            likely = currents(model, dynamics, recordings)
        except CalibrationError as error:
            return share, [f"refused: {error}"]
        remarks = [f"remark: {each}" for check in checks for each in check.remarks]
        doubts = [f"doubt: {each}" for check in checks for each in check.doubts]
        return share, [*remarks, *doubts, *(f"cause, if nothing is accepted: {each}" for each in likely)]


def recorded(folder: Path) -> Iterator[Recorded]:
    """Yield the recordings of a folder."""
    yield from of_double_pendulum(folder / "dfki_double_pendulum")
    ranges = tuple(vtb.Parameter(address, *ends) for address, ends in pendulum.RANGES.items())
    for path in sorted((data := folder / "dfki_simple_pendulum" / "results").rglob("data_measured*.csv")):
        scenario = pendulum.TorqueLimitedPendulumScenario()
        name = path.relative_to(data).as_posix().replace("/data_measured", " ").removesuffix(".csv").rstrip()
        yield Recorded(f"pendulum {name}", pendulum.read(path), scenario, ranges, pendulum.FIT_PERIOD)
    yield of_arm("Panda", subjects.panda_recording(folder / "panda_gaz2019"))
    yield of_arm("TX40", subjects.tx40_recording(folder / "figaroh"))
    yield of_arm("TIAGo", subjects.tiago_recording(folder / "figaroh"))
    for movement in subjects.kr300_recordings(folder / "kuka_kr300"):
        yield of_arm("KR300", movement)
    for leg in subjects.go2_recordings(folder / "go2_leg"):
        yield of_arm("Go2 left" if leg.source.endswith("L") else "Go2 right", leg)


def column_alarms(log: Log) -> list[str]:
    """Return what the checks of clock and columns say of a landing of Cassie, as sentences.

    Args:
        log: The landing, with the positions of the joints with encoders and the torques of the motors.
    """
    torques = CassieLandingScenario().interface().act
    interface = Interface(sense=[Signal(POSITION, size=len(cassie.ENCODED), unit="rad")], act=torques)
    try:
        checks = check_log(log, interface, position=POSITION, torque=torques[0].name)
    except CalibrationError as error:
        return [f"refused: {error}"]
    return [*(f"remark: {each}" for each in checks.remarks), *(f"doubt: {each}" for each in checks.doubts)]


def of_double_pendulum(folder: Path) -> list[Recorded]:
    """Return the excitation runs of the double pendulum, and its swing-ups."""
    ranges = tuple(vtb.Parameter(address, *ends) for address, ends in double.RANGES.items())
    logs = [*double.recordings(folder), *double.swing_ups(folder)]
    return [Recorded(f"double pendulum {k}", log, DoublePendulumScenario(), ranges) for k, log in enumerate(logs)]


def of_arm(arm: str, recording: JointRecording) -> Recorded:
    """Return the recording of an arm or leg, with friction and rotor of each joint to be fitted.

    Args:
        arm: Its name in `PLANTS`.
        recording: Positions and torques.
    """
    largest = abs(recording.u).max(axis=0).tolist()
    laws = ("coulomb", "viscous")
    friction = [vtb.Parameter(f"sim.act.drives.{law}[{k}]", 0.0, u) for law in laws for k, u in enumerate(largest)]
    plant = PLANTS[arm]()
    joints = [plant.get_joint(index).name() for index in plant.GetJointIndices()]
    rotors = [
        vtb.Parameter(f"sim.sys.arm.{name}.rotor_inertia", 0.0, u) for name, u in zip(joints, largest, strict=True)
    ]
    log = Log(
        recording.source,
        {POSITION: Series(recording.times, recording.q)},
        {TORQUE: Series(recording.times, recording.u)},
    )
    scenario = RecordedArmScenario(arm=arm, coulomb=0.0, viscous=0.0)
    return Recorded(f"{arm} {recording.source}", log, scenario, (*friction, *rotors))


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--cassie", "model", type=click.Path(exists=True, dir_okay=False), help="cassie_v2.urdf.")
def main(folder: Path, model: str | None) -> None:
    """Check the recordings in FOLDER."""
    rows, sentences = [], []
    for each in recorded(folder):
        share, alarms = each.alarms()
        rows.append([each.name, f"{each.log.end - each.log.start:.3g} s", f"{share:.2g}", str(len(alarms))])
        sentences += [f"{each.name}: {alarm}" for alarm in alarms]
    for log in cassie.logs(folder / "cassie_impact", position=POSITION, torque=TORQUE):
        alarms = column_alarms(log)
        rows.append([f"Cassie {log.source}", f"{log.end - log.start:.3g} s", "columns only", str(len(alarms))])
        sentences += [f"Cassie {log.source}: {alarm}" for alarm in alarms]
    click.echo(table(["recording", "duration", "unexplained", "alarms"], rows))
    click.echo("\n".join(sentences))
    if model is not None:
        try:
            JointModel(CassieLandingScenario(model=model).build(), measured_torque=True)
        except CalibrationError as error:
            click.echo(f"Cassie's model: {error}")


if __name__ == "__main__":
    main()
