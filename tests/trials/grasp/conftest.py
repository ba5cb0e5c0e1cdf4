"""What tests of the controller share."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from evetac_cli.trials.grasp.loop import Timing
from tests.trials.grasp.bench import Bench


@pytest.fixture
def bench() -> Iterator[Callable[..., Bench]]:
    made: list[Bench] = []

    def make(**more: Any) -> Bench:
        made.append(Bench(Timing(100, 200, 100), **more))
        return made[-1]

    yield make
    for each in made:
        each.close()
