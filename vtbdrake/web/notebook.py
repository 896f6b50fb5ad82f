"""How a page of this machine appears in a notebook: the page itself where it can be reached, else a picture."""

from __future__ import annotations

import base64
import json
import os
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

_SCRIPT = Path(__file__).with_name("page") / "notebook.js"


def page_bundle(url: str, *, text: str, picture: bytes | None = None, height: int = 600) -> dict[str, Any]:
    """Return the MIME bundle of a page, for ``_repr_mimebundle_``.

    A frame shows the page: of the kernel's machine under the name by which the notebook is open, in VS Code and Colab
    by the ports that these forward, and else through jupyter-server-proxy, as on a JupyterHub. Where no script runs, or
    the server has ended, as in a stored notebook, there is the picture.

    Args:
        url: The address of the page, with its token, such as that of `Host`.
        text: For readers of plain text.
        picture: What the page shows now, as PNG; None if there is none.
        height: Height of the frame, in pixels.
    """
    parts = urlsplit(url)
    (token,) = parse_qs(parts.query)["token"]
    # The prefix of the user's server on a JupyterHub, which can be at a loopback address, too.
    prefix = os.environ.get("JUPYTERHUB_SERVICE_PREFIX", "")
    settings = {"port": parts.port, "path": f"{token}/", "prefix": prefix, "height": height}
    encoded = "" if picture is None else base64.b64encode(picture).decode()
    image = f'<img src="data:image/png;base64,{encoded}" alt="{escape(text)}"/>' if encoded else escape(text)
    run = f"show(place, {json.dumps(settings)});"
    script = f"(() => {{ const place = document.currentScript.parentElement;\n{_SCRIPT.read_text('utf-8')}{run} }})();"
    bundle = {"text/plain": text, "text/html": f"<div>{image}<script>{script}</script></div>"}
    return bundle | ({"image/png": encoded} if encoded else {})
