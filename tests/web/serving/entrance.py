"""The way of a test without a browser into the page of a server."""

from __future__ import annotations

import ssl
import urllib.request
from urllib.parse import urlsplit


def entered(url: str, *, context: ssl.SSLContext | None = None) -> str:
    """Use the ticket of an address, and return the address of the page, which ends with its session and a slash."""
    parts = urlsplit(url)
    origin = f"{parts.scheme}://{parts.netloc}"
    request = urllib.request.Request(f"{origin}/enter", data=parts.fragment.encode(), headers={"Origin": origin})
    with urllib.request.urlopen(request, timeout=60, context=context) as answer:
        return f"{origin}/{answer.read().decode()}"
