"""``vtbdrake doctor``: whether this computer has what simulation, rendering, control and LCM need, and what to do."""

from __future__ import annotations

import os
import platform
import re
import shlex
import shutil
import socket
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from importlib import import_module, metadata
from pathlib import Path

import click

from vtbdrake.cli import FAILED
from vtbdrake.cli.options import option
from vtbdrake.cli.output import json_option, show
from vtbdrake.common.drake_version import TESTED_DRAKE
from vtbdrake.common.failures import one_line

OK = "ok"
WARNING = "warning"
FAILURE = "failure"

NETWORK_FILE_SYSTEMS = {
    "9p", "afs", "beegfs", "ceph", "cifs", "fuse.glusterfs", "fuse.sshfs", "gpfs", "lustre", "ncpfs", "nfs", "nfs4",
    "smb3", "smbfs",
}  # fmt: skip
"""Types of file systems that other computers may write to at the same time."""

_GIBIBYTE = 1024**3
_LEAST_SPACE = 1  # GiB
_MULTICAST = "239.255.76.67"  # the group of LCM's default URL
_TIMEOUT = 0.5  # s


@dataclass(frozen=True)
class Diagnosis:
    """The result of one check.

    Attributes:
        check: The name of the check.
        status: OK, WARNING: something is slower or missing; FAILURE: nothing works.
        message: What was found, in a sentence.
        remedy: What to do; empty if OK.
    """

    check: str
    status: str
    message: str
    remedy: str = ""

    def __str__(self) -> str:
        line = f"{self.status:8} {self.check:12} {self.message}"
        return f"{line}\n{'':22}-> {self.remedy}" if self.remedy else line


def _python() -> Iterator[Diagnosis]:
    yield Diagnosis(
        "python", OK, f"{platform.python_version()} with numpy {metadata.version('numpy')}, {sys.executable}"
    )


def _vtbdrake() -> Iterator[Diagnosis]:
    try:
        version = metadata.version("vtbdrake")
    except metadata.PackageNotFoundError:
        version = "not installed but run from its folder"
    try:
        import_module("vtbdrake.common.spline_kernel")
    except ImportError as error:
        remedy = "install it again with a C compiler (pip install .), or run make in its folder"
        yield Diagnosis("vtbdrake", FAILURE, f"{version}, without its compiled modules: {one_line(error)}", remedy)
    else:
        yield Diagnosis("vtbdrake", OK, version)


def _drake() -> Iterator[Diagnosis]:
    try:
        import_module("pydrake.systems.framework")
        version = metadata.version("drake")
    except (ImportError, metadata.PackageNotFoundError) as error:
        remedy = "pip install drake; on Debian also apt-get install libglib2.0-0"
        yield Diagnosis("drake", FAILURE, f"it cannot be imported: {one_line(error)}", remedy)
        return
    if version in TESTED_DRAKE:
        yield Diagnosis("drake", OK, version)
    else:
        remedy = f"if something fails, pip install drake=={TESTED_DRAKE[-1]} ({TESTED_DRAKE[0]} for Python 3.11)"
        yield Diagnosis("drake", WARNING, f"{version} is untested; tested are {' and '.join(TESTED_DRAKE)}", remedy)


def _compiler() -> Iterator[Diagnosis]:
    from vtbdrake.components.casadi_system.compiler import CompilerError, compile_library, compiler_command

    begin = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory() as folder:
            compile_library("int doctor(void) { return 0; }\n", Path(folder) / "doctor.so")
    except CompilerError as error:
        remedy = "install a C compiler (on Debian: apt-get install gcc libc6-dev; or pip install ziglang), or set CC"
        yield Diagnosis("compiler", WARNING, f"functions in CasADi are interpreted: {one_line(error)}", remedy)
    else:
        command = shlex.join(compiler_command())
        yield Diagnosis("compiler", OK, f"{command} compiles in {time.perf_counter() - begin:.2f} s")


def _rendering() -> Iterator[Diagnosis]:
    from vtbdrake.components.rendering import RenderingError, measure_rendering

    try:
        speed = measure_rendering()
    except RenderingError as error:
        reason, _, remedy = str(error).partition(": ")
        yield Diagnosis("rendering", WARNING, reason, remedy)
        return
    place = "on the processor" if speed.in_software else "on the graphics card"
    yield Diagnosis(
        "rendering",
        OK,
        f"EGL by {speed.renderer}, {place}: {speed.images_per_second:.0f} images of 640 x 480 pixels per second",
    )


def _real_time() -> Iterator[Diagnosis]:
    from vtbdrake.control.realtime import RealTime

    with RealTime() as real_time:
        grants = real_time.grants
    if granted := [grant.request for grant in grants if grant.granted]:
        yield Diagnosis("real-time", OK, f"granted: {', '.join(granted)}")
    for grant in grants:
        if not grant.granted:
            yield Diagnosis("real-time", WARNING, f"{grant.request} is refused ({grant.reason})", grant.remedy)


def _hub() -> Iterator[Diagnosis]:
    from vtbdrake.lcm.connections import LcmLink
    from vtbdrake.lcm.hub import Hub

    channel, round_trips = "VTB_DOCTOR", []
    try:
        with Hub(port=0) as hub, closing(LcmLink(hub.url, {channel: _ignore}, connect_timeout=_TIMEOUT)) as link:
            link.open()
            for _ in range(101):
                begin = time.perf_counter()
                if not (link.publish((channel, b"")) and link.receive(_TIMEOUT, 1)):
                    raise TimeoutError(f"a message did not come back within {_TIMEOUT:g} s")
                round_trips.append(time.perf_counter() - begin)
    except (OSError, RuntimeError) as error:
        remedy = "let this user listen and connect on 127.0.0.1 (firewall, sandbox, container)"
        yield Diagnosis("lcm-hub", FAILURE, f"no messages over a hub on loopback: {one_line(error)}", remedy)
    else:
        microseconds = 1e6 * statistics.median(round_trips)
        yield Diagnosis("lcm-hub", OK, f"round trip over a hub on loopback: {microseconds:.0f} us (median)")


def _ignore(channel: str, data: bytes) -> None:
    pass


def _multicast() -> Iterator[Diagnosis]:
    try:
        _send_multicast()
    except OSError as error:
        remedy = (
            "use a hub (vtbdrake hub, tcpq://127.0.0.1:7700); or, for udpm:// on this computer, ip link set lo "
            "multicast on, ip route add 224.0.0.0/4 dev lo"
        )
        yield Diagnosis("multicast", WARNING, f"udpm:// does not work: {one_line(error)}", remedy)
    else:
        yield Diagnosis("multicast", OK, "udpm:// works on this computer; other computers were not tried")


def _send_multicast() -> None:
    """Send a datagram to LCM's group, on a port of this process's own, and receive it, as LCM does with ttl=0."""
    group = socket.inet_aton(_MULTICAST) + socket.inet_aton("0.0.0.0")
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind((_MULTICAST, 0))  # only datagrams to the group
        receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        receiver.settimeout(_TIMEOUT)
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        sender.sendto(b"vtbdrake doctor", (_MULTICAST, receiver.getsockname()[1]))
        receiver.recv(64)


def _cores() -> Iterator[Diagnosis]:
    usable = float(len(os.sched_getaffinity(0)))
    if (quota := _processor_quota()) is not None:
        usable = min(usable, quota)
    load = os.getloadavg()[0]
    message = f"{usable:g} of {os.cpu_count()} usable, load average {load:.1f}"
    if usable < 2:
        remedy = "give the computer or container two or more: loop, hub and machine compete for one"
        yield Diagnosis("cores", WARNING, message, remedy)
    elif load > usable:
        yield Diagnosis("cores", WARNING, message, "end other programs before you measure times or control a machine")
    else:
        yield Diagnosis("cores", OK, message)


def _processor_quota() -> float | None:
    """Return the number of processors that the control group of this process may use; None without a limit."""
    try:
        group = Path("/proc/self/cgroup").read_text(encoding="utf-8").rpartition("0::")[2].strip()
        quota, period = Path(f"/sys/fs/cgroup{group}/cpu.max").read_text(encoding="utf-8").split()
    except (OSError, ValueError):
        return None
    return None if quota == "max" else int(quota) / int(period)


def _file_systems() -> Iterator[Diagnosis]:
    from vtbdrake.components.casadi_system.compiler import cache_folder

    folders = {"here": Path.cwd(), "temporary": Path(tempfile.gettempdir()), "cache": cache_folder()}
    for use, folder in folders.items():
        place = folder.resolve()
        while not place.exists():
            place = place.parent
        kind, free = file_system_type(place), shutil.disk_usage(place).free / _GIBIBYTE
        message = f"{use}: {folder}, {kind}, {free:.1f} GiB free"
        if not os.access(place, os.W_OK | os.X_OK):
            remedy = {
                "here": "change to a folder of yours: logs and studies are written where you are",
                "temporary": "name a folder of yours in TMPDIR",
                "cache": "name a folder of yours in XDG_CACHE_HOME",
            }[use]
            yield Diagnosis("files", WARNING, f"{message}, not writable", remedy)
        elif free < _LEAST_SPACE:
            yield Diagnosis("files", WARNING, message, f"free {_LEAST_SPACE} GiB: logs grow by about 1 MB per second")
        elif kind in NETWORK_FILE_SYSTEMS and use == "here":
            remedy = "keep study files on a local disk: the write-ahead log of SQLite needs shared memory"
            yield Diagnosis("files", WARNING, f"{message}, a network file system", remedy)
        else:
            yield Diagnosis("files", OK, message)


def file_system_type(path: Path, mounts: str | None = None) -> str:
    """Return the type of the file system of an existing absolute path, such as ``ext4``.

    Args:
        path: The path, without symbolic links.
        mounts: The text of ``/proc/self/mountinfo``, which is read by default.
    """
    if mounts is None:
        mounts = Path("/proc/self/mountinfo").read_text(encoding="utf-8")
    best, kind = -1, "unknown"
    for line in mounts.splitlines():
        mount, _, source = line.partition(" - ")
        # Blanks in names are written in octal.
        point = Path(re.sub(r"\\([0-7]{3})", lambda match: chr(int(match[1], 8)), mount.split()[4]))
        # The last one of several mounts at one place counts.
        if path.is_relative_to(point) and len(point.parts) >= best:
            best, kind = len(point.parts), source.split()[0]
    return kind


CHECKS: dict[str, Callable[[], Iterator[Diagnosis]]] = {
    "python": _python,
    "vtbdrake": _vtbdrake,
    "drake": _drake,
    "compiler": _compiler,
    "rendering": _rendering,
    "real-time": _real_time,
    "lcm-hub": _hub,
    "multicast": _multicast,
    "cores": _cores,
    "files": _file_systems,
}
"""The checks by name, in the order of the output."""


def _run(name: str) -> list[Diagnosis]:
    try:
        return list(CHECKS[name]())
    except Exception as error:  # Whatever is wrong with this computer: the remaining checks go on.
        return [
            Diagnosis(
                name, FAILURE, f"{type(error).__name__}: {one_line(error)}", "an unforeseen error: please report it"
            )
        ]


def diagnose() -> list[Diagnosis]:
    """Run all checks, which takes a few seconds, and return their results."""
    results = {"real-time": _run("real-time")}  # in the main thread, alone
    with ThreadPoolExecutor(1) as executor:  # The renderer starts in a process of its own.
        rendering = executor.submit(_run, "rendering")
        results |= {name: _run(name) for name in CHECKS if name not in ("real-time", "rendering")}
        results["rendering"] = rendering.result()
    return [result for name in CHECKS for result in results[name]]


@click.command()
@option(
    "--require CHECK",
    "Fail where this check gives a warning, too. May be repeated.",
    name="required",
    type=click.Choice(list(CHECKS)),
    multiple=True,
)
@json_option
@click.pass_context
def doctor(ctx: click.Context, required: tuple[str, ...]) -> None:
    """Check this computer, and say what to do about what is missing.

    The exit code is 1 if something fails that nothing works without. A warning (no rendering, no real-time rights, no
    multicast, ...) fails only if it is required.

    \b
    Example:
      vtbdrake doctor --require rendering --require real-time
    """
    results = diagnose()
    show("\n".join(map(str, results)), results)
    if any(result.status == FAILURE or (result.check in required and result.status == WARNING) for result in results):
        ctx.exit(FAILED)
