"""Attributes and parameters that were renamed: the old name still works, with a warning."""

import functools
import warnings
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def renamed(old: str, new: str) -> property:
    """Return a property for the old name of an attribute, which warns that the name is deprecated."""

    def read(owner: Any) -> Any:
        _warn(f"{type(owner).__name__}.{old}", new)
        return getattr(owner, new)

    return property(read, doc=f"Deprecated name of `{new}`.")


def renamed_parameter(old: str, new: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Let a function accept the old name of a keyword parameter, with a warning that the name is deprecated."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def call(*arguments: P.args, **keywords: P.kwargs) -> R:
            if old in keywords:
                _warn(f"{function.__name__}({old}=)", new)
                keywords[new] = keywords.pop(old)
            return function(*arguments, **keywords)

        return call

    return decorate


def _warn(old: str, new: str) -> None:
    warnings.warn(f"{old} is deprecated. Use {new}.", DeprecationWarning, stacklevel=3)
