"""Attack one user of this computer as another user without rights. Can anything be read, run, moved or blocked?

    sudo python scripts/attack/other_user.py [--code CHECKOUT] [--only DOOR ...] [--json]

The script starts evetac as the user 64001, the owner. As the user 64002 it runs the attempts in tries_as_other_user.py.
The attacker has no capability, belongs to no group, and cannot gain either (NoNewPrivs). Neither user needs to exist.
World-writable folders replace /tmp and a shared folder, so that nothing else on this computer is disturbed.

Each row states the attempt, its target (door), and the result. Exit code 1 if anything was reached. Exit code 2 if this
script cannot become other users (it needs root); then nothing was tried. --code attacks another checkout.
"""

import argparse
import contextlib
import json
import os
import pwd
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
OWNER, OTHER = 64001, 64002
PATIENCE_S = 900.0  # on a busy computer that has to compile
SILENT = 1200  # silent connections
PRECIOUS = "what must stay\n"
# Started like `evetac`: Python looks for modules next to the script, not in the working folder. The limit of open files
# is that of most users.
PROGRAM = """
import resource
from evetac_cli.__main__ import main

if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 1024))
    main()
"""
BROWSER = "#!/bin/sh\nexec > /dev/null 2>&1\nwhile :; do sleep 1; done\n"

Row = dict[str, Any]


class Stage:
    """The folders of an attack, and the programs of both users."""

    def __init__(self, code: Path, base: Path, python: Path) -> None:
        self.code, self.base, self.python = code, base, python
        self.temporary = self._folder("temporary", 0, 0o1777)  # in place of /tmp
        self.shared = self._folder("shared", 0, 0o777)  # a group's data folder without the sticky bit
        self.marks = self._folder("marks", 0, 0o1777)
        self.home = self._folder("home", OWNER, 0o700)
        self.work = self._folder("work", OWNER, 0o755)
        self.attacker = self._folder("attacker", OTHER, 0o755)
        self.precious = self.home / "precious"
        self.put_precious()
        self.kernels = self._folder("kernels", OWNER, 0o700)
        self._compiled()
        self.program = self._file("evetac.py", PROGRAM)
        self.browser = self._file("browser", BROWSER)

    def put_precious(self) -> None:
        """Put a file that must not change into the owner's home folder."""
        self.precious.write_text(PRECIOUS)
        os.chown(self.precious, OWNER, OWNER)

    def _folder(self, name: str, user: int, mode: int) -> Path:
        path = self.base / name
        path.mkdir()
        os.chown(path, user, user)
        path.chmod(mode)
        return path

    def _file(self, name: str, text: str) -> Path:
        path = self.base / name
        path.write_text(text)
        path.chmod(0o755)
        return path

    def _compiled(self) -> None:
        """Give the owner the kernels compiled next to the source, so that only the doors that test kernels compile."""
        import hashlib

        for beside in (self.code / "evetac_cli").rglob("__pycache__"):
            source = str(beside.parent)
            place = self.kernels / f"{beside.parent.name}_{hashlib.sha1(source.encode()).hexdigest()}"
            for file in beside.glob("*.nb[ic]"):
                place.mkdir(exist_ok=True)
                shutil.copy2(file, place)
        for path in (self.kernels, *self.kernels.rglob("*")):
            os.chown(path, OWNER, OWNER)

    def environment(self, **more: str) -> dict[str, str]:
        """Return the environment of a user's program, without this process's variables; empty values are not set."""
        known = {
            "PATH": os.environ["PATH"],
            "PYTHONPATH": os.pathsep.join([str(self.code), *libraries(self.python)]),
            "HOME": str(self.home),
            "TMPDIR": str(self.temporary),
            "NUMBA_CACHE_DIR": str(self.kernels),
            "LANG": "C.UTF-8",
        } | more
        return {name: value for name, value in known.items() if value}

    @contextlib.contextmanager
    def owners(self, command: str, folder: Path | None = None, **environment: str) -> Iterator["Program"]:
        """Start an evetac command for the owner; it is killed at the end."""
        run = subprocess.Popen(
            [self.python, self.program, *command.split()], cwd=folder or self.work,
            env=self.environment(**environment), user=OWNER, group=OWNER, extra_groups=[], umask=0o022,
            start_new_session=True, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        program = Program(run)
        try:
            yield program
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(run.pid, signal.SIGKILL)
            self._tidy()
            program.said += run.communicate()[1]

    def _tidy(self) -> None:
        """End the processes that the owner's program started, and remove the files that it leaves when killed."""
        for path in Path("/dev/shm").iterdir():
            with contextlib.suppress(OSError):
                if path.lstat().st_uid == OWNER:
                    path.unlink()
        for place in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if place.stat().st_uid == OWNER and str(self.browser).encode() in (place / "cmdline").read_bytes():
                    os.kill(int(place.name), signal.SIGKILL)

    def others(self, what: str, environment: dict[str, str] | None = None, /, **arguments: Any) -> list[Row]:
        """Run an attempt of the other user and return the result."""
        with self._as_other(what, environment or {}, arguments) as run:
            said, errors = run.communicate(timeout=PATIENCE_S)
        if run.returncode:
            raise RuntimeError(f"{what}: {errors}")
        return list(json.loads(said))

    @contextlib.contextmanager
    def meanwhile(self, what: str, /, **arguments: Any) -> Iterator[str]:
        """Run an attempt of the other user during the block; yield its output once it is ready."""
        with self._as_other(what, {}, arguments) as run:
            assert run.stdout is not None and run.stdin is not None
            ready = run.stdout.readline().strip()
            if not ready.startswith("ready"):
                raise RuntimeError(f"{what}: {run.communicate()[1]}")
            yield ready.removeprefix("ready").strip()
            run.communicate(timeout=PATIENCE_S)

    @contextlib.contextmanager
    def _as_other(
        self, name: str, environment: dict[str, str], arguments: dict[str, Any]
    ) -> "Iterator[subprocess.Popen[str]]":
        run = subprocess.Popen(
            [self.python, "-P", HERE / "tries_as_other_user.py", name, json.dumps(arguments)], cwd=self.attacker,
            env=self.environment(**{"HOME": str(self.attacker), "NUMBA_CACHE_DIR": ""} | environment),
            user=OTHER, group=OTHER, extra_groups=[],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            yield run
        finally:
            if run.poll() is None:
                run.kill()
            run.communicate()


class Program:
    """A running command."""

    def __init__(self, run: "subprocess.Popen[str]") -> None:
        self.run = run
        self.said = ""

    def until(self, true: Callable[[], Any]) -> Any:
        """Wait until a condition is true; RuntimeError if the program ends first."""
        end_s = time.monotonic() + PATIENCE_S
        while not (value := true()):
            if self.run.poll() is not None:
                raise RuntimeError(f"the owner's program ended: {self.run.communicate()[1][-600:]}")
            if time.monotonic() > end_s:
                raise RuntimeError("the owner's program did not get that far in time")
            time.sleep(0.05)
        return value

    def ended(self) -> str:
        """Return its output once it has ended."""
        self.said = self.run.communicate(timeout=PATIENCE_S)[1]
        return self.said

    def ended_or(self, mark: Path) -> None:
        """Wait until it has ended, or until a trap was triggered."""
        end_s = time.monotonic() + PATIENCE_S
        while self.run.poll() is None and time.monotonic() < end_s and not list(mark.parent.glob(f"{mark.name}*")):
            time.sleep(0.05)


def listening() -> int:
    """Return the number of ports on which the owner's programs listen."""
    lines = Path("/proc/net/tcp").read_text().splitlines()[1:]
    return sum(fields[3] == "0A" and int(fields[7]) == OWNER for fields in map(str.split, lines))


def sprung(stage: Stage, mark: Path, tried: str, program: Program) -> Row:
    """Whether a trap ran in one of the owner's programs."""
    ran = [path for path in stage.marks.glob(f"{mark.name}*") if path.stat().st_uid == OWNER]
    names = ", ".join(sorted(path.name.removeprefix(mark.name).strip("-") or "kernel" for path in ran))
    said = next(iter(program.said.strip().splitlines()), "")
    held = f"not run; exit {program.run.returncode} {said}".strip()
    return {"tried": tried, "came_of_it": f"ran as the owner: {names}" if ran else held, "reached": bool(ran)}


# --- the doors --------------------------------------------------------------------------------------------------------


def dask(stage: Stage) -> Iterator[Row]:
    """A cluster of `--engine dask`."""
    stage.others("lay_scratch", folder=str(stage.temporary))
    with stage.owners("record --scene slip --object 1-20 --count 3 -o dask --engine dask --jobs 2 -q") as program:
        program.until(lambda: len(list(stage.work.glob("dask/.*obj*.tmp"))) >= 2)
        yield from stage.others("dask", owner=OWNER)
        yield from stage.others("files", owner=OWNER, folder=str(stage.temporary), seconds=3.0)
        yield from stage.others("memory", owner=OWNER)
    said = program.said.strip()
    yield {"tried": "Dask: words on the owner's terminal", "came_of_it": said or "none", "reached": bool(said)}


def cache(stage: Stage) -> Iterator[Row]:
    """Folders for compiled kernels that the other user creates first."""
    traps = stage.attacker / "kernels"
    mark = stage.marks / "kernels"
    stage.others("lay_kernels", {"NUMBA_CACHE_DIR": str(traps)}, folder=str(traps), mark=str(mark))
    name = f"evetac-numba-{OWNER}"
    open_home = stage._folder("open-home", OWNER, 0o777)

    def copied(place: Path) -> None:
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(traps, place, dirs_exist_ok=True)
        for path in (place, *place.rglob("*")):
            os.chown(path, OTHER, OTHER)

    cases: list[tuple[str, Callable[[], None], dict[str, str]]] = [
        ("its folder in /tmp, made before", lambda: copied(stage.temporary / name), {"HOME": "/nonexistent"}),
        ("a link in its place", lambda: (stage.temporary / name).symlink_to(traps), {"HOME": "/nonexistent"}),
        ("a home folder that others can write to", lambda: copied(open_home / ".cache/evetac/numba"),
         {"HOME": str(open_home)}),
        ("numba's own folder in such a home", lambda: copied(open_home / ".cache/numba"), {"HOME": str(open_home)}),
        ("XDG_CACHE_HOME in a shared folder", lambda: copied(stage.shared / "xdg/evetac/numba"),
         {"XDG_CACHE_HOME": str(stage.shared / "xdg"), "HOME": "/nonexistent"}),
    ]  # fmt: skip
    for number, (tried, lay, environment) in enumerate(cases):
        lay()
        command = f"record --scene slip --object 8 -o kernels-{number} -q"
        with stage.owners(command, NUMBA_CACHE_DIR="", **environment) as program:
            program.ended_or(mark)
        yield sprung(stage, mark, f"kernels: {tried}", program)
        for path in (*stage.marks.glob("kernels*"), stage.temporary / name):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)


def folder(stage: Stage) -> Iterator[Row]:
    """A working folder into which the other user put modules and settings."""
    place = stage._folder("modules", 0, 0o777)
    mark = stage.marks / "modules"
    stage.others("lay_modules", folder=str(place), mark=str(mark))
    commands = {
        "--gripper virtual": "record --camera virtual:prepared=10000 --gripper virtual --seconds 1 -q",
        "--jobs 2": "record --scene slip --object 1-2 --jobs 2 -q",
        "--engine dask": "record --scene slip --object 1-2 --jobs 2 --engine dask -q",
        "grasp": "grasp --camera virtual --gripper virtual --lift-s 1 --balance-s 0 -q",
        "--live": "record --camera virtual:prepared=10000 --gripper none --seconds 1 --live --live-in terminal -q",
    }
    for tried, command in commands.items():
        with stage.owners(f"{command} -o {stage.work / 'modules'}{len(tried)}", place) as program:
            program.ended_or(mark)
        yield sprung(stage, mark, f"working folder: modules, {tried}", program)
        for path in stage.marks.glob("modules*"):
            path.unlink()
    # An owner's own clone keeps kernels next to their source, unless numba's settings differ.
    clone = stage.base / "clone"
    shutil.copytree(stage.code / "evetac_cli", clone / "evetac_cli")
    shutil.copytree(stage.code / "schemas", clone / "schemas")
    for each in (clone, *clone.rglob("*")):
        os.chown(each, OWNER, OWNER)
    traps, mark = stage.attacker / "clone", stage.marks / "settings"
    path = os.pathsep.join([str(clone), *libraries(stage.python)])
    lay = {"NUMBA_CACHE_DIR": str(traps), "PYTHONPATH": path}
    stage.others("lay_kernels", lay, folder=str(traps), mark=str(mark))
    place = stage._folder("settings", 0, 0o777)
    stage.others("lay_settings", folder=str(place), cache=str(traps))
    command = f"record --scene slip --object 8 -o {stage.work / 'settings'} -q"
    with stage.owners(command, place, NUMBA_CACHE_DIR="", PYTHONPATH=path) as program:
        program.ended_or(mark)
    yield sprung(stage, mark, "working folder: settings of numba that name a folder with kernels", program)


@contextlib.contextmanager
def shown(stage: Stage, out: str) -> Iterator[tuple[Program, str]]:
    """A recording with a live view in a browser, and the address shown to the owner."""
    command = f"record --camera virtual:prepared=20000 --gripper virtual --hold-s 100 --live --live-in browser -o {out}"
    with stage.owners(command, DISPLAY=":64", BROWSER=f"{stage.browser} %s &") as program:
        assert program.run.stderr is not None
        for line in program.run.stderr:
            if address := re.search(r"http://127\.0\.0\.1:\d+/\S+/", line):
                time.sleep(1.0)  # so that the browser starts
                yield program, address.group()
                return
        raise RuntimeError("the owner's program ended")


def page(stage: Stage) -> Iterator[Row]:
    """The page of a live view, opened in a browser."""
    with shown(stage, "page") as (program, _):
        yield from stage.others("page", owner=OWNER, folders=[str(stage.temporary)])
        yield from stage.others("files", owner=OWNER, folder=str(stage.temporary), seconds=2.0)
        yield from stage.others("memory", owner=OWNER)
        ended = program.run.poll() is not None
        came = program.ended().strip().splitlines()[-1] if ended else "it goes on"
        yield {"tried": "page: the recording goes on", "came_of_it": came, "reached": ended}
    with shown(stage, "held") as (_, address):
        port = int(address.split(":")[2].split("/")[0])
        with stage.meanwhile("hold", port=port, count=SILENT) as held:
            yield looked_at(stage, address, held)


def looked_at(stage: Stage, address: str, held: str) -> Row:
    """Whether the owner sees the page despite silent connections."""
    program_text = f"import urllib.request as u; print(u.urlopen({address!r}, timeout=30).status)"
    command = [stage.python, "-P", "-c", program_text]
    seen = subprocess.run(
        command, env=stage.environment(), user=OWNER, group=OWNER, extra_groups=[], capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    tried = f"page: {held} connections that say nothing keep the owner out for 30 s"
    came = "the owner sees it" if seen.stdout.strip() == "200" else seen.stderr.strip().splitlines()[-1]
    return {"tried": tried, "came_of_it": came, "reached": seen.stdout.strip() != "200"}


def robot(stage: Stage) -> Iterator[Row]:
    """The port for a robot's program, and the file with its token."""
    listens = "record --camera virtual:prepared=20000 --gripper none --listen -o"
    file = stage.work / "robot" / "evetac.listen"
    with stage.owners(f"{listens} {file.parent}") as program:
        program.until(file.exists)
        yield from stage.others("robot", owner=OWNER, file=str(file))
        started = [path.name for path in file.parent.iterdir() if path != file]
        ended = program.run.poll() is not None
        yield {"tried": "robot: what the tries recorded", "came_of_it": f"{started}", "reached": bool(started) or ended}
    for tried, target in (("another's address", ""), ("a link", str(stage.precious))):
        stage.others("lay_address", folder=str(stage.shared), target=target)
        with stage.owners(f"{listens} {stage.shared}") as program:
            said = program.ended()
        refused = "not a file that evetac made" in said and stage.precious.read_text() == PRECIOUS
        came = said.strip().splitlines()[0] if said.strip() else "nothing was said"
        yield {"tried": f"robot: {tried} in a folder of all", "came_of_it": came, "reached": not refused}


def grasp(stage: Stage) -> Iterator[Row]:
    """Processes of a grasp, their memory, and the terminal of the virtual gripper."""
    command = "grasp --camera virtual --gripper virtual --lift-s 25 --balance-s 25 -o grasp.recording.h5 -q"
    with stage.owners(command) as program:
        program.until(lambda: list(stage.work.glob("grasp.recording.part/0*.h5")))
        yield from stage.others("memory", owner=OWNER)
        yield from stage.others("files", owner=OWNER, folder=str(stage.temporary), seconds=2.0)


def output(stage: Stage) -> Iterator[Row]:
    """A folder for outputs that others may write to."""

    def untouched(tried: str, came: str) -> Row:
        now_there = {path.name: path.read_bytes() for path in stage.home.iterdir()}
        fine = now_there == {stage.precious.name: PRECIOUS.encode()}
        for name in now_there:
            (stage.home / name).unlink()
        stage.put_precious()
        words = came.strip().splitlines()[0] if came.strip() else "made"
        return {"tried": f"shared output folder: {tried}", "reached": not fine,
                "came_of_it": words if fine else f"changed files of the owner: {sorted(now_there)}"}  # fmt: skip

    for number, how in enumerate(("a folder", "a link")):
        name = f"part{number}.recording"
        command = f"record --camera virtual:prepared=10000 --gripper none --seconds 1 -o {stage.shared / name}.h5 -q"
        if how == "a folder":
            with (
                stage.meanwhile("lay_part_folder", folder=str(stage.shared), name=name, precious=str(stage.precious)),
                stage.owners(command) as program,
            ):
                said = program.ended()
        else:
            stage.others("lay_part_link", folder=str(stage.shared), name=name, target=str(stage.home))
            with stage.owners(command) as program:
                said = program.ended()
        yield untouched(f"{how} in place of NAME.part", said)
    recording = stage.work / "source.recording.h5"
    with stage.owners(f"record --scene slip --object 8 -o {recording} -q") as program:
        program.ended()
    name = "text.txt"
    with (
        stage.meanwhile(
            "lay_unfinished", folder=str(stage.shared), name=name, owner=OWNER, precious=str(stage.precious)
        ),
        stage.owners(f"export {recording} --format text -o {stage.shared / name} -q") as program,
    ):
        said = program.ended()
    yield untouched("links in place of unfinished files", said)
    name = "source.tracks.h5"
    with (
        stage.meanwhile(
            "lay_unfinished", folder=str(stage.shared), name=name, owner=OWNER, precious=str(stage.precious)
        ),
        stage.owners(f"track {recording} -o {stage.shared} -q") as program,
    ):
        said = program.ended()
    yield untouched("links in place of unfinished files of HDF5", said)


def devices(stage: Stage) -> Iterator[Row]:
    """Who may open camera and gripper under the rules printed by `doctor --print-udev`."""
    with stage.owners("doctor --print-udev") as program:
        rules = program.run.communicate()[0]
    for line in (line for line in rules.splitlines() if line.startswith("SUBSYSTEM")):
        mode = re.search(r'MODE="(\d+)"', line)
        everybody = bool(mode and int(mode[1], 8) & 0o006)
        kind = "gripper's port" if '"tty"' in line else "camera"
        came = f"mode {mode[1]}" if mode else "the system's"
        yield {"tried": f"devices: open the {kind} as anybody", "came_of_it": came, "reached": everybody}


DOORS = {each.__name__: each for each in (devices, cache, folder, output, dask, page, robot, grasp)}


def libraries(python: Path) -> list[str]:
    """Return the folders in which another Python finds the libraries of this one."""
    return [] if python == Path(sys.executable) else [path for path in sys.path if path.endswith("site-packages")]


def running() -> int:
    """Return how many programs of either user run."""
    count = 0
    for place in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if place.name.isdigit() and place.stat().st_uid in (OWNER, OTHER):
                count += (place / "stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    return count


def why_not(python: Path) -> str:
    """Return why this script cannot become other users; empty if it can."""
    if os.geteuid() != 0:
        return "this script needs root to become two other users"
    for user in (OWNER, OTHER):
        with contextlib.suppress(KeyError):
            return f"the user {user} exists: {pwd.getpwuid(user).pw_name}"
    end_s = time.monotonic() + 10.0
    while running() and time.monotonic() < end_s:
        time.sleep(0.1)
    if running():
        return f"programs of the users {OWNER} or {OTHER} are running, perhaps from another attack"
    tried = subprocess.run(
        ["/bin/sh", "-c", "id -u; id -G"], user=OTHER, group=OTHER, extra_groups=[], capture_output=True, text=True,
        check=False,
    ).stdout.split()  # fmt: skip
    if tried != [str(OTHER), str(OTHER)]:
        return f"this script may not become another user (setuid, setgroups): {' '.join(tried)}"
    try:
        subprocess.run([python, "-c", ""], user=OTHER, group=OTHER, extra_groups=[], check=True)
    except OSError:
        return f"other users may not run {python.resolve()}; choose another Python of its version with --python"
    return ""


def main() -> int:
    """Try all doors and print a row for each attempt."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--code", type=Path, default=ROOT, help="checkout to attack [this one]")
    parser.add_argument("--only", nargs="+", choices=DOORS, default=list(DOORS), metavar="DOOR", help=", ".join(DOORS))
    parser.add_argument(
        "--python", type=Path, default=Path(sys.executable), help="Python that all users may run [this one]"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object per row")
    chosen = parser.parse_args()
    try:
        reason = why_not(chosen.python)
    except OSError as error:
        reason = f"this script may not become another user: {error}"
    if reason:
        print(f"nothing was tried: {reason}", file=sys.stderr)
        return 2
    reached = 0
    for name in chosen.only:
        with tempfile.TemporaryDirectory(prefix="evetac-other-user-") as base:
            Path(base).chmod(0o755)
            for tried in DOORS[name](Stage(chosen.code.resolve(), Path(base), chosen.python)):
                reached += tried["reached"]
                if chosen.json:
                    print(json.dumps({"door": name, **tried}), flush=True)
                else:
                    verdict = "REACHED" if tried["reached"] else "held"
                    print(f"{verdict:<8} {name:<8} {tried['tried']}: {tried['came_of_it']}", flush=True)
    print(f"{reached} reached" if reached else "nothing was reached", file=sys.stderr)
    return 1 if reached else 0


if __name__ == "__main__":
    sys.exit(main())
