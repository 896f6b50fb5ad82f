"""Ways to damage the bytes of a message."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

Damage = Callable[[Any, bytes, np.random.Generator], bytes]
"""The damaged bytes, from the message's type, its bytes, and a source of random numbers."""


def _bits(message_type: Any, data: bytes, random: np.random.Generator) -> bytes:
    damaged = np.frombuffer(data, np.uint8).copy()
    flipped = random.choice(8 * len(data), size=int(random.integers(1, 9)), replace=False)
    np.bitwise_xor.at(damaged, flipped // 8, (1 << (flipped % 8)).astype(np.uint8))
    return damaged.tobytes()


def _truncate(message_type: Any, data: bytes, random: np.random.Generator) -> bytes:
    return data[: int(random.integers(0, len(data)))]


def _trailing(message_type: Any, data: bytes, random: np.random.Generator) -> bytes:
    return data + random.bytes(int(random.integers(1, 65)))


def _random(message_type: Any, data: bytes, random: np.random.Generator) -> bytes:
    return random.bytes(len(data))


def _type(message_type: Any, data: bytes, random: np.random.Generator) -> bytes:
    # The fingerprint of no other type is so close by.
    return bytes([data[0] ^ 0xFF]) + data[1:]


def _nan(message_type: Any, data: bytes, random: np.random.Generator) -> bytes:
    try:
        message = message_type.decode(data)
    except Exception:
        # An earlier damage: what is no message has no numbers.
        return data
    _fill_with_nan(message)
    return bytes(message.encode())


def _fill_with_nan(message: Any) -> None:
    kind = type(message)
    for name, typename in zip(kind.__slots__, kind.__typenames__, strict=True):
        value = getattr(message, name)
        if typename in ("double", "float"):
            setattr(message, name, _like(value, math.nan))
        else:
            for part in _messages(value):
                _fill_with_nan(part)


def _like(value: Any, number: float) -> Any:
    return [_like(entry, number) for entry in value] if isinstance(value, list | tuple) else number


def _messages(value: Any) -> list[Any]:
    if isinstance(value, list | tuple):
        return [part for entry in value for part in _messages(entry)]
    return [value] if hasattr(value, "__typenames__") else []


DAMAGE: dict[str, Damage] = {
    "bits": _bits,
    "truncate": _truncate,
    "trailing": _trailing,
    "random": _random,
    "type": _type,
    "nan": _nan,
}
"""``bits``: one to eight bits are flipped; ``truncate``: the end is missing, from the last byte to all;
``trailing``: 1 to 64 random bytes follow; ``random``: as many random bytes; ``type``: the fingerprint is another one;
``nan``: every floating-point number is NaN."""
