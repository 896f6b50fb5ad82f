"""Results of long campaigns, kept in files beside their studies: what they are, the command that makes them, a digest.

A row of the answers reads them, makes a tenth of them again, drawn at random, and compares: see `repeat`.
"""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from math import ceil, floor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from vtbdrake.common.json_data import plain
from vtbdrake.state.archive import whole_file
from vtbdrake_diagrams.processes import in_processes

SHARE = 0.1
"""The share of the kept results that a row of the answers makes again."""

_Case = TypeVar("_Case")
_Result = TypeVar("_Result")


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


def add_results(
    path: Path,
    results: dict[int, _Result],
    seeds: Iterable[int],
    function: Callable[[int], _Result],
    *,
    command: str,
    workers: int | None = None,
) -> None:
    """Make the results of the seeds that are not among some results, in processes, and keep all after each of them.

    Args:
        path: The file, see `write_results`.
        results: The results by seed, which are added to.
        seeds: The seeds.
        function: A function of a module that makes the result of a seed.
        command: The command that makes the file.
        workers: The number of processes, see `in_processes`.
    """
    missing = [seed for seed in seeds if seed not in results]
    for seed, result in in_processes(function, missing, workers=workers):
        results[seed] = result
        write_results(path, results, command=command)
        print(f"{len(results)} results", flush=True)


def _digest(results: Any) -> str:
    return hashlib.sha256(json.dumps(results, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Repetition:
    """Kept results that were made again.

    Attributes:
        kind: What they are results of, in the plural: "captures".
        total: The number of kept results.
        count: The number of results that were made again.
        seed: The seed by which these were drawn.
        different: The cases whose result is another one now, in words.
        allowed: How many of these there may be.
    """

    kind: str
    total: int
    count: int
    seed: int
    different: tuple[str, ...]
    allowed: int = 0

    @property
    def same(self) -> bool:
        """Return whether the results came out as they are kept, but for those that are allowed not to."""
        return len(self.different) <= self.allowed

    def __str__(self) -> str:
        outcome = "as kept"
        if self.different:
            but = f"as kept but for at most {self.allowed}" if self.same else "OTHERS than kept"
            outcome = f"{but}: {'; '.join(self.different)}"
        return f"{self.count} of {self.total} kept {self.kind} simulated again (drawn by seed {self.seed}): {outcome}"


def repeat(
    kind: str,
    results: Mapping[_Case, _Result],
    function: Callable[[_Case], _Result],
    agree: Callable[[_Result, _Result], bool],
    *,
    share: float = SHARE,
    allowed: float = 0.0,
    seed: int | None = None,
    workers: int | None = None,
) -> Repetition:
    """Make a random share of some kept results again, in processes, and compare.

    Args:
        kind: What they are results of, in the plural.
        results: The kept results by case; a case in words is its text.
        function: A function of a module that makes the result of a case.
        agree: Returns whether a kept result and a new one are the same, but for rounding on another processor.
        share: The share of the cases that is drawn; at least one case is.
        allowed: The share of these that may come out differently: where rounding decides, as in a track that is almost
            lost, another processor has another result, whatever ``agree`` allows.
        seed: The seed of the draw; None draws the seed, too.
        workers: The number of processes, see `in_processes`.
    """
    seed = secrets.randbelow(2**32) if seed is None else seed
    cases = list(results)
    numbers = np.random.default_rng(seed).choice(len(cases), ceil(share * len(cases)), replace=False)
    drawn = [cases[number] for number in sorted(numbers.tolist())]
    again = in_processes(function, drawn, workers=workers)
    different = tuple(str(case) for case, result in again if not agree(results[case], result))
    return Repetition(kind, len(cases), len(drawn), seed, different, floor(allowed * len(drawn)))
