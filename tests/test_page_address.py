"""Who gets to know the address of a page."""

import os
import stat
import sys
import tempfile
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from evetac_cli import page_address

TOKEN = "Zk3_-abcdefghijklmnopqrstuvwxyz01"
URL = f"http://127.0.0.1:40571/{TOKEN}/"


@pytest.fixture
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Addresses that a browser is opened with."""
    addresses: list[str] = []
    monkeypatch.setattr(webbrowser, "open", addresses.append)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(page_address, "SNAPS", tmp_path / "none")
    return addresses


@contextmanager
def stderr_to(path: Path, mode: int) -> Iterator[None]:
    """Messages go to a file of this mode."""
    with path.open("w", buffering=1) as file, pytest.MonkeyPatch.context() as patched:
        path.chmod(mode)
        patched.setattr(sys, "stderr", file)
        yield


def test_a_browser_is_opened_without_the_token(
    opened: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Assert that its argument is a file of mode 0600 in a folder of mode 0700, which leads on, and goes at the end."""
    before = os.umask(0)
    try:
        with page_address.announced(URL, "live view", opens=True):
            (address,) = opened
            assert TOKEN not in address
            page = Path(unquote(urlsplit(address).path))
            assert [stat.S_IMODE(path.stat().st_mode) for path in (page, page.parent)] == [0o600, 0o700]
            assert page.parent.parent == tmp_path
            assert f'http-equiv="refresh" content="0; url={URL}"' in page.read_text()
    finally:
        os.umask(before)
    assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr().err == f"live view: {URL}\n"


def test_nothing_is_left_of_a_recording_that_fails(opened: list[str], tmp_path: Path) -> None:
    """Assert that the file goes however the block ends, and that without a display no browser is opened."""
    for error in (KeyboardInterrupt, OSError, SystemExit):
        with pytest.raises(error), page_address.announced(URL, "live view", opens=False):
            raise error
    assert (list(tmp_path.iterdir()), opened) == ([], [])


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o604, 0o666])
def test_a_log_that_others_read_has_no_token(opened: list[str], tmp_path: Path, mode: int) -> None:
    """Assert that such a log names the file, which leads to the view."""
    with stderr_to(tmp_path / "log", mode), page_address.announced(URL, "live view", opens=False):
        said = (tmp_path / "log").read_text()
        assert TOKEN not in said
        page = Path(said.split()[3].removesuffix(";"))
        assert URL in page.read_text()


@pytest.mark.parametrize("mode", [0o600, 0o400, 0o620])
def test_a_log_of_the_users_own_has_it(opened: list[str], tmp_path: Path, mode: int) -> None:
    """Assert that the address stands where only the user reads it."""
    with stderr_to(tmp_path / "log", mode), page_address.announced(URL, "live view", opens=False):
        assert (tmp_path / "log").read_text() == f"live view: {URL}\n"


@pytest.mark.parametrize("name", page_address.BROWSERS)
def test_a_browser_in_a_snap_sees_the_file(
    opened: list[str], tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that the file lies in the home folder, not hidden, where a snap is installed, if it can be written to."""
    snaps, home = tmp_path / "snap", tmp_path / "home"
    snaps.mkdir()
    home.mkdir()
    (snaps / name).touch()
    monkeypatch.setattr(page_address, "SNAPS", snaps)
    monkeypatch.setenv("HOME", str(home))
    with page_address.announced(URL, "live view", opens=True):
        (folder,) = home.iterdir()
        assert not folder.name.startswith(".") and folder.stat().st_mode & 0o077 == 0
    assert list(home.iterdir()) == []
    monkeypatch.setenv("HOME", str(tmp_path / "none"))
    with page_address.announced(URL, "live view", opens=True):
        assert Path(unquote(urlsplit(opened[-1]).path)).parent.parent == tmp_path
