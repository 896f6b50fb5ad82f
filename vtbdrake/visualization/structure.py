"""What a drawing of a testbed shows: its parts by role, its signals, and where their switches stand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pydrake.geometry import MeshcatVisualizer
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context, Diagram, System

from vtbdrake.testbed import Signal, VirtualTestbed
from vtbdrake.testbed.switch import BOARD, T_ACT, T_SENSE

ROLES = ("sense", "sys", "act", "env")


@dataclass(frozen=True)
class Wire:
    """A signal, where its switch stands ("" for a command, which has none), and the simulated system at its end.

    The constant commands of the testbed have no system at their end.
    """

    signal: Signal
    position: str
    part: str

    @property
    def on_sim(self) -> bool:
        return self.position in ("sim", "twin")

    @property
    def on_real(self) -> bool:
        return self.position in ("real", "twin")

    def shape(self) -> str:
        """Its size or type, and its unit: ``2 [rad, rad/s]``."""
        signal = self.signal
        kind = f"{signal.size}" if signal.is_vector else type(signal.model_value).__name__
        return kind if signal.unit == "1" else f"{kind} [{signal.unit}]"


@dataclass(frozen=True)
class Structure:
    """Figure 4 of one testbed.

    Attributes:
        name: of its scenario's class.
        dps: class of the DPS; empty if it is a plain Diagram.
        dps_parts: the DPS's subsystems.
        world: role -> simulated parts; role is sense, sys, act or env, or ``other`` for what was added without one.
        sense, act, commands: the signals.
    """

    name: str
    dps: str
    dps_parts: tuple[str, ...]
    world: dict[str, tuple[str, ...]]
    sense: tuple[Wire, ...]
    act: tuple[Wire, ...]
    commands: tuple[Wire, ...]


def structure_of(testbed: VirtualTestbed, context: Context | None = None) -> Structure:
    """What is to be drawn; switches as they stand in ``context``, or as the testbed was built."""
    positions = testbed.positions(context if context is not None else testbed.default_context())
    ends = _Ends(testbed.diagram)
    interface = testbed.interface
    dps = testbed.dps
    return Structure(
        name=type(testbed.scenario).__name__ if testbed.scenario is not None else "virtual testbed",
        dps=_class_name(dps),
        dps_parts=tuple(str(s.get_name()) for s in dps.GetSystems()) if isinstance(dps, Diagram) else (),
        world=_world(testbed),
        sense=tuple(
            # Input 0 of a switch is its selector, input 1 what it takes while it stands on sim.
            Wire(s, positions["sense"][s.name], ends.source(f"{T_SENSE}{s.name}", 1))
            for s in interface.sense
        ),
        act=tuple(Wire(s, positions["act"][s.name], ends.target(f"{T_ACT}{s.name}.sim")) for s in interface.act),
        commands=tuple(
            Wire(s, "", ends.source("dps", int(dps.GetInputPort(s.name).get_index()))) for s in interface.commands
        ),
    )


class _Ends:
    """Which system is at the other end of a connection, by name."""

    def __init__(self, diagram: Diagram) -> None:
        self._sources: dict[tuple[str, int], str] = {}
        self._targets: dict[str, str] = {}
        for (to, port), (origin, _) in diagram.connection_map().items():
            source, target = str(origin.get_name()), str(to.get_name())
            self._sources[target, int(port)] = source
            self._targets[source] = target

    def source(self, system: str, port: int) -> str:
        name = self._sources.get((system, port), "")
        return "" if name == BOARD else name

    def target(self, system: str) -> str:
        return self._targets.get(system, "")


def short(name: str) -> str:
    """A simulated part without ``sim.<role>.``."""
    parts = name.split(".", 2)
    return parts[2] if len(parts) == 3 and parts[0] == "sim" and parts[1] in ROLES else name


def _class_name(system: System) -> str:
    """Nothing for Drake's plain Diagram, which says nothing."""
    name = type(system).__name__
    return "" if name == "Diagram" else name.rstrip("_")


def _world(testbed: VirtualTestbed) -> dict[str, tuple[str, ...]]:
    found: dict[str, list[str]] = {role: [] for role in (*ROLES, "other")}
    for role, name in _plant_instances(testbed):
        found[role].append(f"plant: {name}")
    for system in testbed.diagram.GetSystems():
        if not _is_framework(testbed, system):
            parts = str(system.get_name()).split(".", 2)
            known = len(parts) == 3 and parts[0] == "sim" and parts[1] in ROLES
            found[parts[1] if known else "other"].append(short(str(system.get_name())))
    return {role: tuple(names) for role, names in found.items() if names or role != "other"}


def _is_framework(testbed: VirtualTestbed, system: System) -> bool:
    name = str(system.get_name())
    own = system in (testbed.dps, testbed.plant, testbed.scene_graph) or isinstance(system, MeshcatVisualizer)
    return own or name == BOARD or name.startswith((T_SENSE, T_ACT))


def _plant_instances(testbed: VirtualTestbed) -> Iterator[tuple[str, str]]:
    """(role, name) of the plant's model instances that have bodies, and of the world if something is fixed to it."""
    plant = testbed.plant
    if plant is None:
        return
    world = plant.world_body()
    if plant.GetVisualGeometriesForBody(world) or plant.GetCollisionGeometriesForBody(world):
        yield "env", "world"
    for index in range(1, plant.num_model_instances()):
        instance = ModelInstanceIndex(index)
        name = str(plant.GetModelInstanceName(instance))
        if plant.GetBodyIndices(instance):
            in_sys = any(address.startswith(f"sim.sys.{name}.") for address in testbed.variables())
            yield ("sys" if in_sys else "env"), name
