"""Figure 4 of a testbed as the text of a Mermaid flowchart."""

from __future__ import annotations

from pydrake.systems.framework import Context

from vtbdrake.testbed import VirtualTestbed
from vtbdrake.visualization.drawing import svg
from vtbdrake.visualization.structure import Structure, Wire, short, structure_of

__all__ = ["mermaid", "svg"]

_STYLE = """\
    classDef sim fill:#e3eefa,stroke:#1d6fb8,color:#123
    classDef real fill:#fdebdf,stroke:#c8501e,color:#311
    classDef twin fill:#efe6f7,stroke:#7a3fa0,color:#213
    classDef dps fill:#e4f1e9,stroke:#2f6f4f,color:#132
    style sim fill:#f5f9fe,stroke:#1d6fb8
    style real fill:#fef7f2,stroke:#c8501e,stroke-dasharray:6 4
    style dps fill:#f3f9f5,stroke:#2f6f4f"""

_WORDS = {
    "sense": "sense: simulated sensors",
    "sys": "sys: simulated system",
    "act": "act: simulated actuators",
    "env": "env: simulated environment",
    "other": "further systems",
}


def mermaid(testbed: VirtualTestbed, context: Context | None = None) -> str:
    """The testbed as a Mermaid flowchart: its parts by role, and every signal with its switch.

    A switch names its position; thick arrows are the branches in use, dotted ones those that are switched off.

    Args:
        context: says where the switches stand; left out, where they stand at first.
    """
    return _Flowchart(structure_of(testbed, context)).text()


class _Flowchart:
    def __init__(self, structure: Structure) -> None:
        self._structure = structure
        self._nodes: dict[str, str] = {}
        self._lines: list[str] = []

    def text(self) -> str:
        structure = self._structure
        title = f"DPS: {structure.dps}" if structure.dps else "DPS"
        self._group("dps", title, "dps", list(structure.dps_parts) or [structure.dps])
        self._add('    subgraph sim["sim"]')
        for role, parts in structure.world.items():
            if parts:
                self._group(f"sim_{role}", _WORDS[role], "sim", list(parts), indent="        ")
        self._add("    end")
        self._real()
        for number, wire in enumerate(structure.sense):
            self._sense(number, wire)
        for number, wire in enumerate(structure.act):
            self._act(number, wire)
        for number, wire in enumerate(structure.commands):
            self._command(number, wire)
        head = f"%% {structure.name}: thick arrows are in use, dotted ones are switched off"
        return "\n".join([head, "flowchart LR", *self._lines, _STYLE]) + "\n"

    def _group(self, key: str, title: str, style: str, parts: list[str], *, indent: str = "    ") -> None:
        self._add(f'{indent}subgraph {key}["{_quoted(title)}"]')
        for number, part in enumerate(parts):
            node = f"{key}_{number}"
            # The plant bears the names of its model instances, but signals end at the plant.
            self._nodes.setdefault(part.partition(":")[0] if style == "sim" else part, node)
            self._add(f'{indent}    {node}["{_quoted(part)}"]:::{style}')
        self._add(f"{indent}end")

    def _real(self) -> None:
        self._add('    subgraph real["real: behind a bridge, outside the Diagram"]')
        for side, wires in (("sense", self._structure.sense), ("act", self._structure.act)):
            for number, wire in enumerate(wires):
                self._add(f'        real_{side}_{number}(["real.{side}.{_quoted(wire.signal.name)}"]):::real')
        if not (self._structure.sense or self._structure.act):
            self._add('        real_none["no signals"]:::real')
        self._add("    end")

    def _sense(self, number: int, wire: Wire) -> None:
        switch = self._switch("T_sense", number, wire)
        self._edge(self._node(wire.part), switch, wire.on_sim)
        self._edge(f"real_sense_{number}", switch, wire.on_real)
        self._add(f'    {switch} ==>|"{_quoted(wire.shape())}"| dps')

    def _act(self, number: int, wire: Wire) -> None:
        switch = self._switch("T_act", number, wire)
        self._add(f'    dps ==>|"{_quoted(wire.shape())}"| {switch}')
        self._edge(switch, self._node(wire.part), wire.on_sim)
        self._edge(switch, f"real_act_{number}", wire.on_real)

    def _command(self, number: int, wire: Wire) -> None:
        name = f"u.{wire.signal.name}"
        if not wire.part:
            self._add(f'    u_{number}(["{_quoted(name)}"]) ==>|"{_quoted(wire.shape())}"| dps')
        else:
            self._add(f'    {self._node(wire.part)} ==>|"{_quoted(name)}, {_quoted(wire.shape())}"| dps')

    def _switch(self, side: str, number: int, wire: Wire) -> str:
        self._add(f'    {side}_{number}{{{{"{side}.{_quoted(wire.signal.name)}: {wire.position}"}}}}:::{wire.position}')
        return f"{side}_{number}"

    def _node(self, part: str) -> str:
        return self._nodes.get(short(part), "sim")

    def _edge(self, origin: str, to: str, used: bool) -> None:
        self._add(f"    {origin} {'==>' if used else '-.->'} {to}")

    def _add(self, line: str) -> None:
        self._lines.append(line)


def _quoted(text: str) -> str:
    return text.replace("&", "&amp;").replace('"', "#quot;").replace("<", "&lt;").replace(">", "&gt;")
