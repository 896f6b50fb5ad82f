"""The hub as a process and as a thread."""

import os
import select
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.lcm.hub.clients import TIMEOUT, Client, address, raw_client, receive, record
from vtbdrake.lcm.hub import Hub, HubAddressError, HubConfig, HubError, HubServer

pytestmark = pytest.mark.one_python


def listening(pid: int) -> list[str]:
    """Return the addresses of the listening TCP sockets of a process, as hexadecimal ``address:port``."""
    inodes = {os.readlink(fd) for fd in Path(f"/proc/{pid}/fd").iterdir()}
    rows = [
        line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/{pid}/net/{name}").read_text().splitlines()
    ]
    return [row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in inodes]


def test_hub_listens_on_loopback_only(hub) -> None:
    host, port = address(hub.url)
    assert host == "127.0.0.1"
    assert listening(hub.pid) == [f"0100007F:{port:04X}"]


def test_hub_listens_on_the_configured_address() -> None:
    with Hub(host="127.0.0.2", port=0) as hub:
        assert address(hub.url)[0] == "127.0.0.2"
        client = Client(hub.url, "A")
        client.publish("A")
        client.wait(lambda: bool(client.received))


def test_port_in_use_is_an_error(hub) -> None:
    port = address(hub.url)[1]
    for attempt in (lambda: Hub(port=port).start(), lambda: HubServer(HubConfig(port=port))):
        with pytest.raises(HubAddressError, match=f"127.0.0.1:{port} .Address already in use"):
            attempt()
    Client(hub.url)


@pytest.mark.parametrize("host", ["192.0.2.1", "no such host", "::1"])
def test_address_of_another_machine_is_an_error(host: str) -> None:
    with pytest.raises(HubAddressError, match=host):
        Hub(host=host, port=0).start()


def test_hub_ends_with_the_block_and_restarts() -> None:
    hub = Hub(port=0)
    for _ in range(2):
        with hub:
            pid, url = hub.pid, hub.url
            Client(url)
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(address(url))
        for use in (lambda: hub.url, lambda: hub.pid, hub.statistics):
            with pytest.raises(HubError, match="is not running"):
                use()


def test_hub_ends_with_its_parent() -> None:
    program = "from vtbdrake.lcm.hub import Hub\nhub = Hub(port=0)\nhub.start()\nprint(hub.pid, flush=True)\ninput()"
    with subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=Path(__file__).resolve().parents[3],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as parent:
        assert parent.stdout is not None
        hub = os.pidfd_open(int(parent.stdout.readline()))
        assert not select.select([hub], [], [], 0.0)[0]
        parent.kill()
    assert select.select([hub], [], [], TIMEOUT)[0]
    os.close(hub)


def test_killed_hub_is_an_error() -> None:
    with Hub(port=0) as hub:
        os.kill(hub.pid, signal.SIGKILL)
        with pytest.raises(HubError, match=f"the hub at {hub.url} does not answer"):
            for _ in range(2):
                hub.statistics()


def test_hub_process_ignores_ctrl_c(hub) -> None:
    lines = Path(f"/proc/{hub.pid}/status").read_text().splitlines()
    ignored = next(int(line.split()[1], 16) for line in lines if line.startswith("SigIgn"))
    assert ignored >> (signal.SIGINT - 1) & 1


def test_misspelled_field_is_an_error() -> None:
    with pytest.raises(TypeError, match="protected"):
        Hub(protected=["A"])


def test_hub_server_runs_in_a_thread() -> None:
    server = HubServer(HubConfig(port=0))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        with raw_client(server.url) as sock:
            sock.sendall(record(2, b"A") + record(1, b"A", b"data"))
            assert receive(sock, 8 + 17)[8:] == record(1, b"A", b"data")
    finally:
        server.stop()
        thread.join(TIMEOUT)
    assert not thread.is_alive()
    assert server.statistics().messages == 1
    server.stop()
    server.close()


def test_hub_runs_on_the_configured_processors() -> None:
    cpu = max(os.sched_getaffinity(0))
    with Hub(port=0, cpus=[cpu]) as hub:
        assert os.sched_getaffinity(hub.pid) == {cpu}


def test_hub_ignores_missing_processors() -> None:
    with Hub(port=0, cpus=[1023]) as hub:
        assert os.sched_getaffinity(hub.pid) == os.sched_getaffinity(0)


def test_hub_uses_real_time_priority_if_granted() -> None:
    attempt = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(3))"
    granted = subprocess.run([sys.executable, "-c", attempt], capture_output=True).returncode == 0
    with Hub(port=0, priority=3) as hub:
        Client(hub.url)
        policy = os.sched_getscheduler(hub.pid) & ~os.SCHED_RESET_ON_FORK
        assert policy == (os.SCHED_FIFO if granted else os.SCHED_OTHER)
        assert os.sched_getparam(hub.pid).sched_priority == (3 if granted else 0)
