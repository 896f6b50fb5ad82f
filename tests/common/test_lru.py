"""An `LruDict` drops what a list in the order of use drops."""

import random

import pytest

from vtbdrake.common.lru import LruDict


@pytest.mark.parametrize("size", [1, 2, 5])
def test_least_recently_used_entry_is_dropped(size: int) -> None:
    chance = random.Random(size)
    cache: LruDict[int, str] = LruDict(size)
    order: list[int] = []  # the keys, the most recently used last
    for _ in range(300):
        key = chance.randrange(2 * size + 1)
        expected = f"value {key}" if key in order else None
        assert cache.use(key) == expected
        oldest = order[0] if len(order) == size and key not in order else None
        order = [k for k in order if k not in (key, oldest)] + [key]
        dropped = cache.add(key, f"value {key}")
        assert dropped == (None if oldest is None else f"value {oldest}")
        assert list(cache) == order


def test_a_missing_key_is_no_use() -> None:
    cache: LruDict[str, int] = LruDict(2)
    assert cache.use("a") is None
    assert len(cache) == 0
