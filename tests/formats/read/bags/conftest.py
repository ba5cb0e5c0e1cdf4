"""A bag of every kind in the folder of a test."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Write a bag: its kind, types, topics with their messages, and a name."""
    from tests.formats.read.bags.bag_writing import write_bag

    def make(bag: str, types: Any, topics: Any, name: str = "bag", **options: Any) -> Path:
        return write_bag(tmp_path, bag, types, topics, name=name, **options)

    return make
