"""The names of engines, and in which order jobs are handed to them."""

from pathlib import Path

import pytest

from evetac_cli.cli import execution
from evetac_cli.cli.flags import scheduler_of
from evetac_cli.errors import InputError
from evetac_cli.jobs import Job


@pytest.mark.parametrize(
    "text",
    [
        "",
        "Dask",
        "dask",
        "dask:",
        "local:tcp://a:1",
        "dask:8786",
        "ray",
        "tcp://a:1",
        "dask:http://a:1",
        "dask:inproc://1",
    ],
)
def test_other_engines_are_refused(text: str) -> None:
    """Assert that whatever names no engine is refused with what does."""
    with pytest.raises(InputError, match="unknown engine"):
        scheduler_of(text)


def test_large_files_first(tmp_path: Path) -> None:
    """Assert that jobs are handed out by the size of their inputs, and equal ones in their order."""
    jobs = []
    for number, size in enumerate((1, 300, 1, 20)):
        path = tmp_path / f"{number}"
        path.write_bytes(bytes(size))
        jobs.append(Job((path, path), Path(f"{number}.h5")))
    missing = Job((tmp_path / "none",), Path("none.h5"))
    ordered = execution.largest_first([missing, *jobs])
    assert [job.output.stem for job in ordered] == ["1", "3", "0", "2", "none"]
