"""Reports: where they lie, and what they are called."""

from pathlib import Path

import pytest

from evetac_cli.evaluate.common.report import report_job


@pytest.mark.parametrize(
    ("files", "out", "report"),
    [
        (["a/x.tracks.h5"], None, "a/x.tracking.report.h5"),
        (["x.tracks.h5"], None, "x.tracking.report.h5"),
        (["a/x.tracks.h5", "a/y.tracks.h5"], None, "a/a.tracking.report.h5"),
        (["a/x.tracks.h5", "b/x.tracks.h5", "a/y.tracks.h5"], None, "a-b.tracking.report.h5"),
        (["d/a/x.tracks.h5", "d/b/x.tracks.h5"], None, "d/a-b.tracking.report.h5"),
        (["d/x.tracks.h5", "d/b/x.tracks.h5"], None, "d/d-b.tracking.report.h5"),
        ([f"{name}/x.tracks.h5" for name in "abcde"], None, "a-b-c-and-2-more.tracking.report.h5"),
        (["a/x.tracks.h5", "a/y.tracks.h5"], "out", "out/a.tracking.report.h5"),
        (["a/x.tracks.h5", "b/y.tracks.h5"], "r.report.h5", "r.report.h5"),
    ],
)
def test_names(files: list[str], out: str | None, report: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a report of one file has its name, and one of several those of their folders, in what holds them."""
    monkeypatch.chdir(tmp_path)
    (job,) = report_job([Path(name) for name in files], "tracking", None if out is None else Path(out))
    assert job.output == Path(report)
    assert job.inputs == tuple(map(Path, files))


def test_files_of_the_present_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the present folder has its own name, too."""
    (tmp_path / "data").mkdir()
    monkeypatch.chdir(tmp_path / "data")
    (job,) = report_job([Path("x.tracks.h5"), Path("y.tracks.h5")], "tracking", None)
    assert job.output == Path("data.tracking.report.h5")
