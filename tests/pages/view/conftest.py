"""A trial, and the page of one."""

from pathlib import Path

import pytest

from evetac_cli.commands.view import View
from evetac_cli.pages import view
from tests.pages.view.trials import write_trial


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    """A trial to be changed by a test."""
    return write_trial(tmp_path)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a trial."""
    recording = write_trial(tmp_path_factory.mktemp("page"))
    view.run([recording], View(), None)
    return recording.with_name("a.html")
