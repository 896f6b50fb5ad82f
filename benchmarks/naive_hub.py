"""A tcpq hub as one writes it first: a thread per client, blocking sockets as the system gives them.

``python -m benchmarks.naive_hub`` prints the URL and runs until it is killed.
"""

from __future__ import annotations

import re
import socket
import struct
import threading

U32 = struct.Struct(">I")


class NaiveHub:
    """A hub that relays a message to its subscribers one after another."""

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self._subscriptions: list[tuple[socket.socket, re.Pattern[str]]] = []
        host, port = self._server.getsockname()
        self.url = f"tcpq://{host}:{port}"

    def serve_forever(self) -> None:
        while True:
            client, _ = self._server.accept()
            threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        stream = client.makefile("rb")
        stream.read(8)
        client.sendall(bytes.fromhex("287617fa00000100"))
        while kind := stream.read(4):
            channel = self._field(stream)
            if kind == U32.pack(1):
                data = self._field(stream)
                message = kind + U32.pack(len(channel)) + channel + U32.pack(len(data)) + data
                for subscriber, pattern in self._subscriptions:
                    if pattern.fullmatch(channel.decode()):
                        subscriber.sendall(message)
            elif kind == U32.pack(2):
                self._subscriptions.append((client, re.compile(channel.decode())))

    @staticmethod
    def _field(stream) -> bytes:
        return stream.read(U32.unpack(stream.read(4))[0])


if __name__ == "__main__":
    hub = NaiveHub()
    print(hub.url, flush=True)
    hub.serve_forever()
