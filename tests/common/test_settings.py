"""Settings: one declaration of type, range and unit, and one wording of what is refused."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, nan

import numpy as np
import pytest

from vtbdrake.common.settings import check_settings, declared_settings, schema, setting


@dataclass
class Lens:
    """A lens."""

    focus: float = setting(0.1, "Focal length.", unit="m", gt=0.0, remedy="it collects light")


@dataclass
class Eye:
    """An eye.

    It sees.
    """

    rate: float = setting(10.0, "Images per second.", unit="Hz", gt=0.0, le=50.0)
    pixels: int = setting(8, ge=1)
    share: float = setting(0.5, ge=0.0, lt=1.0)
    shift: float = setting(0.0, unit="m")
    reach: float = setting(inf, unit="m", ge=0.0, finite=False)
    kind: str = setting("round", choices=("round", "oval", ""))
    window: tuple[float, float] = setting((0.0, 1.0), "Near and far.", unit="m", ge=0.0)
    names: Sequence[str | int] = ()
    gains: Mapping[str, float] = setting(default_factory=dict, ge=0.0)
    timeout: float | None = setting(None, unit="s", gt=0.0)
    is_open: bool = True
    lens: Lens = field(default_factory=Lens)
    lenses: list[Lens] = field(default_factory=list)
    anything: object = None


@dataclass
class SlowEye(Eye):
    rate: float = 2.0


def test_possible_values_are_accepted() -> None:
    check_settings(Eye(rate=50.0, pixels=np.int32(4), shift=np.float64(-1e9), window=[2, 3], names=["a", 1], timeout=3))
    check_settings(Eye(pixels=10**400))
    check_settings(Eye(gains={"a": 0.0}, timeout=0.1, kind="", lenses=[Lens()], anything=nan, names={"a"}))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"rate": 0.0}, "Eye.rate must be a number above 0 and at most 50 Hz, not 0.0"),
        ({"rate": 51}, "Eye.rate must be a number above 0 and at most 50 Hz, not 51"),
        ({"rate": nan}, "Eye.rate must be a number above 0 and at most 50 Hz, not nan"),
        ({"rate": True}, "Eye.rate must be a number above 0 and at most 50 Hz, not True"),
        ({"rate": "9"}, "Eye.rate must be a number above 0 and at most 50 Hz, not '9'"),
        ({"rate": None}, "Eye.rate must be a number above 0 and at most 50 Hz, not None"),
        ({"rate": [9.0]}, "Eye.rate must be a number above 0 and at most 50 Hz, not [9.0]"),
        ({"pixels": 0}, "Eye.pixels must be a whole number of at least 1, not 0"),
        ({"pixels": -(10**400)}, "Eye.pixels must be a whole number of at least 1, not -1000"),
        ({"pixels": 2.0}, "Eye.pixels must be a whole number of at least 1, not 2.0"),
        ({"share": 1.0}, "Eye.share must be a number from 0 to below 1, not 1.0"),
        ({"shift": -inf}, "Eye.shift must be a finite number in m, not -inf"),
        ({"reach": nan}, "Eye.reach must be a number of at least 0 m, not nan"),
        ({"kind": "flat"}, "Eye.kind must be one of round, oval, empty, not 'flat'"),
        ({"kind": 3}, "Eye.kind must be one of round, oval, empty, not 3"),
        ({"window": (0.0, 1.0, 2.0)}, "Eye.window must be a list of 2 entries, not (0.0, 1.0, 2.0)"),
        ({"window": (0.0, -1.0)}, "Eye.window[1] must be a finite number of at least 0 m, not -1.0"),
        ({"names": "ab"}, "Eye.names must be a list, such as ['ab'], not 'ab'"),
        ({"names": ["a", 1.5]}, "Eye.names[1] must be a text or a whole number, not 1.5"),
        ({"gains": [1.0]}, "Eye.gains must be a mapping, not [1.0]"),
        ({"gains": {"left": -1.0}}, "Eye.gains[left] must be a finite number of at least 0, not -1.0"),
        ({"timeout": 0.0}, "Eye.timeout must be a finite number above 0 s or None, not 0.0"),
        ({"is_open": 1}, "Eye.is_open must be True or False, not 1"),
        ({"lens": Lens(-1.0)}, "Eye.lens.focus must be a finite number above 0 m, not -1.0: it collects light"),
        (
            {"lenses": [Lens(), Lens(inf)]},
            "Eye.lenses[1].focus must be a finite number above 0 m, not inf: it collects",
        ),
    ],
)
def test_impossible_values_are_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError) as refusal:
        check_settings(Eye(**values))
    assert str(refusal.value).startswith(message)


@dataclass
class Slice:
    """A range of heights and of widths."""

    heights: tuple[float, float] = setting((0.0, 1.0), unit="m", ascending=True)
    least: int = setting(2, below="largest")
    largest: int = 3


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"heights": (1.0, 1.0)}, r"Slice.heights must be the lower one, then the upper one, not \(1.0, 1.0\)"),
        ({"least": 3}, "Slice.least must be below the largest, 3, not 3"),
        ({"largest": 1}, "Slice.least must be below the largest, 1, not 2"),
    ],
)
def test_settings_out_of_order_are_refused(values: dict[str, object], message: str) -> None:
    check_settings(Slice())
    with pytest.raises(ValueError, match=f"^{message}$"):
        check_settings(Slice(**values))


def test_another_default_keeps_the_range() -> None:
    assert declared_settings(SlowEye)["rate"] == declared_settings(Eye)["rate"]
    with pytest.raises(ValueError, match="SlowEye.rate must be a number above 0"):
        check_settings(SlowEye(rate=-1.0))


def test_name_and_error_are_those_of_the_caller() -> None:
    class EyeError(ValueError):
        pass

    with pytest.raises(EyeError, match="robot.eye.lens.focus must be"):
        check_settings(Eye(lens=Lens(0.0)), name="robot.eye", error=EyeError)


def test_schema_says_what_is_checked() -> None:
    described = json.loads(json.dumps(schema(SlowEye), allow_nan=False))
    assert (described["title"], described["type"], described["additionalProperties"]) == ("SlowEye", "object", False)
    properties = described["properties"]
    assert properties["rate"] == {
        "description": "Images per second.",
        "unit": "Hz",
        "type": "number",
        "exclusiveMinimum": 0.0,
        "maximum": 50.0,
        "default": 2.0,
    }
    assert properties["pixels"] == {"type": "integer", "minimum": 1, "default": 8}
    assert properties["reach"] == {"unit": "m", "type": "number", "minimum": 0.0}
    assert properties["kind"] == {"type": "string", "enum": ["round", "oval", ""], "default": "round"}
    assert properties["window"]["items"] == {"type": "number", "minimum": 0.0}
    assert (properties["window"]["minItems"], properties["window"]["maxItems"]) == (2, 2)
    assert properties["names"]["items"] == {"type": ["string", "integer"]}
    assert properties["gains"]["additionalProperties"] == {"type": "number", "minimum": 0.0}
    assert properties["timeout"] == {"unit": "s", "type": ["number", "null"], "exclusiveMinimum": 0.0}
    assert properties["lens"]["description"] == "A lens."
    assert properties["lens"]["properties"]["focus"]["default"] == 0.1
    assert properties["anything"] == {}


@dataclass
class Shelf:
    """A shelf."""

    boxes: dict[str, dict[str, float | None]] = setting(default_factory=dict, ge=0.0)
    lens: list[Lens] | None = None
    pairs: Sequence[tuple[int, str]] = ()


def test_types_inside_of_types_are_checked() -> None:
    check_settings(Shelf(boxes={"a": {"b": None, "c": 1.0}}, lens=[Lens()], pairs=[(1, "a")]))
    with pytest.raises(ValueError, match=r"^Shelf.boxes\[a\]\[b\] must be a finite number of at least 0 or None, not"):
        check_settings(Shelf(boxes={"a": {"b": -1.0}}))
    with pytest.raises(ValueError, match=r"^Shelf.pairs\[0\] must be a list of 2 entries, not \(1,\)"):
        check_settings(Shelf(pairs=[(1,)]))
    with pytest.raises(ValueError, match=r"^Shelf.pairs\[0\]\[1\] must be a text, not 2"):
        check_settings(Shelf(pairs=[(1, 2)]))
    with pytest.raises(ValueError, match="^Shelf.lens must be a list or None, not 1"):
        check_settings(Shelf(lens=1))
    properties = schema(Shelf)["properties"]
    assert properties["boxes"]["additionalProperties"]["additionalProperties"]["type"] == ["number", "null"]
    assert properties["lens"]["items"]["properties"]["focus"]["default"] == 0.1


def test_class_of_another_process_is_of_any_type() -> None:
    class Rock:
        pass

    @dataclass
    class Field:
        """The names of types inside functions cannot be looked up, as a notebook's in another process."""

        rocks: list[Rock] | None = None
        first: Rock.Part | None = None
        size: float = 1.0

    check_settings(Field(rocks=[Rock()], first=3))
    with pytest.raises(ValueError, match="^Field.rocks must be a list or None, not 5"):
        check_settings(Field(rocks=5))
    with pytest.raises(ValueError, match="^Field.size must be a finite number, not 'a'"):
        check_settings(Field(size="a"))
