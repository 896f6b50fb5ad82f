"""A short proof of what state a DPS is in."""

from __future__ import annotations

from hashlib import blake2b

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.control.recording.log_format import DIGEST_SIZE
from vtbdrake.state.snapshot import numeric_groups
from vtbdrake.state.systems import is_python, leaves, read_group
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
            codecs = dict(getattr(system, "codecs", {})) if is_python(system) else {}
            if groups or codecs:
                self._parts.append((leaf_context, groups, codecs))

    def __call__(self) -> bytes:
        """Of the state as it is now: 16 bytes."""
        digest = blake2b(digest_size=DIGEST_SIZE)
        for leaf_context, groups, codecs in self._parts:
            for group, index in groups:
                digest.update(read_group(leaf_context, group, index).tobytes())
            for index, codec in codecs.items():
                arrays = codec.encode(leaf_context.get_abstract_state(index).get_value())
                for name, array in sorted(arrays.items()):
                    digest.update(f"{name}{np.shape(array)}".encode())
                    if np.asarray(array).nbytes <= LARGEST:
                        digest.update(np.asarray(array).tobytes())
        return digest.digest()
