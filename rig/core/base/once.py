"""Results that are computed once for an immutable object, and shared, such as the matrices of a scene."""

import weakref
from collections.abc import Callable
from functools import wraps
from typing import TypeVar

Instance = TypeVar("Instance")
Result = TypeVar("Result")


def once_per_object(compute: Callable[[Instance], Result]) -> Callable[[Instance], Result]:
    """Decorate a function of an object: its result is computed once, and stored as long as the object exists.

    Objects are distinguished by identity, because a comparison of two scenes takes longer than most results.
    """
    results: dict[int, tuple[weakref.ref[Instance], Result]] = {}

    @wraps(compute)
    def shared(instance: Instance) -> Result:
        key = id(instance)
        stored = results.get(key)
        if stored is not None and stored[0]() is instance:
            return stored[1]
        result = compute(instance)
        results[key] = weakref.ref(instance, lambda _: results.pop(key, None)), result
        return result

    return shared
