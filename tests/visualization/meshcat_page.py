"""Reads what Meshcat writes into a page: messages in msgpack, each in base64."""

from __future__ import annotations

import base64
import re
import struct
from typing import Any

_FIXED = {
    0xCA: ">f",
    0xCB: ">d",
    0xCC: ">B",
    0xCD: ">H",
    0xCE: ">I",
    0xCF: ">Q",
    0xD0: ">b",
    0xD1: ">h",
    0xD2: ">i",
    0xD3: ">q",
}
_CONSTANTS = {0xC0: None, 0xC2: False, 0xC3: True}


class _Reader:
    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, count: int) -> bytes:
        self.at += count
        return self.data[self.at - count : self.at]

    def number(self, form: str) -> Any:
        return struct.unpack(form, self.take(struct.calcsize(form)))[0]

    def value(self) -> Any:
        code = self.number(">B")
        if code < 0x80:
            return code
        if code >= 0xE0:
            return code - 0x100
        if code in _CONSTANTS:
            return _CONSTANTS[code]
        if code in _FIXED:
            return self.number(_FIXED[code])
        if code < 0x90:
            return self.mapping(code & 0x0F)
        if code < 0xA0:
            return self.array(code & 0x0F)
        if code < 0xC0:
            return self.take(code & 0x1F).decode()
        if code in (0xDE, 0xDF):
            return self.mapping(self.number(">H" if code == 0xDE else ">I"))
        if code in (0xDC, 0xDD):
            return self.array(self.number(">H" if code == 0xDC else ">I"))
        size = self.number(
            {0: ">B", 1: ">H", 2: ">I"}[
                (code - 0xC4) % 3 if code < 0xC7 else (code - 0xC7) % 3 if code < 0xCA else code - 0xD9
            ]
        )
        if code in (0xD9, 0xDA, 0xDB):
            return self.take(size).decode()
        if code in (0xC4, 0xC5, 0xC6):
            return self.take(size)
        self.take(1)  # the type of an extension, such as an array of floats
        return self.take(size)

    def mapping(self, count: int) -> dict[Any, Any]:
        return {self.value(): self.value() for _ in range(count)}

    def array(self, count: int) -> list[Any]:
        return [self.value() for _ in range(count)]


def decoded(message: bytes) -> Any:
    """A message of Meshcat."""
    return _Reader(message).value()


def messages(page: str) -> list[dict[str, Any]]:
    """All commands that the page plays when it is opened."""
    found = re.findall(r"base64,([A-Za-z0-9+/]{8,}={0,2})", page)
    commands = []
    for text in found:
        raw = base64.b64decode(text)
        if b"type" in raw[:4096] or b"set_" in raw:
            try:
                message = decoded(raw)
            except (IndexError, KeyError, struct.error, UnicodeDecodeError):
                continue
            if isinstance(message, dict) and "type" in message:
                commands.append(message)
    return commands
