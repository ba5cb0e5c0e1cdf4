"""scripts/lowest.py: the lowest versions that pyproject.toml allows, of everything, none above the tested one."""

import re

import pytest
from packaging.version import Version

from scripts import lowest


def test_a_bound_becomes_a_pin() -> None:
    """Assert that each name keeps its lowest version, in the order of names."""
    assert lowest.lowest_versions(["typer>=0.26", "h5py>=3.12.1"]) == ["h5py==3.12.1", "typer==0.26"]


@pytest.mark.parametrize("requirement", ["numpy", "numpy<3", "numpy>=2,<3", "numpy==2.0", "numpy>=2; extra == 'a'"])
def test_another_form_of_requirement_is_refused(requirement: str) -> None:
    """Assert that no requirement is left out without a word: it would be installed at its newest."""
    with pytest.raises(ValueError, match="expected name>=version"):
        lowest.lowest_versions([requirement])


def test_no_bound_is_above_the_version_that_is_tested() -> None:
    """Assert that constraints.txt names every requirement, extras too, at its lowest version or a later one."""
    text = (lowest.PYPROJECT.parent / "constraints.txt").read_text()
    tested = dict(re.findall(r"^([\w.-]+)==(\S+)$", text, re.MULTILINE))
    for pin in lowest.lowest_versions(lowest.requirements_of(lowest.PYPROJECT)):
        name, version = pin.split("==")
        assert Version(version) <= Version(tested[name]), name
