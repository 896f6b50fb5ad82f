"""Projects for a robot: from its model file to a tested testbed and a machine."""

from pathlib import Path

from vtbdrake.project.model_scenario import ModelFileScenario
from vtbdrake.project.parser import add_model
from vtbdrake.project.robot import ProjectRobot, RobotFileError, hold_joint, replace_servo
from vtbdrake.project.robot_file import read_robot, resolve
from vtbdrake.project.station_file import StationFile, StationFileError, read_station
from vtbdrake.project.writer import ProjectError, check_name, write_project

SMALL_ARM = Path(__file__).parent / "arm.urdf"
"""The model of a small arm with three joints."""

__all__ = [
    "SMALL_ARM",
    "ModelFileScenario",
    "ProjectError",
    "ProjectRobot",
    "RobotFileError",
    "StationFile",
    "StationFileError",
    "add_model",
    "check_name",
    "hold_joint",
    "read_robot",
    "read_station",
    "replace_servo",
    "resolve",
    "write_project",
]
