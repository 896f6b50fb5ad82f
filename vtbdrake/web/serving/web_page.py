"""A page that this process serves, and who may open it."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from vtbdrake.common.closing import Closing

if TYPE_CHECKING:
    from vtbdrake.web.serving.host import Host


class WebPage(Closing):
    """A page that is served until it is closed.

    Args:
        host: Its web server.
    """

    def __init__(self, host: Host) -> None:
        self._host: Host | None = host

    @property
    def url(self) -> str:
        """Return an address of the page, which is good for one browser; each reading gives another one."""
        return self.address()

    def address(self, *, used: Callable[[], None] = lambda: None) -> str:
        """Return a new address of the page, which is good for one browser.

        Args:
            used: Called in the thread of the server when a browser has used it.
        """
        assert self._host is not None
        return self._host.address(used=used)

    def open_browser(self) -> bool:
        """Open the page in a browser of this user; return whether there is one."""
        assert self._host is not None
        return self._host.open_browser()

    def _framed(self, static: Mapping[str, Any], *, height: int = 600) -> dict[str, Any]:
        """Return the MIME bundle of the page in a notebook, see `page_bundle`."""
        from vtbdrake.web.serving.notebook_frame import page_bundle

        assert self._host is not None
        return page_bundle(self._host.port, self._host.framed_path(), static, height=height)


def check_host(host: str) -> None:
    """Check the name under which a proxy offers a page.

    Raises:
        ValueError: It has no port, or is an address to listen on.
    """
    name, _, port = host.rpartition(":")
    example = "expected NAME:PORT of a proxy that offers the page, such as robot.example:443"
    listen = "this is no address to listen on: the page is served on this machine alone, or by https with --tls NAME"
    try:
        is_everywhere = ipaddress.ip_address((name or host).strip("[]")).is_unspecified
    except ValueError:
        is_everywhere = False
    if is_everywhere:
        raise ValueError(f"{example}, not {host!r}; {listen}")
    if not name or not port.isdecimal() or not 0 < int(port) < 65536 or "/" in name:
        raise ValueError(f"{example}, not {host!r}; {listen}")
