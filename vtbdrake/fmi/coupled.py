"""The Python process of a coupled FMU, which simulates in Drake what ``coupled.c`` asks for."""

from __future__ import annotations

import json
import os
import socket
import struct
import sys
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator

from vtbdrake.common.exit_guard import exit_after_hang_up
from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.common.quick_exit import quick_exit
from vtbdrake.fmi.exported_part import ExportedPart
from vtbdrake.state import Snapshot
from vtbdrake.state import snapshot as snapshots
from vtbdrake.testbed import load_scenario
from vtbdrake.testbed.instants import sample_instants

SCENARIO = "scenario.yaml"
"""The file of the scenario, in the folder ``resources`` of an FMU."""
PART = "part.json"
"""The file with the other arguments of an `ExportedPart`, beside the scenario."""

START = """\
import signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)  # The importer decides what Ctrl-C means.
if sys.executable == {executable!r}:
    sys.path[:] = {path!r}
from vtbdrake.fmi.coupled import serve
serve(__file__)
"""
"""The program of the process; what it formats are the interpreter that exports, and where that finds modules."""

# The descriptor of the socket, see coupled.c.
_SOCKET = 3
# s for a computation that is under way when the importer has ended.
_GRACE = 10.0
_HEAD = struct.Struct("=cQ")


def coupled_model() -> str:
    """Return C code that defines the functions ``model_...`` of ``fmu.c`` for any testbed."""
    return f"#define PYTHON {json.dumps(sys.executable)}\n{Path(__file__).with_name('coupled.c').read_text('utf-8')}"


class CoupledModel:
    """One instance of a coupled FMU.

    Args:
        folder: The folder ``resources`` of the FMU.
    """

    def __init__(self, folder: Path) -> None:
        arguments = json.loads((folder / PART).read_text("utf-8"))
        scenario = load_scenario(f"{arguments.pop('scenario')}@{folder / SCENARIO}")
        self._part = ExportedPart(scenario, arguments.pop("part"), **arguments)
        self._target = self._part.target
        self._context = self._target.default_context()
        self._simulator: Simulator | None = None
        ends = np.cumsum([0, *(variable.size for variable in self._part.settable)]).tolist()
        self._settable = dict(zip(ends, self._part.settable, strict=False))
        self._requests = {
            b"h": lambda data: b"",
            b"b": self.begin,
            b"s": self.start,
            b"w": self.write,
            b"o": self.outputs,
            b"a": self.advance,
            b"g": self.save,
            b"l": self.load,
        }

    def answer(self, letter: bytes, data: bytes) -> bytes:
        """Return the answer to a request.

        Args:
            letter: The kind of request, see ``coupled.c``.
            data: Its bytes.
        """
        return self._requests[letter](data)

    def begin(self, data: bytes) -> bytes:
        """Begin at a time (s) from s0."""
        self._simulator, self._context = None, self._target.default_context()
        self._context.SetTime(float(np.frombuffer(data)[0]))
        return b""

    def start(self, data: bytes) -> bytes:
        """Let the initialization events happen."""
        self._simulator = self._simulated(restored=False)
        self._simulator.Initialize()
        return b""

    def write(self, data: bytes) -> bytes:
        """Set an input or parameter: the number of its first entry among all, then its entries."""
        first, *values = np.frombuffer(data)
        self._part.write(self._context, self._settable[int(first)], np.array(values))
        return b""

    def outputs(self, data: bytes) -> bytes:
        """Return all outputs; during the initialization, as they are after it."""
        context = self._context
        if self._simulator is None:
            context = context.Clone()
            self._target.simulator(context).Initialize()
        return self._part.read(context).tobytes()

    def advance(self, data: bytes) -> bytes:
        """Simulate until a time (s)."""
        if self._simulator is None:
            raise RuntimeError("the FMU is not initialized")
        now, end = self._context.get_time(), float(np.frombuffer(data)[0])
        instants = sample_instants(np.array([0.0, end - now]), now, self._target.event_timings())
        self._simulator.AdvanceTo(instants[1])
        return b""

    def save(self, data: bytes) -> bytes:
        """Return the state: one byte that tells whether the initialization has ended, and a snapshot."""
        if self._simulator is None:
            return b"0" + self._target.snapshot(self._context).to_bytes()
        return b"1" + self._target.fork(self._simulator).to_bytes()

    def load(self, data: bytes) -> bytes:
        """Continue from a state of `save`."""
        self._simulator, self._context = None, self._target.default_context()
        snapshots.apply(Snapshot.load(data[1:]), self._target.diagram, self._context, self._target.variables())
        if data[:1] == b"1":
            self._simulator = self._simulated(restored=True)
        return b""

    def _simulated(self, *, restored: bool) -> Simulator:
        simulator = self._target.simulator(self._context, restored=restored)
        simulator.set_target_realtime_rate(0.0)
        return simulator


def serve(program: str) -> None:
    """Answer the requests of an FMU until it closes the connection.

    Args:
        program: The file that has been started, in the folder ``resources`` of the FMU.
    """
    exit_after_hang_up(os.dup(_SOCKET), _GRACE)
    with socket.socket(fileno=_SOCKET) as connection, connection.makefile("rb") as requests:
        model: CoupledModel | None = None
        while len(head := requests.read(_HEAD.size)) == _HEAD.size:
            letter, size = _HEAD.unpack(head)
            data = requests.read(size)
            try:
                if model is None:
                    model = CoupledModel(Path(program).parent)
                result, sign = model.answer(letter, data), b"+"
            except FAILURES as error:
                result, sign = one_line(error).encode(), b"-"
            connection.sendall(_HEAD.pack(sign, len(result)) + result)
    quick_exit()
