"""Meshcats as a foreign program finds and kills them."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from vtbdrake.drake_workarounds.kept_meshcats import is_running

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

PATIENCE = 60.0  # s

MALFORMED = b"\x81\xa4typ"
"""A message that ends before it is complete."""


def kill(url: str, message: bytes = b"") -> None:
    """Send a message that a Meshcat cannot read, from a page of another origin, and wait until it closes.

    Its thread has ended some time after that, and later still where the computer is busy: see `kill_own`.
    """
    address = url.replace("http", "ws", 1)
    with connect(address, origin="http://evil.example", proxy=None, open_timeout=PATIENCE) as socket:  # type: ignore[arg-type]
        socket.send(message)
        try:
            while True:
                socket.recv(PATIENCE)
        except ConnectionClosed:
            return


def kill_own(meshcat: Meshcat) -> None:
    """Kill a Meshcat of this thread, and wait until its own thread has ended, so that each of its methods raises."""
    kill(meshcat.web_url())
    limit = time.monotonic() + PATIENCE
    while is_running(meshcat):
        assert time.monotonic() < limit
        time.sleep(0.005)  # Leave the processor to the thread that ends.


def listening(process: int) -> list[str]:
    """Return where a process listens, as every user of the machine can see: ``http://<host>:<port>``."""
    sockets = set()
    for entry in Path(f"/proc/{process}/fd").iterdir():
        try:
            sockets |= set(re.findall(r"socket:\[(\d+)\]", os.readlink(entry)))
        except OSError:  # It has been closed since.
            continue
    addresses = []
    for row in (line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]):
        if row[3] == "0A" and row[9] in sockets:
            host, port = row[1].split(":")
            number = ".".join(str(byte) for byte in reversed(bytes.fromhex(host)))
            addresses.append(f"http://{number}:{int(port, 16)}")
    return addresses


def meshcat_of(process: int) -> str:
    """Return the address of the Meshcat of a process, whose other servers listen at 127.0.0.1."""
    (url,) = [each for each in listening(process) if "//127.0.0.1:" not in each]
    return url
