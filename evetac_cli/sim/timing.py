"""Measure the calls of a simulation that represent its parts."""

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

Call = TypeVar("Call", bound=Callable[..., Any])


class Timer(Protocol):
    """Measures the calls that belong to a part; code that makes such calls wraps them once and keeps the result."""

    def __call__(self, part: str, call: Call) -> Call:
        """Return the call, wrapped so that its time is counted for the part."""


def untimed(part: str, call: Call) -> Call:
    """Return the call itself: nothing is measured, so it costs nothing."""
    return call
