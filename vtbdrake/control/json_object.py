"""Requests that come as JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any


def json_object(text: bytes, error: Callable[[str], Exception], *, show: Callable[[Any], str] = repr) -> dict[str, Any]:
    """A request.

    Args:
        error: made of what is wrong.
        show: a value in a message.

    Raises:
        error: it is no JSON, or no object.
    """
    try:
        request = json.loads(text)
    except (ValueError, RecursionError) as problem:
        raise error(f"a request is JSON, which this is not: {problem}") from None
    if not isinstance(request, dict):
        raise error(f"a request is a JSON object, not {show(request)}")
    return request
