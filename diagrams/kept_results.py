"""Results of long campaigns, kept in files beside their studies: what they are, the command that makes them, a digest.

A row of the answers reads them, simulates a few of the cases again, and compares.
"""

from __future__ import annotations

import hashlib
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from vtbdrake.common.json_data import plain
from vtbdrake.state.archive import whole_file


class KeptResultsError(ValueError):
    """A file of results is missing, or was changed by something else than its command."""


def write_results(path: Path, results: Any, *, command: str) -> None:
    """Write results with the command that makes them, today's date and their digest, completely or not at all.

    Args:
        path: The file, ``.json``.
        results: Dataclasses, mappings, lists, arrays, numbers and texts; NaN and infinity become null.
        command: The command that makes the file.
    """
    stored = plain(results)
    date = datetime.now(UTC).date().isoformat()
    content = {"command": command, "date": date, "digest": _digest(stored), "results": stored}
    with whole_file(path) as partial:
        partial.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")


def read_results(path: Path) -> dict[str, Any]:
    """Return the results in a file of `write_results`.

    Raises:
        KeptResultsError: There is no such file, or the results do not have its digest.
    """
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise KeptResultsError(f"{path} is missing: make it by the command of its study") from None
    if _digest(content["results"]) != content["digest"]:
        raise KeptResultsError(f"the results in {path} do not have its digest: make it anew by {content['command']!r}")
    results: dict[str, Any] = content["results"]
    return results


def _digest(results: Any) -> str:
    return hashlib.sha256(json.dumps(results, sort_keys=True).encode()).hexdigest()
