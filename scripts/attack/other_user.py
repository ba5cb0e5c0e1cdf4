"""What does another user of this computer get from a running evetac? Expected: nothing.

    sudo python scripts/attack/other_user.py [--python PYTHON] [--only PROGRAM ...]

It starts evetac as the user 64001; meanwhile the user 64002 connects to its ports, looks into its processes, and takes
its files. Neither needs to exist. --python: a Python that all users may run. Exit code 1 if anything was reached; 2 if
nothing was tried, because this script may not become other users.
"""

import argparse
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

ROOT = Path(__file__).resolve().parents[2]
OWNER, OTHER = ({"user": user, "group": user, "extra_groups": [], "umask": 0o22} for user in (64001, 64002))
ANSWER_S = 3.0
PROGRAMS = {
    "door": ("record --camera virtual:prepared --gripper none --listen -o door", "door/evetac.listen"),
    "view": (
        "record --camera virtual:prepared=20000 --gripper virtual --hold-s 100 --live -o view",
        "view/*.part/0*.h5",
    ),
    "review": ("label one.recording.h5 --review --by Ada", ""),
    "grasp": ("grasp --camera virtual --lift-s 20 --balance-s 30 -o b.recording.h5", "b.recording.part/0*.h5"),
}  # a command, and a file that shows that it runs
# It takes the address from its arguments, where all users can see it, and keeps running.
BROWSER = "import sys, time, urllib.request as u; u.urlopen(sys.argv[1]).read(); time.sleep(900)"
REFUSALS = (b'{"ok": false, "error": "refused', b"HTTP/1.0 403", b"<!DOCTYPE HTML>")
Row = dict[str, Any]


def refused(tried: str, act: Callable[[], Any]) -> Row:
    """Try something that reaches its target unless it is refused."""
    try:
        result = act()
    except Exception as error:  # libraries raise many kinds
        return {"tried": tried, "outcome": type(error).__name__, "reached": False}
    return {"tried": tried, "outcome": repr(result)[:80], "reached": True}


def reply_to(port: int, line: bytes) -> bytes:
    """Return what a port answers; PermissionError if that is nothing but a refusal."""
    with socket.create_connection(("127.0.0.1", port), ANSWER_S) as connection:
        connection.sendall(line)
        answer = connection.recv(4096)
    if not answer or answer.startswith(REFUSALS):
        raise PermissionError
    return answer


def ports() -> list[int]:
    """Return the ports on which the owner's programs listen, which all users may see."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return [int(row[1][-4:], 16) for row in rows if row[3] == "0A" and int(row[7]) == OWNER["user"]]


def processes() -> list[Path]:
    """Return the folders of the owner's running processes, which all users may see."""
    places = [at for at in Path("/proc").glob("[0-9]*") if at.exists() and at.stat().st_uid == OWNER["user"]]
    return [place for place in places if (place / "cmdline").read_bytes()]


def tries(paths: list[Path]) -> Iterator[Row]:
    """Try everything, as the other user; paths: to be taken, with all that is in them."""
    lines = [json.dumps({"token": "A" * 32, "command": "start", "name": "taken"}).encode() + b"\n"]
    lines += [f"{way} HTTP/1.0\r\nHost: 127.0.0.1\r\n\r\n".encode() for way in ("GET /", f"GET /{'A' * 32}/", "POST /")]
    for port in ports():
        for line in lines:
            yield refused(f"port: {line[:10].decode()}", lambda port=port, line=line: reply_to(port, line))
    for place in processes():
        for address in re.findall(r"http://127[^\0\s]+", (place / "cmdline").read_text()):
            yield refused("process: an address among its arguments", lambda address=address: urlopen(address).read())
        for name in ("environ", "mem", "maps"):
            yield refused(f"process: {name}", (place / name).read_bytes)
        yield refused("process: files", (place / "fd/0").readlink)
        yield refused("process: a signal", lambda number=int(place.name): os.kill(number, 0))
    paths += [path for folder in paths for path in folder.rglob("*")]
    for path in [path for path in paths if path.exists() and path.lstat().st_uid == OWNER["user"]]:
        yield refused("file: read", lambda path=path: os.open(path, os.O_RDONLY | os.O_NOCTTY))
        yield refused("file: write", lambda path=path: os.open(path, os.O_WRONLY | os.O_NOCTTY))
        yield refused("file: add to a folder", (path / "added").touch)
        yield refused("file: rename", lambda path=path: path.rename(f"{path}.taken"))


def attacked(program: str, base: Path, python: str) -> list[Row]:
    """Start a program, let the other user try everything, and print a row for each kind of attempt."""
    home, temporary = base / "home", base / "temporary"
    for folder, user, mode in ((base, OWNER, 0o755), (home, OWNER, 0o700), (temporary, {"user": 0}, 0o1777)):
        folder.mkdir(exist_ok=True)
        folder.chmod(mode)
        os.chown(folder, user["user"], 0)
    path = os.pathsep.join([str(ROOT), *(path for path in sys.path if path.endswith("site-packages"))])
    environment = {"HOME": str(home), "TMPDIR": str(temporary), "DISPLAY": ":64", "PYTHONPATH": path}
    environment |= {"PATH": os.environ["PATH"], "BROWSER": f"{python} -c '{BROWSER}' %s &"}
    start, evetac = {"cwd": base, "env": environment}, [python, "-P", "-m", "evetac_cli"]
    subprocess.run([*evetac, "record", "--object", "8", "-o", "one.recording.h5", "-q"], **start, **OWNER, check=True)
    command, ready = PROGRAMS[program]
    with subprocess.Popen([*evetac, *command.split(), "-q"], **start, **OWNER) as run:
        while not (list(base.glob(ready)) if ready else ports()) and run.poll() is None:
            time.sleep(0.1)
        time.sleep(1.0)  # for its browser
        taken = [home, temporary, base / "door" / "evetac.listen", Path("/dev/shm"), Path("/dev/pts")]
        done = subprocess.check_output([python, "-P", __file__, "--take", *taken], **start, **OTHER)
        rows: list[Row] = json.loads(done)
        rows.append({"tried": "end it", "outcome": str(run.poll()), "reached": run.poll() is not None})
        while places := processes():
            for place in places:
                os.kill(int(place.name), signal.SIGKILL)
    for tried in dict.fromkeys(row["tried"] for row in rows):
        some = [row for row in rows if row["tried"] == tried]
        verdict = "REACHED" if any(row["reached"] for row in some) else "held"
        print(f"{verdict:<8} {program:<8} {tried}, {len(some)} times: {sorted({row['outcome'] for row in some})}")
    return rows


def main() -> int:
    """Attack the chosen programs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--only", nargs="+", choices=PROGRAMS, default=list(PROGRAMS))
    parser.add_argument("--take", nargs="*", type=Path, help=argparse.SUPPRESS)  # in the process of the other user
    chosen = parser.parse_args()
    if chosen.take:
        print(json.dumps(list(tries(chosen.take))))
        return 0
    become = refused("", lambda: subprocess.run([chosen.python, "-c", ""], **OTHER, check=True))
    if not become["reached"]:
        print(f"nothing was tried: no program runs as another user: {become['outcome']}", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(prefix="evetac-other-user-") as base:
        rows = [row for program in chosen.only for row in attacked(program, Path(base), chosen.python)]
    return int(any(row["reached"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
