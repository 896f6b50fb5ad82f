"""How the renderers of a thread end: it lets go of them, so that the thread that ends them can use them.

Fault: a renderer (VTK's, by EGL) stays the present one of the thread that rendered last, even when that thread has
ended. What holds it, a context, may live on, and when another thread ends it, VTK cannot make it its own: it warns some
hundred times, and frees nothing on the graphics card. Issue: there is none that we know of
"""

from __future__ import annotations

import ctypes
import os


def release_renderers() -> None:
    """Let go of the renderers that this thread, which is about to end, has used."""
    try:
        library = ctypes.CDLL("libEGL.so.1", mode=os.RTLD_NOLOAD)
    except OSError:  # Nothing has been rendered in this process.
        return
    library.eglReleaseThread()
