"""What the script of a page needs, so that a browser asks for all of it at once, and not for one after the other."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from importlib.util import find_spec
from pathlib import Path

_IMPORTED = re.compile(r'\bfrom "\./([\w./]+\.js)"')
# Style sheets and scripts that are no modules: load("link", { ..., href: "page/view.css" }) in common.js.
_LOADED = re.compile(r'\bload\("(?:link|script)", \{[^}]*"page/([\w./]+)"')
_KINDS = {".css": "style", ".js": "script"}


def preloads(script: str, packages: Collection[str]) -> str:
    """Return the links in HTML by which a browser fetches what a module imports and loads, while it parses the page.

    Args:
        script: The module, in the folder ``page`` of one of the packages.
        packages: The packages.
    """
    folders = [Path(where) / "page" for name in packages for where in _places(name)]
    modules, loaded = [script], []
    for module in modules:  # grows
        text = next((file.read_text("utf-8") for folder in folders if (file := folder / module).is_file()), "")
        modules += [name for name in _IMPORTED.findall(text) if name not in modules]
        loaded += [name for name in _LOADED.findall(text) if name not in loaded]
    links = [f'<link rel="modulepreload" href="page/{name}">' for name in modules]
    links += [f'<link rel="preload" as="{_KINDS[Path(name).suffix]}" href="page/{name}">' for name in loaded]
    return "".join(f"{link}\n" for link in links)


def _places(package: str) -> Iterator[str]:
    spec = find_spec(package)
    assert spec is not None
    yield from spec.submodule_search_locations or ()
