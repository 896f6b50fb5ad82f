"""The worker process of the recorder, which writes the log; it needs no Drake, and starts in a moment."""

from __future__ import annotations

import os
import time

from vtbdrake.common.frames import FrameConnection

_POLL_PERIOD = 0.02  # s; the socket buffers more than arrives meanwhile


def write_log(connection: FrameConnection, path: str) -> None:
    """Append every frame to an existing file, whole or not at all, and report the number of those that failed.

    Args:
        connection: Brings the frames, and takes reports: the number of failed frames, a space, and the reason.
        path: Path of the file.
    """
    file = os.open(path, os.O_WRONLY | os.O_APPEND)
    end, lost = os.fstat(file).st_size, 0
    try:
        while True:
            frame = _next_frame(connection)
            try:
                view = memoryview(frame)
                while view:
                    view = view[os.write(file, view) :]
                end += len(frame)
            except OSError as error:
                # Part of a frame would be damage, its absence is a gap. Once there is room again, the log goes on.
                os.ftruncate(file, end)
                lost += 1
                connection.send_frame(f"{lost} {error.strerror or error}".encode())
    except EOFError:
        pass
    finally:
        os.close(file)


def _next_frame(connection: FrameConnection) -> bytes:
    # Polls: waking up a waiting process would cost the loop more than all the rest.
    while True:
        try:
            return connection.receive_frame(0.0)
        except TimeoutError:
            time.sleep(_POLL_PERIOD)
