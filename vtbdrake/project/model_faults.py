"""Faults of model files that Drake reads as something else, or refuses in words of its own."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

from vtbdrake.project.xml_text import XmlElement

_NOT_READ = ("gazebo", "plugin", "sensor", "custom", "text", "ros2_control")
"""Elements that Drake does not read, with any text in them."""

_NAMES = ("name", "filename", "file", "link", "joint", "parent", "child", "class", "uri")
"""Attributes and elements that hold names."""

_NUMBER = re.compile(r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?")
"""A number, with a point or a comma."""


def faults(root: XmlElement) -> Iterator[tuple[XmlElement, str]]:
    """Yield what is wrong in a URDF, SDF or MJCF file, each with its element, as a sentence that ends with a remedy.

    Args:
        root: The root of the file.
    """
    for element in elements_read(root):
        yield from ((element, fault) for check in _CHECKS for fault in check(element))
    if root.tag == "robot":
        yield from _twice(root)


def elements_read(element: XmlElement) -> Iterator[XmlElement]:
    """Yield an element and all below it, but for those that Drake does not read."""
    if element.tag not in _NOT_READ:
        yield element
        for child in element.children:
            yield from elements_read(child)


def values(element: XmlElement) -> dict[str, str]:
    """Return the attributes of an element that are no names, and its text by its tag, where it has no children."""
    texts = {**element.attributes, **({} if element.children else {element.tag: element.text})}
    return {name: text for name, text in texts.items() if name not in _NAMES}


def _is_xacro(element: XmlElement) -> Iterator[str]:
    expression = next((value for value in element.attributes.values() if "${" in value), "")
    if element.tag.startswith("xacro:") or expression:
        shown = expression or f"<{element.tag}>"
        yield f"{shown} is of xacro, which Drake does not know: first xacro FILE > robot.urdf"


def _has_commas(element: XmlElement) -> Iterator[str]:
    for name, text in values(element).items():
        numbers = text.split()
        if "," in text and all(map(_NUMBER.fullmatch, numbers)):
            yield (
                f"the {name} {text.strip()!r} has a comma, at which Drake stops to read: write decimal points, and "
                "blanks between numbers"
            )


def _has_no_mass(element: XmlElement) -> Iterator[str]:
    inertial = element.find("inertial") if element.tag in ("link", "body") else None
    if inertial is None:
        return
    child = inertial.find("mass")
    text = inertial.attributes.get("mass") if child is None else child.attributes.get("value", child.text)
    if text is not None and not as_number(text) >= 0.0:
        yield f"the mass of {element.get('name')} is {text.strip()!r}: give a number that is not negative"


def _has_no_range(element: XmlElement) -> Iterator[str]:
    if element.tag != "joint":
        return
    ends = [*map(as_number, element.get("range").split())]  # MJCF
    for limit in element.iter("limit"):
        lower, upper = (
            limit.get(end) or (child.text if (child := limit.find(end)) is not None else "")
            for end in ("lower", "upper")
        )
        ends = ends or [as_number(lower), as_number(upper)]
    if len(ends) == 2 and ends[0] > ends[1]:
        yield (
            f"the range of {element.get('name') or 'a joint'} is empty, {ends[0]:g} to {ends[1]:g}: give it a lower "
            "and an upper limit, or make it a fixed joint"
        )


def _twice(root: XmlElement) -> Iterator[tuple[XmlElement, str]]:
    lines: dict[tuple[str, str], int] = {}
    for element in root.children:
        key = element.tag, element.get("name")
        if element.tag in ("link", "joint") and lines.setdefault(key, element.line) != element.line:
            yield element, f"a second {element.tag} {key[1]}, after the one in line {lines[key]}: rename one of them"


def as_number(text: str) -> float:
    """Return a number, or NaN where a text is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


_CHECKS = (_is_xacro, _has_commas, _has_no_mass, _has_no_range)
