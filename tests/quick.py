"""Tests with many parameters: a few of these in `make test`, all of them in `make test-all`."""

from collections.abc import Iterable
from typing import Any

import pytest


def few(parameters: Iterable[Any], *quick: Any) -> list[Any]:
    """The parameters, of which all but those named here are slow."""
    every = list(parameters)
    assert all(one in every for one in quick)
    return [one if one in quick else slow(one) for one in every]


def slow(parameter: Any) -> Any:
    """A parameter, or several that stand side by side, for `make test-all` alone."""
    values = parameter if isinstance(parameter, tuple) else (parameter,)
    return pytest.param(*values, marks=pytest.mark.slow)
