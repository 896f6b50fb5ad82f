"""Figure 4 of a testbed as SVG: reality above, the DPS behind its switches, the simulation below."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from xml.sax.saxutils import escape, quoteattr

from pydrake.geometry import MeshcatVisualizer
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context, Diagram, System

from vtbdrake.common.argument_checks import counted
from vtbdrake.testbed import Signal, VirtualTestbed
from vtbdrake.testbed.switch import BOARD, T_ACT, T_SENSE

ROLES = ("sense", "sys", "act", "env")


@dataclass(frozen=True)
class Wire:
    """A signal, the position of its switch (empty for a command, which has none), and the simulated system at its end.

    The constant commands of the testbed have no system at their end.

    Attributes:
        signal: The signal.
        position: The position of its switch; empty for a command.
        part: The simulated system at its end; empty for a command.
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
        """Return the size or type of the signal with its unit, for example ``2 [rad, rad/s]``."""
        signal = self.signal
        kind = f"{signal.size}" if signal.is_vector else type(signal.model_value).__name__
        return kind if signal.unit == "1" else f"{kind} [{signal.unit}]"


@dataclass(frozen=True)
class Structure:
    """Figure 4 of one testbed.

    Attributes:
        name: The name of its scenario's class.
        dps: Class of the DPS; empty if it is a plain Diagram.
        dps_parts: The DPS's subsystems.
        world: Role -> simulated parts; role is sense, sys, act or env, or ``other`` for what was added without one.
        sense, act, commands: The signals.
    """

    name: str
    dps: str
    dps_parts: tuple[str, ...]
    world: dict[str, tuple[str, ...]]
    sense: tuple[Wire, ...]
    act: tuple[Wire, ...]
    commands: tuple[Wire, ...]


def structure_of(testbed: VirtualTestbed, context: Context | None = None) -> Structure:
    """Return Figure 4 of a testbed, with its switches as in ``context`` (by default, as it was built).

    Args:
        testbed: The testbed.
        context: A root context of the testbed; None: the default context.
    """
    positions = testbed.positions(context if context is not None else testbed.default_context())
    sources: dict[tuple[str, int], str] = {}
    targets: dict[str, str] = {}
    for (to, port), (origin, _) in testbed.diagram.connection_map().items():
        source, target = str(origin.get_name()), str(to.get_name())
        sources[target, int(port)] = "" if source == BOARD else source
        targets[source] = target
    interface = testbed.interface
    dps = testbed.dps
    return Structure(
        name=type(testbed.scenario).__name__ if testbed.scenario is not None else "virtual testbed",
        dps=_class_name(dps),
        dps_parts=tuple(str(s.get_name()) for s in dps.GetSystems()) if isinstance(dps, Diagram) else (),
        world=_world(testbed),
        sense=tuple(
            # Input 0 of a switch is its selector, input 1 its input in position sim.
            Wire(s, positions["sense"][s.name], sources.get((f"{T_SENSE}{s.name}", 1), ""))
            for s in interface.sense
        ),
        act=tuple(Wire(s, positions["act"][s.name], targets.get(f"{T_ACT}{s.name}.sim", "")) for s in interface.act),
        commands=tuple(
            Wire(s, "", sources.get(("dps", int(dps.GetInputPort(s.name).get_index())), "")) for s in interface.commands
        ),
    )


def _class_name(system: System) -> str:
    """Return the name of a system's class; empty for a plain Diagram, whose class is no information."""
    name = type(system).__name__
    return "" if name == "Diagram" else name.rstrip("_")


def _world(testbed: VirtualTestbed) -> dict[str, tuple[str, ...]]:
    parts: dict[str, list[str]] = {role: [] for role in (*ROLES, "other")}
    for role, name in _plant_instances(testbed):
        parts[role].append(f"plant: {name}")
    for system in testbed.diagram.GetSystems():
        if not _is_framework(testbed, system):
            name = str(system.get_name())
            part = re.fullmatch(rf"sim\.({'|'.join(ROLES)})\.(.+)", name)
            role, shown = part.groups() if part else ("other", name)
            parts[role].append(shown)
    return {role: tuple(names) for role, names in parts.items() if names or role != "other"}


def _is_framework(testbed: VirtualTestbed, system: System) -> bool:
    name = str(system.get_name())
    shown_apart = system in (testbed.dps, testbed.plant, testbed.scene_graph)
    if shown_apart or isinstance(system, MeshcatVisualizer):
        return True
    return name == BOARD or name.startswith((T_SENSE, T_ACT))


def _plant_instances(testbed: VirtualTestbed) -> Iterator[tuple[str, str]]:
    """Yield (role, name) of the model instances with bodies, and of the world body if it has geometry."""
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


# Colours.
SIM = "#1d6fb8"
REAL = "#c8501e"
DPS = "#2f6f4f"
OFF = "#b9c0c8"
INK = "#1f2933"
PALE = "#6b7682"
FILLS = {SIM: "#eaf2fb", REAL: "#fdf0e7", DPS: "#e9f4ee"}

# Lengths and places in pixels. Those along x are from the left edge, and mirrored on the right.
WIDTH = 1200
# The lines to the real world and to the simulated one.
BUS = (34, 46)
# The chips at their ends.
CHIP = 62
CHIP_WIDTH = 196
# The contacts of the switches.
CONTACT = 286
# Their poles.
POLE = 334
# The box of the DPS.
BOX = 490
# Height of the row of a signal.
ROW = 84
# Distance of a contact above or below the pole.
REACH = 17
WORLD_BOXES = ((62, 250), (362, 226), (612, 226), (888, 250))
WORLD_ROLES = ("sense", "sys", "env", "act")


def svg(testbed: VirtualTestbed, context: Context | None = None) -> str:
    """Draw a testbed as SVG text: its parts by role, and every signal with its switch.

    Coloured lines are the branches in use, grey ones those that are switched off. Each switch is a group whose
    ``id`` is its address (``T_sense.<signal>``) and whose ``data-position`` is where it stands.

    Args:
        testbed: The testbed to draw.
        context: Context with the positions of the switches; by default those in which the testbed was built.
    """
    return _Drawing(structure_of(testbed, context)).text()


class _Drawing:
    def __init__(self, structure: Structure) -> None:
        self._structure = structure
        self._parts: list[str] = []
        rows = max(len(structure.sense) + len(structure.commands), len(structure.act), 1)
        listed = max(len(structure.world.get(role, ())) for role in WORLD_ROLES)
        self._real_bottom = 142
        self._top = self._real_bottom + 26
        # The DPS's parts stand below its name, in two columns if one is too long.
        parts = len(structure.dps_parts)
        self._columns = 1 if 72 + 34 * parts <= rows * ROW else 2
        self._bottom = self._top + max(rows * ROW, 72 + 34 * -(-parts // self._columns))
        self._sim_top = self._bottom + 26
        other = 24 if "other" in structure.world else 0
        self._sim_bottom = self._sim_top + 62 + 22 * max(listed, 1) + 14 + other
        self.height = self._sim_bottom + 24

    def text(self) -> str:
        structure = self._structure
        self._worlds()
        self._dps()
        for number, wire in enumerate(structure.sense):
            self._switch("T_sense", wire, self._row(number), mirrored=False)
        for number, wire in enumerate(structure.commands, start=len(structure.sense)):
            self._command(wire, self._row(number))
        for number, wire in enumerate(structure.act):
            self._switch("T_act", wire, self._row(number), mirrored=True)
        self._buses(structure.sense, mirrored=False)
        self._buses(structure.act, mirrored=True)
        size = f'width="{WIDTH}" height="{self.height}" viewBox="0 0 {WIDTH} {self.height}"'
        font = 'font-family="DejaVu Sans, Verdana, Helvetica, sans-serif"'
        head = [
            f'<svg xmlns="http://www.w3.org/2000/svg" {size} {font} fill="{INK}" style="max-width:100%;height:auto">',
            f"<title>{escape(structure.name)}</title>",
            "<defs>",
            *(_arrow_head(color) for color in (SIM, REAL, DPS, OFF)),
            "</defs>",
            f'<rect width="{WIDTH}" height="{self.height}" fill="white"/>',
        ]
        return "\n".join([*head, *self._parts, "</svg>"]) + "\n"

    def _row(self, number: int) -> int:
        return self._top + ROW * number + ROW // 2

    # -- the two worlds

    def _worlds(self) -> None:
        structure, world = self._structure, self._structure.world
        self._frame(20, 20, WIDTH - 40, self._real_bottom - 20, REAL, dashed=True)
        self._write(34, 42, "real", size=15, color=REAL, bold=True)
        self._write(76, 42, "the physical world, behind a bridge outside the Diagram", size=12, color=PALE)
        counts = (_signals(structure.sense), "", "", _signals(structure.act))
        kinds = ("sensors", "system", "environment", "actuators")
        for (x, width), role, kind, count in zip(WORLD_BOXES, WORLD_ROLES, kinds, counts, strict=True):
            self._frame(x, 56, width, 66, REAL)
            self._write(x + 12, 77, role, size=13, color=REAL, bold=True)
            self._write(x + 12, 98, f"physical {kind}", size=12)
            self._write(x + width - 12, 77, count, size=11, color=PALE, anchor="end")
        self._world_arrows(56, 66, REAL)
        top = self._sim_top
        self._frame(20, top, WIDTH - 40, self._sim_bottom - top, SIM)
        below = self._sim_bottom - 12
        self._write(WIDTH - 34, below + 1, structure.name, size=12, color=PALE, anchor="end")
        self._write(34, below + 1, "sim", size=15, color=SIM, bold=True)
        further = f"; further systems: {', '.join(world['other'])}" if "other" in world else ""
        self._write(70, below + 1, _cut(f"the simulated world, in the Diagram{further}", 120), size=12, color=PALE)
        height = self._sim_bottom - 30 - (top + 18)
        for (x, width), role in zip(WORLD_BOXES, WORLD_ROLES, strict=True):
            self._frame(x, top + 18, width, height, SIM)
            self._write(x + 12, top + 38, role, size=13, color=SIM, bold=True)
            for line, part in enumerate(world.get(role, ()) or ("none",)):
                color = INK if world.get(role) else PALE
                self._write(
                    x + 12, top + 60 + 22 * line, _cut(part, (width - 20) // 8), size=12, color=color, full=part
                )
        self._world_arrows(top + 18, height, SIM)

    def _world_arrows(self, top: int, height: int, color: str) -> None:
        """Draw the arrows: actuators to system, system and environment both ways, both to sensors."""
        y = top + height // 2
        (sense, sense_width), (system, width), (env, env_width), (act, _) = WORLD_BOXES
        around = (
            f'x="{system - 10}" y="{top - 7}" width="{env + env_width - system + 20}" height="{height + 14}" rx="10"'
        )
        self._parts.append(f'<rect {around} fill="none" stroke="{color}" stroke-dasharray="2 3"/>')
        self._line([(system - 10, y), (sense + sense_width + 2, y)], color, arrow=True)
        self._line([(act, y), (env + env_width + 12, y)], color, arrow=True)
        self._line([(system + width, y - 7), (env - 2, y - 7)], color, arrow=True)
        self._line([(env, y + 7), (system + width + 2, y + 7)], color, arrow=True)

    # -- the DPS and its signals

    def _dps(self) -> None:
        structure, width = self._structure, WIDTH - 2 * BOX
        self._frame(BOX, self._top, width, self._bottom - self._top, DPS)
        self._write(WIDTH // 2, self._top + 30, "DPS", size=18, color=DPS, bold=True, anchor="middle")
        self._write(WIDTH // 2, self._top + 50, _cut(structure.dps, 26), size=12, color=PALE, anchor="middle")
        column = (width - 12 * (self._columns + 1)) // self._columns
        for number, part in enumerate(structure.dps_parts):
            x = BOX + 12 + (number % self._columns) * (column + 12)
            y = self._top + 62 + 34 * (number // self._columns)
            self._parts.append(
                f'<rect x="{x}" y="{y}" width="{column}" height="26" rx="5" fill="white" stroke="{DPS}"/>'
            )
            self._write(x + column // 2, y + 17, _cut(part, column // 7), size=11, anchor="middle", full=part)

    def _switch(self, side: str, wire: Wire, y: int, *, mirrored: bool) -> None:
        def at(x: int) -> int:
            return WIDTH - x if mirrored else x

        name = f"{side}.{wire.signal.name}"
        self._parts.append(f"<g id={quoteattr(name)} data-position={quoteattr(wire.position)}>")
        real, sim = y - REACH, y + REACH
        names = (f"real.{side[2:]}.{wire.signal.name}", wire.part)
        for level, color, used, text in ((real, REAL, wire.on_real, names[0]), (sim, SIM, wire.on_sim, names[1])):
            stroke = color if used else OFF
            self._chip(at(CHIP), level, text, stroke, mirrored=mirrored)
            self._line([(at(CHIP + CHIP_WIDTH), level), (at(CONTACT), level)], stroke, thick=used)
            if used:
                self._line([(at(CONTACT), level), (at(POLE), y)], stroke, thick=True)
            self._dot(at(CONTACT), level, stroke)
        color = REAL if wire.position == "real" else SIM
        ends = [(at(POLE), y), (at(BOX), y)]
        self._line(ends[::-1] if mirrored else ends, DPS, thick=True, arrow=not mirrored)
        self._dot(at(POLE), y, DPS)
        middle = at((POLE + BOX) // 2)
        self._write(middle, y - 9, _cut(wire.signal.name, 18), size=12, anchor="middle", full=name)
        self._write(middle, y + 18, _cut(wire.shape(), 22), size=10, color=PALE, anchor="middle", full=wire.shape())
        self._write(at((CONTACT + POLE) // 2), y + 35, wire.position, size=11, color=color, bold=True, anchor="middle")
        self._parts.append("</g>")

    def _command(self, wire: Wire, y: int) -> None:
        name = f"u.{wire.signal.name}"
        self._parts.append(f"<g id={quoteattr(name)}>")
        self._chip(CHIP, y, f"{name} = {wire.part}" if wire.part else name, DPS, mirrored=False)
        self._line([(CHIP + CHIP_WIDTH, y), (BOX, y)], DPS, thick=True, arrow=True)
        middle = (POLE + BOX) // 2
        self._write(middle, y - 9, _cut(wire.signal.name, 18), size=12, anchor="middle")
        self._write(middle, y + 18, _cut(wire.shape(), 22), size=10, color=PALE, anchor="middle", full=wire.shape())
        self._parts.append("</g>")

    def _buses(self, wires: tuple[Wire, ...], *, mirrored: bool) -> None:
        """Draw the lines from the chips to the worlds: up to the real one, down to the simulated one."""
        if not wires:
            return
        for bus, world, sign in ((BUS[0], self._real_bottom, -1), (BUS[1], self._sim_top, 1)):
            x, end = (WIDTH - bus if mirrored else bus), (WIDTH - CHIP if mirrored else CHIP)
            levels = [self._row(number) + sign * REACH for number in range(len(wires))]
            used = [wire.on_real if sign < 0 else wire.on_sim for wire in wires]
            color = (REAL if sign < 0 else SIM) if any(used) else OFF
            far = max(levels) if sign < 0 else min(levels)
            path = [(x, world), (x, far)]
            # Signals flow from the worlds to the sensors' switches, and from the actuators' switches to the worlds.
            self._line(path[::-1] if mirrored else path, color, thick=any(used), arrow=mirrored)
            for level, on in zip(levels, used, strict=True):
                self._line([(x, level), (end, level)], color if on else OFF, thick=on)
                self._parts.append(f'<circle cx="{x}" cy="{level}" r="3" fill="{color if on else OFF}"/>')

    # -- elements

    def _frame(self, x: int, y: int, width: int, height: int, color: str, *, dashed: bool = False) -> None:
        dash = ' stroke-dasharray="7 4"' if dashed else ""
        self._parts.append(
            f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="8" fill="{FILLS[color]}" stroke="{color}" '
            f'stroke-width="1.4"{dash}/>'
        )

    def _chip(self, x: int, y: int, text: str, color: str, *, mirrored: bool) -> None:
        left = x - CHIP_WIDTH if mirrored else x
        self._parts.append(
            f'<rect x="{left}" y="{y - 12}" width="{CHIP_WIDTH}" height="24" rx="12" fill="white" stroke="{color}" '
            'stroke-width="1.4"/>'
        )
        self._write(left + CHIP_WIDTH // 2, y + 4, _cut(text, 26), size=11, anchor="middle", full=text)

    def _line(self, points: list[tuple[int, int]], color: str, *, thick: bool = False, arrow: bool = False) -> None:
        path = " ".join(f"{x},{y}" for x, y in points)
        head = f' marker-end="url(#arrow-{color[1:]})"' if arrow else ""
        width = 2.4 if thick else 1.4
        self._parts.append(
            f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="{width}" '
            f'stroke-linecap="round"{head}/>'
        )

    def _dot(self, x: int, y: int, color: str) -> None:
        self._parts.append(f'<circle cx="{x}" cy="{y}" r="4.5" fill="white" stroke="{color}" stroke-width="2"/>')

    def _write(
        self,
        x: int,
        y: int,
        text: str,
        *,
        size: int,
        color: str = INK,
        bold: bool = False,
        anchor: str = "start",
        full: str = "",
    ) -> None:
        weight = ' font-weight="bold"' if bold else ""
        hover = f"<title>{escape(full)}</title>" if full and full != text else ""
        self._parts.append(
            f'<text x="{x}" y="{y}" font-size="{size}" fill="{color}" text-anchor="{anchor}"{weight}>'
            f"{escape(text)}{hover}</text>"
        )


def _arrow_head(color: str) -> str:
    return (
        f'<marker id="arrow-{color[1:]}" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="9" markerHeight="9" '
        f'markerUnits="userSpaceOnUse" orient="auto"><path d="M0,0 L10,5 L0,10 z" fill="{color}"/></marker>'
    )


def _signals(wires: tuple[Wire, ...]) -> str:
    return counted(len(wires), "signal")


def _cut(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length - 1]}…"
