"""Tells the address of a served page to its user alone, and opens it in a browser where there is a display.

Why so: the address holds the token by which anybody can let go of the gripper, and all users of a computer see the
arguments with which programs are started. So a browser is started with a file that only this user can read, in a folder
likewise, and the file leads it on. Nor does a log that others can read get the address.
"""

import os
import stat
import sys
import tempfile
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from evetac_cli import console

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0; url={url}">
<title>evetac {name}</title>
<p><a href="{url}">{name}</a></p>
</html>
"""
SNAPS = Path("/snap/bin")
BROWSERS = ("firefox", "chromium", "brave", "opera")


@contextmanager
def announced(url: str, name: str, *, opens: bool) -> Iterator[Path]:
    """Say where the page of this name is; opens: show it in a browser too.

    Yields the file that leads there, which is gone at the end.
    """
    with tempfile.TemporaryDirectory(prefix=f"evetac-{name.replace(' ', '-')}-", dir=_seen_by_browsers()) as folder:
        page = Path(folder) / f"{name.replace(' ', '-')}.html"
        with open(os.open(page, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(PAGE.format(url=url, name=name))
        if _is_read_by_others():
            console.say(f"{name}: open {page}; the address is not in this log, which others can read")
        else:
            console.say(f"{name}: {url}")
        if opens:
            webbrowser.open(page.as_uri())
        yield page


def _seen_by_browsers() -> Path | None:
    """The folder in which the file's own is made; None: the one for temporary files.

    A browser that is installed as a snap sees a /tmp of its own, and of the home folder what is not hidden.
    """
    is_snap = any((SNAPS / name).exists() for name in BROWSERS)
    with suppress(RuntimeError):  # there is no home folder
        home = Path.home()
        if is_snap and os.access(home, os.W_OK | os.X_OK):
            return home
    return None


def _is_read_by_others() -> bool:
    """Whether messages go to a file that other users can read."""
    try:
        mode = os.fstat(sys.stderr.fileno()).st_mode
    except (AttributeError, OSError, ValueError):  # there is no such file
        return False
    return stat.S_ISREG(mode) and bool(mode & (stat.S_IRGRP | stat.S_IROTH))


def has_display() -> bool:
    """Whether a browser that is opened here is seen by whoever sits at the terminal."""
    if "SSH_CONNECTION" in os.environ:
        return False
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
