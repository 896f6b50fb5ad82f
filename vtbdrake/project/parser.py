"""A model file in Drake's parser: plants of it, and the parser's errors and warnings as messages about the file."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType

from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.common.failures import one_line
from vtbdrake.project.model_copy import copy_model
from vtbdrake.project.robot import RobotFileError

# The file and the line with which a message of Drake's parser begins.
_PLACE = re.compile(r"([^\s:]*:\d+): ")
_SEE_ALSO = " See https://drake.mit.edu/troubleshooting.html for additional resources."


def parse(plant: MultibodyPlant, model: Path, packages: Mapping[str, Path] = MappingProxyType({})) -> None:
    """Add a model file to a plant.

    Args:
        plant: The plant, which is changed.
        model: The file.
        packages: The folders of the packages that it names.
    """
    parser = Parser(plant)
    for name, folder in packages.items():
        parser.package_map().Add(name, str(folder))
    parser.AddModels(str(model))


def add_model(plant: MultibodyPlant, model: Path, packages: Mapping[str, Path] = MappingProxyType({})) -> None:
    """Add the model file of a project to a plant, without the parser's warnings, which ``vtbdrake new`` printed.

    Args:
        plant: The plant, which is changed.
        model: The file.
        packages: The folders of the packages that it names.
    """
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        parse(plant, model, packages)
    finally:
        logger.setLevel(level)


class ModelParser:
    """Makes plants of one model file, by the copy that a project gets.

    Attributes:
        path: The file.
        shown: How messages name it.
        text: Its text.
        folder: The folder of the copy, which the caller removes.
        copy: What the project gets.
        notes: What is missing or unusual in the file, and what is done about it.
    """

    def __init__(self, path: Path, packages: Mapping[str, Path], folder: Path) -> None:
        """Copy the model.

        Args:
            path: The file.
            packages: The folders of packages by name, which are not searched for.
            folder: Where the copy is written.

        Raises:
            RobotFileError: Drake would read something else than the files say (see `ModelCopy.fault`).
        """
        self.path = path.resolve()
        self.shown = min(str(self.path), os.path.relpath(self.path), key=len)
        self.text = self.path.read_text(encoding="utf-8", errors="replace")
        self.folder = folder
        self.copy = copy_model(self.path, self.shown, packages)
        if self.copy.fault:
            raise RobotFileError(self.copy.fault)
        self.notes: list[str] = list(self.copy.notes)
        self._written = self.copy.write(folder)
        self._folders = {name: folder / root for name, root in self.copy.packages.items()}
        self._warned = _Grouped()

    def load(self) -> tuple[MultibodyPlant, SceneGraph, DiagramBuilder]:
        """Return a plant of the model that is not finalized, with its scene graph, in a builder."""
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
        self.parse(plant)
        return plant, scene_graph, builder

    def parse(self, plant: MultibodyPlant) -> None:
        """Add the model to a plant; what Drake does not read is a `RobotFileError`."""
        with self._noting_warnings():
            try:
                parse(plant, self._written, self._folders)
            except (RuntimeError, ValueError, SystemExit) as error:
                raise self._error(one_line(error)) from error

    def finalize(self, plant: MultibodyPlant) -> None:
        """Finalize a plant of the model; loops of joints are a `RobotFileError`."""
        try:
            with self._noting_warnings():
                plant.Finalize()
        except (RuntimeError, SystemExit) as error:
            if "loop" not in str(error):
                raise self._error(one_line(error)) from error
            where, joint = self._closing_joint()
            raise RobotFileError(
                f"{where}: joints form a loop{joint}, which Drake takes as a constraint only: open each loop at one "
                "joint, and close it by a <drake:ball_constraint> or a <mimic>"
            ) from error

    def _closing_joint(self) -> tuple[str, str]:
        """Return the place of a joint whose child is already the child of another one, and text with its name."""
        children: dict[str, str] = {}
        for joint in self.copy.xml.root.iter("joint") if self.copy.xml is not None else ():
            child = joint.find("child")
            if child is not None:
                link, name = child.get("link") or child.text.strip(), joint.get("name")
                if children.setdefault(link, name) != name:
                    return f"{self.shown}:{joint.line}", f" that {name} closes"
        return self.shown, ""

    def _error(self, message: str) -> RobotFileError:
        """Return an error with file, line (where Drake gives one) and remedy."""
        if "does not exist" in message or "could not be found" in message:
            message += " Put the file there, or take what refers to it out"
        elif "not supported for joint" in message:
            message += " Take it out, or replace it by a fixed, revolute or prismatic joint"
        elif package := re.search(r"unknown package '([^']+)'", message):
            message += f": {self.copy.missing.get(package[1], '')}"
        message = self._in_original(message.replace(_SEE_ALSO, ""))
        return RobotFileError(message if self.shown in message else f"{self.shown}: {message}")

    def _in_original(self, message: str) -> str:
        """Return a message of Drake about the copy as one about the file."""
        message = re.sub(rf"/*{re.escape(str(self._written))}", self.shown, message)
        return message.replace(str(self.folder), str(self.copy.original_folder))

    @contextmanager
    def _noting_warnings(self) -> Iterator[None]:
        """Keep the warnings of Drake's parser for `warnings`."""
        logger, handler = logging.getLogger("drake"), _Collector()
        level, propagate = logger.level, logger.propagate
        logger.addHandler(handler)
        logger.setLevel(logging.WARNING)
        logger.propagate = False
        try:
            yield
        finally:
            logger.removeHandler(handler)
            logger.setLevel(level)
            logger.propagate = propagate
            for message in handler.messages:
                self._warned.add(self._in_original(message))

    def warnings(self) -> Iterator[str]:
        """Yield what Drake's parser warned of, each kind once."""
        return self._warned.sentences()

    def place(self, name: str) -> str:
        """Return file and line where ``name`` is defined, or the file alone."""
        for number, line in enumerate(self.text.splitlines(), 1):
            if re.search(rf"""\bname\s*=\s*["']{re.escape(name)}["']""", line):
                return f"{self.shown}:{number}"
        return self.shown


class _Grouped:
    """Messages about places, those that are alike in one sentence."""

    def __init__(self) -> None:
        self._groups: dict[str, dict[str, None]] = {}

    def add(self, message: str) -> None:
        """Add a message ``FILE:LINE: ...``, unless it is there."""
        _, _, text = message.rpartition(": ") if not _PLACE.match(message) else ("", "", _PLACE.sub("", message))
        key = re.sub(r"'[^']*'|\"[^\"]*\"|[-+.\d]+", "*", text)
        self._groups.setdefault(key, {})[message] = None

    def sentences(self) -> Iterator[str]:
        """Yield the first message of each group, with the number of the further."""
        for messages in self._groups.values():
            first, *further = messages
            place = _PLACE.match(first)
            if further and place:
                yield f"{place[1]} and {len(further)} more of the kind: {_PLACE.sub('', first)}"
            else:
                yield f"{first} ({len(further)} more of the kind)" if further else first


class _Collector(logging.Handler):
    """Collects the first line of each message."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage().partition("\n")[0].replace(": warning:", ":"))
