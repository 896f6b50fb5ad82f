"""A short proof of what state a DPS is in."""

from __future__ import annotations

from hashlib import blake2b

from pydrake.systems.framework import Context

from vtbdrake.recording.log_format import DIGEST_SIZE
from vtbdrake.state.abstract_state import abstract_state
from vtbdrake.state.snapshot import numeric_groups
from vtbdrake.state.systems import leaves, read_group
from vtbdrake.testbed.addressed import AddressedDiagram

LARGEST = 1 << 14


class StateDigest:
    """BLAKE2b of all numeric groups of the DPS in a context, and of its abstract states as their codecs give them.

    Of an array beyond `LARGEST` bytes, an image say, its name and shape have to do: the loop must not wait for more.
    The DPS alone and the DPS in its testbed have the same one, if they are in the same state.
    """

    def __init__(self, target: AddressedDiagram, context: Context) -> None:
        self._parts = []
        for path, system in leaves(target.diagram):
            if path != "dps" and not path.startswith("dps."):
                continue
            leaf_context = system.GetMyContextFromRoot(context)
            groups = list(numeric_groups(leaf_context))
            abstract = abstract_state(path, system, leaf_context)
            if groups or abstract:
                self._parts.append((leaf_context, groups, abstract))

    def __call__(self) -> bytes:
        """Of the state as it is now: 16 bytes."""
        digest = blake2b(digest_size=DIGEST_SIZE)
        for leaf_context, groups, abstract in self._parts:
            for group, index in groups:
                digest.update(read_group(leaf_context, group, index).tobytes())
            arrays = abstract.read(leaf_context)
            for key in sorted(arrays, key=_number_and_name):
                array = arrays[key]
                digest.update(f"{_number_and_name(key)[1]}{array.shape}".encode())
                if array.nbytes <= LARGEST:
                    digest.update(array.tobytes())
        return digest.digest()


def _number_and_name(key: str) -> tuple[int, str]:
    index, _, name = key.partition("/")
    return int(index), name
