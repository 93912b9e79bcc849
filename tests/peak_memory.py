"""Largest memory of Python objects and arrays during a call."""

import tracemalloc
from collections.abc import Callable
from typing import Any


def peak_memory(function: Callable[..., Any], *arguments: Any, **options: Any) -> tuple[int, Any]:
    """Return the largest memory that a call allocates at a time, bytes, and its result."""
    tracemalloc.start()
    try:
        result = function(*arguments, **options)
        return tracemalloc.get_traced_memory()[1], result
    finally:
        tracemalloc.stop()
