"""Print the lowest versions that pyproject.toml allows, one `name==version` per line, as constraints for pip.

`make test-lowest` installs exactly these versions and runs the tests, so that every lower bound is tested.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"
BOUND = re.compile(r"([A-Za-z0-9._-]+)>=([0-9][0-9a-z.]*)")


def lowest_versions(requirements: list[str]) -> list[str]:
    """Return `name==version` for each `name>=version`; ValueError for any other form of requirement."""
    pins = []
    for requirement in requirements:
        match = BOUND.fullmatch(requirement)
        if match is None:
            raise ValueError(f"pyproject.toml: expected name>=version, found {requirement!r}")
        pins.append(f"{match[1]}=={match[2]}")
    return sorted(pins)


def requirements_of(pyproject: Path) -> list[str]:
    """Return the requirements of the package and all extras except `docs`, whose versions are pinned."""
    project = tomllib.loads(pyproject.read_text())["project"]
    extras = project["optional-dependencies"].items()
    needed = [requirement for name, extra in extras if name != "docs" for requirement in extra]
    return [*project["dependencies"], *needed]


if __name__ == "__main__":
    sys.stdout.write("\n".join(lowest_versions(requirements_of(PYPROJECT))) + "\n")
