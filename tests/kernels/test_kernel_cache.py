"""Where compiled code and modules are loaded from: present kernels, and nothing that the working folder could have."""

import os
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.errors import InputError
from evetac_cli.kernels import kernel_cache
from evetac_cli.resources import PACKAGE


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


# --- kernels ----------------------------------------------------------------------------------------------------------

CALLEE = "from evetac_cli.kernels.compiled import njit\n\n@njit(cache=True)\ndef inner() -> int:\n    return {}\n"
CALLER = """
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.callee import inner

@njit(cache=True)
def outer() -> int:
    return 10 * inner()
"""
CALL = "from evetac_cli.kernels.caller import outer; print(outer(), sum(outer.stats.cache_hits.values()))"


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A copy of the package with a kernel that calls one in another file."""
    package = tmp_path / "evetac_cli"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__", "data"))
    (package / "kernels" / "caller.py").write_text(CALLER)
    (package / "kernels" / "callee.py").write_text(CALLEE.format(1))
    return package


def called(package: Path, before: str = "", **more: str) -> list[int]:
    """The result of the kernel, and whether it was kept compiled; more: environment variables."""
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment |= {"PYTHONPATH": str(package.parent)} | more
    command = [sys.executable, "-P", "-c", before + CALL]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return [int(word) for word in done.stdout.split()]


def test_an_edit_of_a_function_in_another_file_is_seen(copied: Path) -> None:
    """Assert that a kernel is compiled once for each state of what it calls, and kept for the state before, too."""
    assert [called(copied), called(copied)] == [[10, 0], [10, 1]]
    (copied / "kernels" / "callee.py").write_text(CALLEE.format(2))
    assert [called(copied), called(copied)] == [[20, 0], [20, 1]]


def test_kernels_of_a_shared_installation_are_not_compiled_again(copied: Path, tmp_path: Path) -> None:
    """Assert that who cannot write to the package gets a copy of its kernels, in a folder of mode 0700."""
    assert called(copied) == [10, 0]
    not_writable = "import os; os.access = lambda *_: False; "
    assert called(copied, not_writable, XDG_CACHE_HOME=str(tmp_path / "cache")) == [10, 1]
    (place,) = (tmp_path / "cache" / "evetac" / "numba").iterdir()
    assert mode(place.parent) == 0o700
    assert place.name == next((copied / "__pycache__").glob(f"{kernel_cache.PREFIX}*")).name


def test_all_kernels_are_among_the_sources() -> None:
    """Assert that the digest covers each file with a kernel."""
    for path in PACKAGE.rglob("*.py"):
        if "import njit" in path.read_text() and path.name != "compiled.py":
            assert path.relative_to(PACKAGE).as_posix().startswith(kernel_cache.SOURCES)


def test_unused_kernels_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that folders that were not used for a month go, and nothing else, not even an old file beside them."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for name, days in ((f"{kernel_cache.PREFIX}old", 31), (f"{kernel_cache.PREFIX}new", 1), ("other", 400)):
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (0, kernel_cache.time.time() - 86400 * days))
    place = kernel_cache.folder()
    assert {path.name for path in tmp_path.iterdir()} == {f"{kernel_cache.PREFIX}new", "other", place.name}
    assert kernel_cache.folder() == place


def test_a_folder_that_others_can_enter_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the next candidate is taken, and that without one there is an error that says what to set."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert kernel_cache._own_folder() == tmp_path / "cache/evetac/numba"
    last = tmp_path / f"evetac-numba-{os.geteuid()}"
    for expected in (tmp_path / "home/.cache/evetac/numba", last):
        kernel_cache._own_folder().chmod(0o755)
        assert kernel_cache._own_folder() == expected
    last.rmdir()
    last.symlink_to(tmp_path / "cache")
    with pytest.raises(InputError, match="NUMBA_CACHE_DIR"):
        kernel_cache._own_folder()


# --- the working folder -----------------------------------------------------------------------------------------------


def test_numbas_settings_in_the_working_folder_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that no command begins where numba would obey a file that lies there, and that the help still comes."""
    monkeypatch.chdir(tmp_path)
    Path(kernel_cache.SETTINGS).write_text("opt: 0\n")
    for words in (["info", "."], ["label", "a.recording.h5"]):
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 2 and kernel_cache.SETTINGS in result.output, words
    assert CliRunner().invoke(app, ["label", "--help"]).exit_code == 0


TRAPS = ("json", "multiprocessing", "pickle", "numpy", "pty", "sitecustomize")
COMMAND = """
from evetac_cli.cli.main import main

if __name__ == "__main__":
    main()
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


def test_worker_processes_load_nothing_from_the_working_folder(trapped: Path) -> None:
    """Assert that `--jobs 2` runs no module that lies where the command is started."""
    for name in "ab":
        (trapped / f"{name}.recording.h5").touch()
    done = run_elsewhere(trapped, COMMAND, "track", "a.recording.h5", "b.recording.h5", "--jobs", "2")
    assert done.returncode == 2, done.stderr  # both say that they are no recordings
    assert "a.recording.h5" in done.stderr and "b.recording.h5" in done.stderr
    assert ran(trapped) == []


def test_the_virtual_gripper_loads_nothing_from_it(trapped: Path) -> None:
    """Assert that the servo's process comes up where traps lie, and that its port is for this user alone."""
    with VirtualGripper() as gripper:
        assert mode(Path(gripper.port)) == 0o600
    assert ran(trapped) == []
