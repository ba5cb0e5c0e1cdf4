"""The file with address and token: for its user alone, whole or not there, and never in the way of the next."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from evetac_cli.errors import InputError
from evetac_cli.resources import PACKAGE
from evetac_cli.trials.listen.address import AddressFile

TOKEN = "a" * 32


def test_it_is_for_its_user_alone_and_goes_at_the_end(tmp_path: Path) -> None:
    """Assert one line, mode 0600 whatever the umask, nothing beside it, and nothing after it."""
    before = os.umask(0)
    try:
        file = AddressFile(tmp_path / "evetac.listen", 4242, TOKEN)
    finally:
        os.umask(before)
    assert file.path.read_text() == f"127.0.0.1 4242 {TOKEN}\n"
    assert file.path.stat().st_mode & 0o7777 == 0o600
    assert list(tmp_path.iterdir()) == [file.path]
    file.remove()
    assert list(tmp_path.iterdir()) == []


def test_another_that_listens_is_not_replaced(tmp_path: Path) -> None:
    """Assert that a second one in the same folder is refused, and the first file stays as it is."""
    path = tmp_path / "evetac.listen"
    first = AddressFile(path, 1, TOKEN)
    with pytest.raises(InputError, match="another evetac"):
        AddressFile(path, 2, TOKEN)
    assert path.read_text().split()[1] == "1"
    assert list(tmp_path.iterdir()) == [path]
    first.remove()


def test_what_a_killed_one_left_is_replaced(tmp_path: Path) -> None:
    """Assert that the file of a process that was killed stands in nobody's way."""
    path = tmp_path / "evetac.listen"
    code = (
        "import os, signal, sys; from pathlib import Path; from evetac_cli.trials.listen.address import AddressFile;"
        f" AddressFile(Path(sys.argv[1]), 1, {TOKEN!r}); os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code, str(path)], cwd=PACKAGE.parent, check=False)
    assert path.read_text().split()[1] == "1"
    file = AddressFile(path, 2, TOKEN)
    assert path.read_text().split()[1] == "2"
    file.remove()
    assert list(tmp_path.iterdir()) == []


def test_a_file_system_without_links_will_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the file is written, and what another listens by is not replaced, where files have one name."""

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    path = tmp_path / "evetac.listen"
    file = AddressFile(path, 1, TOKEN)
    with pytest.raises(InputError, match="another evetac"):
        AddressFile(path, 2, TOKEN)
    assert path.read_text().split()[1] == "1"
    file.remove()
    path.write_text(f"127.0.0.1 1 {TOKEN}\n")
    AddressFile(path, 3, TOKEN).remove()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["text", "empty", "link", "folder", "pipe"])
def test_what_is_not_ours_stays(kind: str, tmp_path: Path) -> None:
    """Assert that a file that evetac did not make, a link, a folder and a pipe are refused, and untouched."""
    path, other = tmp_path / "evetac.listen", tmp_path / "other"
    other.write_text(f"127.0.0.1 1 {TOKEN}\n")
    make = {
        "text": lambda: path.write_text("my notes\n"),
        "empty": path.touch,
        "link": lambda: path.symlink_to(other),
        "folder": path.mkdir,
        "pipe": lambda: os.mkfifo(path),
    }
    make[kind]()
    before = path.lstat()
    with pytest.raises(InputError, match="not a file that evetac made"):
        AddressFile(path, 2, TOKEN)
    assert os.path.samestat(before, path.lstat())
    assert other.read_text() == f"127.0.0.1 1 {TOKEN}\n"
    assert sorted(tmp_path.iterdir()) == [path, other]


def test_a_file_in_its_place_is_not_taken_away(tmp_path: Path) -> None:
    """Assert that what another put there meanwhile stays at the end."""
    file = AddressFile(tmp_path / "evetac.listen", 1, TOKEN)
    file.path.unlink()
    file.path.write_text("another's\n")
    file.remove()
    assert file.path.read_text() == "another's\n"


def test_a_folder_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    """Assert that a folder that is not there is an error in words."""
    with pytest.raises(InputError, match="cannot be written"):
        AddressFile(tmp_path / "none" / "evetac.listen", 1, TOKEN)
