"""How a page of this machine appears in a notebook: the page itself where it can be reached, else a picture."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

_SCRIPT = Path(__file__).with_name("page") / "notebook.js"


def page_bundle(port: int, path: str, static: Mapping[str, Any], *, height: int = 600) -> dict[str, Any]:
    """Return the MIME bundle of a page, for ``_repr_mimebundle_``.

    A frame shows the page: of the kernel's machine under the name by which the notebook is open, in VS Code and Colab
    by the ports that these forward, and else through jupyter-server-proxy, as on a JupyterHub. Where no script runs, or
    the server has ended, as in a stored notebook, there is the picture.

    Args:
        port: The port of the page.
        path: Its path, such as `Host.framed_path`.
        static: How it appears without a kernel: a bundle with ``text/plain``, and with ``image/png`` if there is a
            picture, such as `picture_bundle`.
        height: Height of the frame, in pixels.
    """
    # The prefix of the user's server on a JupyterHub, which can be at a loopback address, too.
    prefix = os.environ.get("JUPYTERHUB_SERVICE_PREFIX", "")
    settings = {"port": port, "path": path, "prefix": prefix, "height": height}
    text, encoded = escape(static["text/plain"]), static.get("image/png")
    image = f'<img src="data:image/png;base64,{encoded}" alt="{text}"/>' if encoded else text
    run = f"show(place, {json.dumps(settings)});"
    script = f"(() => {{ const place = document.currentScript.parentElement;\n{_SCRIPT.read_text('utf-8')}{run} }})();"
    return {**static, "text/html": f"<div>{image}<script>{script}</script></div>"}
