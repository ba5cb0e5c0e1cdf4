"""What tests of the controller share."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
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


@pytest.fixture
def explained() -> Callable[[str, str], set[str]]:
    """The figures in the first column of the table below a heading of a page of the docs."""

    def figures(page: str, heading: str) -> set[str]:
        part = (Path(__file__).parents[3] / "docs" / page).read_text().partition(f"### {heading}\n")[2]
        first_cells = [line.split("|")[1] for line in part.partition("\n###")[0].splitlines() if line[:3] == "| `"]
        return set(re.findall("`(\\w+)`", " ".join(first_cells)))

    return figures
