"""Where compiled code and modules are loaded from: nothing that another user, or the working folder, could have put."""

import os
import pickle
import stat
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import pytest
from typer.testing import CliRunner

from evetac_cli import kernel_cache
from evetac_cli.cli.main import app
from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.resources import PACKAGE

OTHER_USER = 64002


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A folder of this user's in which nobody else can write, whatever the umask."""
    tmp_path.chmod(0o755)
    return tmp_path


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


# --- whose folder -----------------------------------------------------------------------------------------------------


def test_a_folder_is_made_for_this_user_alone(own: Path) -> None:
    """Assert mode 0700 of all that is made, whatever the umask, and that the same folder is found again."""
    before = os.umask(0)
    try:
        folder = own / "evetac" / "numba"
        assert kernel_cache.own_folder([folder]) == folder.resolve()
    finally:
        os.umask(before)
    assert (mode(folder), mode(folder.parent)) == (0o700, 0o700)
    (folder / "kernel").touch()
    assert kernel_cache.own_folder([folder]) == folder.resolve()


@pytest.mark.parametrize("others", [0o777, 0o770, 0o755, 0o707, 0o701, 0o1777])
def test_a_folder_that_others_see_into_is_not_used(own: Path, others: int) -> None:
    """Assert that one that was there before with any right for others is left alone."""
    folder = own / "numba"
    folder.mkdir()
    folder.chmod(others)
    assert kernel_cache.own_folder([folder]) is None
    assert mode(folder) == others


@pytest.mark.parametrize("above", [0o777, 0o775, 0o757])
def test_a_folder_that_others_can_exchange_is_not_used(own: Path, above: int) -> None:
    """Assert that nothing is made or used below a folder whose entries others may rename, but below a sticky one."""
    shared = own / "shared"
    (shared / "deep").mkdir(parents=True)
    (shared / "deep" / "numba").mkdir(mode=0o700)
    shared.chmod(above)
    for folder in (shared / "numba", shared / "deep" / "numba", shared / "new" / "numba"):
        assert kernel_cache.own_folder([folder]) is None
    assert sorted(entry.name for entry in shared.iterdir()) == ["deep"]
    shared.chmod(above | stat.S_ISVTX)
    assert kernel_cache.own_folder([shared / "deep" / "numba"]) == (shared / "deep" / "numba").resolve()


def test_a_link_is_not_used(own: Path) -> None:
    """Assert that a link to a folder of one's own, to nothing, or to a file is no folder; links above it are followed.

    What they lead to is looked at as any other folder: clusters keep ~/.cache elsewhere by a link.
    """
    target, elsewhere = own / "target", own / "elsewhere"
    target.mkdir(mode=0o700)
    for number, to in enumerate((target, own / "nothing", own / "file")):
        (own / "file").touch()
        (own / f"link-{number}").symlink_to(to)
        assert kernel_cache.own_folder([own / f"link-{number}"]) is None
    assert list(target.iterdir()) == [] and not (own / "nothing").exists()
    (own / "cache").symlink_to(elsewhere)
    elsewhere.mkdir()
    assert kernel_cache.own_folder([own / "cache" / "numba"]) == (elsewhere / "numba").resolve()
    elsewhere.chmod(0o777)
    assert kernel_cache.own_folder([own / "cache" / "numba"]) is None


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives folders away")
def test_a_folder_of_another_user_is_not_used(own: Path) -> None:
    """Assert that neither the folder nor one above it may belong to somebody else, whatever its mode."""
    theirs, above = own / "theirs", own / "above"
    (above / "numba").mkdir(parents=True, mode=0o700)
    theirs.mkdir(mode=0o700)
    for folder in (theirs, above):
        os.chown(folder, OTHER_USER, OTHER_USER)
    assert kernel_cache.own_folder([theirs, above / "numba", above / "new"]) is None
    assert not (above / "new").exists()


def test_candidates(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert the order: the user's cache, then temporary files; nothing that is relative or has no home is named."""
    monkeypatch.setattr(tempfile, "tempdir", "/tmp")
    last = Path(f"/tmp/evetac-numba-{os.geteuid()}")
    monkeypatch.setenv("HOME", str(own))
    monkeypatch.setenv("XDG_CACHE_HOME", str(own / "xdg"))
    home = own / ".cache/evetac/numba"
    assert list(kernel_cache._candidates()) == [own / "xdg/evetac/numba", home, last]
    for relative in ("", "cache", "./cache"):
        monkeypatch.setenv("XDG_CACHE_HOME", relative)
        assert list(kernel_cache._candidates()) == [home, last]
    monkeypatch.setenv("HOME", str(own / "none"))
    assert list(kernel_cache._candidates()) == [last]


# --- what is in it ----------------------------------------------------------------------------------------------------


@pytest.fixture
def package(own: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package of its own with two compiled kernels, that this user cannot write to."""
    folder = own / "package"
    (folder / "kernels" / "__pycache__").mkdir(parents=True)
    for name in ("track.step-7.py311.nbi", "track.step-7.py311.1.nbc", "track.cpython-311.pyc"):
        (folder / "kernels" / "__pycache__" / name).write_text(name)
    for path in (folder, *folder.rglob("*")):
        path.chmod(path.stat().st_mode & ~0o022)
    monkeypatch.setattr(kernel_cache, "PACKAGE", folder)
    monkeypatch.setattr(kernel_cache, "is_beside_source", lambda: False)
    monkeypatch.setenv("HOME", str(own))
    monkeypatch.setenv("XDG_CACHE_HOME", str(own / "xdg"))
    monkeypatch.setenv("TMPDIR", str(own))
    monkeypatch.setattr(tempfile, "tempdir", None)
    for name in ("NUMBA_CACHE_DIR", "NUMBA_CACHE_LOCATOR_CLASSES", "PYTHONSAFEPATH", "MPLCONFIGDIR"):
        monkeypatch.setenv(name, "")  # so that it is as it was after the test
        monkeypatch.delenv(name)
    return folder


def test_kernels_of_the_installer_are_taken_over(package: Path) -> None:
    """Assert that each user gets those that were compiled at installation under numba's own name, newer ones again."""
    folder = kernel_cache.folder_for_kernels()
    assert folder is not None
    place = folder / kernel_cache.numba_name(package / "kernels")
    assert sorted(path.name for path in place.iterdir()) == ["track.step-7.py311.1.nbc", "track.step-7.py311.nbi"]
    mine, theirs = place / "track.step-7.py311.nbi", package / "kernels/__pycache__/track.step-7.py311.nbi"
    mine.write_text("with one more")
    os.utime(mine, (theirs.stat().st_atime, theirs.stat().st_mtime + 1))
    kernel_cache.folder_for_kernels()
    assert mine.read_text() == "with one more"
    os.utime(theirs, (theirs.stat().st_atime, theirs.stat().st_mtime + 2))
    kernel_cache.folder_for_kernels()
    assert mine.read_text() == theirs.read_text()


def test_numba_finds_what_was_taken_over() -> None:
    """Assert that numba looks for kernels of a source file where they are copied to."""
    from numba.core import caching

    locator = next(kind for name, kind in vars(caching).items() if name.endswith("CacheLocator"))
    for module in ("kernels/tracking/tracker.py", "sim/gel/gel.py", "resources.py"):
        path = PACKAGE / module
        assert kernel_cache.numba_name(path.parent) == locator.get_suitable_cache_subpath(str(path))


@pytest.mark.parametrize("others", [0o666, 0o664, 0o646])
def test_kernels_that_others_could_have_written_are_not_taken_over(package: Path, others: int) -> None:
    """Assert that a kernel that the group or everybody can write to stays where it is, in such a folder too."""
    beside = package / "kernels" / "__pycache__"
    index = beside / "track.step-7.py311.nbi"
    index.chmod(others)
    folder = kernel_cache.folder_for_kernels()
    assert folder is not None
    place = folder / kernel_cache.numba_name(package / "kernels")
    assert [path.name for path in place.iterdir()] == ["track.step-7.py311.1.nbc"]
    index.chmod(0o644)
    beside.chmod(0o777)
    os.utime(index, (0, place.stat().st_mtime + 1))
    kernel_cache.folder_for_kernels()
    assert [path.name for path in place.iterdir()] == ["track.step-7.py311.1.nbc"]


# --- what a program settles -------------------------------------------------------------------------------------------


def test_a_program_settles_it_for_all_its_processes(package: Path, own: Path) -> None:
    """Assert that the environment names the user's folder, and bars numba's settings and the modules of a folder."""
    with kernel_cache.settled_by_environment() as note:
        assert note == ""
        assert os.environ["NUMBA_CACHE_DIR"] == str(own.resolve() / "xdg/evetac/numba")
        assert (os.environ["NUMBA_CACHE_LOCATOR_CLASSES"], os.environ["PYTHONSAFEPATH"]) == ("", "1")
        assert "MPLCONFIGDIR" not in os.environ


def test_kernels_beside_their_source_stay_there(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that numba is told to look there, and not where a file in the working folder says."""
    monkeypatch.setattr(kernel_cache, "is_beside_source", lambda: True)
    with kernel_cache.settled_by_environment() as note:
        assert (note, os.environ["NUMBA_CACHE_DIR"]) == ("", "")


def test_what_the_user_names_is_taken(package: Path, own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that NUMBA_CACHE_DIR is the user's own business, and nothing else is made."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/somewhere")
    with kernel_cache.settled_by_environment() as note:
        assert (note, os.environ["NUMBA_CACHE_DIR"]) == ("", "/somewhere")
    assert [path.name for path in own.iterdir()] == ["package"]


def test_without_a_folder_of_ones_own_nothing_is_kept(
    package: Path, own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert a folder for this program alone where all others are traps, said in words, and gone at the end."""
    planted = own / f"evetac-numba-{os.geteuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(own / "none"))
    with kernel_cache.settled_by_environment() as note:
        folder = Path(os.environ["NUMBA_CACHE_DIR"])
        assert "NUMBA_CACHE_DIR" in note and "not kept" in note
        assert folder != planted and mode(folder) == 0o700
        assert os.environ["MPLCONFIGDIR"] == str(folder / "matplotlib")
        assert [path.name for path in folder.iterdir()] == [kernel_cache.numba_name(package / "kernels")]
        (folder / "kernel").touch()
    assert not folder.exists()
    assert list(planted.iterdir()) == []


def test_somebody_elses_program(package: Path, own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that `import evetac_cli` tells numba alone, warns where nothing is kept, and leaves its settings."""
    import numba

    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    before = dict(os.environ)
    kernel_cache.settle_for_this_process()
    assert Path(numba.config.CACHE_DIR) == own.resolve() / "xdg/evetac/numba"
    monkeypatch.setattr(numba.config, "CACHE_DIR", "/somewhere")
    kernel_cache.settle_for_this_process()
    assert str(numba.config.CACHE_DIR) == "/somewhere"
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(kernel_cache, "own_folder", lambda: None)
    with pytest.warns(RuntimeWarning, match="not kept"):
        kernel_cache.settle_for_this_process()
    with warnings.catch_warnings():
        kernel_cache.settle_for_this_process()  # once
    assert Path(numba.config.CACHE_DIR).parent == own and dict(os.environ) == before


# --- the working folder -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("content", ["cache_dir: /tmp/evil\n", "", "opt: 0\n", "- no settings\n"])
def test_numbas_settings_in_the_working_folder_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str
) -> None:
    """Assert that no command begins where numba would obey a file that lies there, and that the help still comes."""
    monkeypatch.chdir(tmp_path)
    Path(kernel_cache.SETTINGS).write_text(content)
    for words in (["info", "."], ["label", "a.recording.h5"], ["index", "."], ["doctor"], ["share", "a", "-o", "b"]):
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 2 and kernel_cache.SETTINGS in result.output, words
    assert CliRunner().invoke(app, ["label", "--help"]).exit_code == 0


TRAPS = ("json", "multiprocessing", "pickle", "numpy", "pty", "sitecustomize")
COMMAND = """
from evetac_cli.cli.main import main

if __name__ == "__main__":
    main()
"""
SHIELDED = """
import multiprocessing
from evetac_cli.realtime.processes import start_shielded

if __name__ == "__main__":
    process = multiprocessing.get_context("spawn").Process(target=print, args=("ran",))
    start_shielded(process)
    process.join()
"""


@pytest.fixture
def trapped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with modules that say that they were loaded."""
    for name in TRAPS:
        (tmp_path / f"{name}.py").write_text("open(__file__ + '.ran', 'w').close(); raise SystemExit(9)\n")
    monkeypatch.setenv("PYTHONPATH", str(PACKAGE.parent))
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def ran(folder: Path) -> list[str]:
    return [path.name for path in folder.glob("*.ran")]


def run_elsewhere(folder: Path, program: str, *words: str) -> "subprocess.CompletedProcess[str]":
    """Run a program that lies in another folder than it is started in, as `evetac` does."""
    path = folder / "program" / "main.py"
    path.parent.mkdir()
    path.write_text(program)
    return subprocess.run([sys.executable, str(path), *words], capture_output=True, text=True, check=False)


def test_a_trap_would_be_seen(trapped: Path) -> None:
    """Assert that the folder is one in which Python's own way of starting a process loads what lies there."""
    subprocess.run([sys.executable, "-c", "import json"], check=False)
    assert ran(trapped) == ["json.py.ran"]


def test_worker_processes_load_nothing_from_the_working_folder(trapped: Path) -> None:
    """Assert that `--jobs 2` runs no module that lies where the command is started."""
    for name in "ab":
        (trapped / f"{name}.recording.h5").touch()
    done = run_elsewhere(trapped, COMMAND, "track", "a.recording.h5", "b.recording.h5", "--jobs", "2")
    assert done.returncode == 2, done.stderr  # both say that they are no recordings
    assert "a.recording.h5" in done.stderr and "b.recording.h5" in done.stderr
    assert ran(trapped) == []


def test_processes_of_somebody_elses_program_load_nothing_from_it(trapped: Path) -> None:
    """Assert that processes of devices, views and grasps load nothing there where another program starts them."""
    done = run_elsewhere(trapped, SHIELDED)
    assert done.stdout == "ran\n", done.stderr
    assert ran(trapped) == []


def test_the_virtual_gripper_loads_nothing_from_it(trapped: Path) -> None:
    """Assert that the servo's process comes up where traps lie, and that its port is for this user alone."""
    with VirtualGripper() as gripper:
        assert mode(Path(gripper.port)) == 0o600
    assert ran(trapped) == []


def test_kernels_of_a_class_that_is_gone_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that an index that numba could not read is removed, once for each state of the source, and no other."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    gone = pickle.dumps(1) + b"\x80\x04\x8c\x0aevetac_cli\x8c\x04Gone\x93."
    kept = pickle.dumps(1) + pickle.dumps(Path)
    for name, data in (("gone", gone), ("kept", kept)):
        (tmp_path / f"{name}.nbi").write_bytes(data)
    kernel_cache.drop_unreadable()
    assert [path.name for path in tmp_path.glob("*.nbi")] == ["kept.nbi"]
    (tmp_path / "gone.nbi").write_bytes(gone)
    kernel_cache.drop_unreadable()
    assert (tmp_path / "gone.nbi").exists()
    monkeypatch.setattr(kernel_cache, "_digest_of_sources", lambda: "of other sources")
    kernel_cache.drop_unreadable()
    assert not (tmp_path / "gone.nbi").exists()
