"""Follow the Dockerfile on a machine without Docker: line by line, in a Debian made by debootstrap, with chroot.

    sudo python scripts/try_dockerfile.py /tmp/image --try "doctor" --try "record --object 8"

FROM is replaced by a Debian with the same Python, in a virtual environment at /usr/local, the location of Python in the
image. COPY respects .dockerignore. ENV, USER and WORKDIR apply to the lines after them. RUN uses /bin/sh -c, as Docker
does. Finally, ENTRYPOINT runs with each --try. The first line that fails ends the script with exit code 1.

pip and proxies use the settings of the environment. --share makes a folder of this machine visible, such as one of
wheels. Docker's layers, limits and network are not tested.
"""

import argparse
import contextlib
import fnmatch
import json
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SUITES = {"python:3.11-slim": "bookworm", "python:3.13-slim": "trixie"}  # Debian releases by the Python that they have
PACKAGES = "python3,python3-venv,ca-certificates"
PASSED_ON = re.compile("(?i)pip_.*|.*_proxy")  # variables of the environment


def instructions(text: str) -> list[tuple[str, str]]:
    """Return word and argument of every instruction, with continued lines joined and comments left out."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", "", "\n".join(lines))
    return [
        (word.upper(), rest.strip()) for word, _, rest in (line.partition(" ") for line in joined.splitlines() if line)
    ]


def context(ignored: str) -> list[Path]:
    """Return the clone's files that a build sees; of several .dockerignore patterns that match, the last counts."""
    patterns = [line for line in ignored.splitlines() if line and not line.startswith("#")]
    seen = []
    for folder, folders, names in os.walk(ROOT):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for path in (Path(folder, name).relative_to(ROOT) for name in names):
            above = [str(path), *map(str, list(path.parents)[:-1])]
            fitting = [pattern for pattern in patterns if any(_fits(one, pattern.lstrip("!")) for one in above)]
            if not fitting or fitting[-1].startswith("!"):
                seen.append(path)
    return sorted(seen)


def _fits(path: str, pattern: str) -> bool:
    if pattern.startswith("**/"):
        return any(fnmatch.fnmatch(part, pattern[3:]) for part in path.split("/"))
    return fnmatch.fnmatch(path, pattern) and path.count("/") == pattern.count("/")


def require_own(folder: Path) -> None:
    """Exit if other users may have put files into the folder, because root runs its contents."""
    for part in (folder, *folder.parents):
        if not part.exists():
            continue
        about = part.stat()
        shared = about.st_mode & 0o022 and not (about.st_mode & stat.S_ISVTX and part != folder)
        if about.st_uid not in (0, os.geteuid()) or shared:
            sys.exit(f"{folder}: other users can write to {part}; name a folder of your own")


class Image:
    """The folder used as an image, and the settings of its instructions so far."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.user = "root"
        self.workdir = "/"
        self.entrypoint: list[str] = []
        self.environment = {
            "PATH": "/usr/local/bin:/usr/local/sbin:/usr/bin:/usr/sbin:/bin:/sbin",
            **{key: value for key, value in os.environ.items() if PASSED_ON.fullmatch(key)},
        }

    def call(self, *words: str) -> None:
        """Run a command in it; CalledProcessError if it fails."""
        home = "/root" if self.user == "root" else f"/home/{self.user}"
        inside = ["/bin/sh", "-c", f"cd {shlex.quote(self.workdir)} && exec {shlex.join(words)}"]
        known = [f"{key}={value}" for key, value in {"HOME": home, **self.environment}.items()]
        user = [] if self.user == "root" else ["--userspec", f"{self.user}:{self.user}"]
        subprocess.run(["chroot", *user, self.folder, "/usr/bin/env", "-i", *known, *inside], check=True)

    def start(self, base: str) -> None:
        """FROM: run debootstrap, unless the folder already has a Debian."""
        if base not in SUITES:
            sys.exit(f"FROM {base}: expected one of {', '.join(SUITES)}")
        if not (self.folder / "usr/bin/python3").exists():
            subprocess.run(["debootstrap", "--variant=minbase", f"--include={PACKAGES}", SUITES[base], self.folder],
                           check=True)  # fmt: skip
        shutil.copyfile("/etc/resolv.conf", self.folder / "etc/resolv.conf")
        self.call("python3", "-m", "venv", "/usr/local")
        self.call("python3", "--version")

    def copy(self, source: str, target: str, files: list[Path]) -> None:
        """COPY the whole context, or one of its files, into a folder."""
        chosen = files if source == "." else [path for path in files if str(path) == source]
        if not chosen or not target.endswith("/"):
            expected = "a file that .dockerignore leaves, or `.`, and a folder that ends in /"
            sys.exit(f"COPY {source} {target}: expected {expected}")
        for path in chosen:
            place = self.folder / target.strip("/") / path
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / path, place)

    def follow(self, word: str, rest: str, files: list[Path]) -> None:
        """Follow one instruction."""
        if word == "FROM":
            self.start(rest)
        elif word == "COPY":
            self.copy(*rest.split(), files)
        elif word == "RUN":
            self.call("/bin/sh", "-c", rest)
        elif word == "ENV":
            self.environment |= dict(pair.split("=", 1) for pair in shlex.split(rest))
        elif word == "USER":
            self.user = rest
        elif word == "WORKDIR":
            self.workdir = rest
            (self.folder / rest.strip("/")).mkdir(parents=True, exist_ok=True)
        elif word == "ENTRYPOINT":
            self.entrypoint = json.loads(rest)
        else:
            sys.exit(f"{word}: this script does not know it")


@contextlib.contextmanager
def mounted(folder: Path, shared: list[Path]) -> Iterator[None]:
    """Mount /proc, memory for /dev/shm, and the shared folders, read-only, below a folder; unmount at the end."""
    mounts = [(folder / "proc", ["-t", "proc", "proc"]), (folder / "dev/shm", ["-t", "tmpfs", "tmpfs"])]
    mounts += [(folder / str(one).strip("/"), ["--bind", "-o", "ro", str(one)]) for one in shared]
    with contextlib.ExitStack() as taken_away:
        for place, how in mounts:
            place.mkdir(parents=True, exist_ok=True)
            subprocess.run(["mount", *how, place], check=True)
            taken_away.callback(subprocess.run, ["umount", "--lazy", place], check=False)
        yield


def main() -> int:
    """Read the flags, follow the Dockerfile, and run the image's commands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the image; kept, so that a second run starts quickly")
    parser.add_argument(
        "--share", type=Path, action="append", default=[], help="a folder that is also visible in the image"
    )
    parser.add_argument(
        "--try", action="append", default=[], dest="tries", help="arguments for ENTRYPOINT, run at the end"
    )
    chosen = parser.parse_args()
    image = Image(chosen.folder.resolve())
    require_own(image.folder)
    files = context((ROOT / ".dockerignore").read_text())
    lines = instructions((ROOT / "Dockerfile").read_text())
    print(f"{len(lines)} instructions, {len(files)} files in the context", flush=True)
    try:
        with contextlib.ExitStack() as stack:
            for word, rest in lines:
                print(f"--- {word} {rest}", flush=True)
                began = time.monotonic()
                image.follow(word, rest, files)
                if word == "FROM":
                    stack.enter_context(mounted(image.folder, [one.resolve() for one in chosen.share]))
                print(f"    {time.monotonic() - began:.0f} s", flush=True)
            for words in chosen.tries or ["--help"]:
                print(f"--- {shlex.join(image.entrypoint)} {words}", flush=True)
                image.call(*image.entrypoint, *shlex.split(words))
    except subprocess.CalledProcessError as error:
        print(f"this line failed, exit {error.returncode}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
