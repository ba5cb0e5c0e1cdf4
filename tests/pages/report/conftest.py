"""A study, and what report reads of it."""

from pathlib import Path

import pytest

from evetac_cli.jobs import silent
from evetac_cli.pages.report.study import Study, read_study
from tests.pages.report.studies import write_study


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_study(tmp_path_factory.mktemp("studies") / "study")


@pytest.fixture(scope="module")
def study(folder: Path) -> Study:
    return read_study(folder, silent)
