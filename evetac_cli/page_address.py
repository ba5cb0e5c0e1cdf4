"""Give the address of a served page to its user only, and open it in a browser if there is a display.

The address contains the token with which anyone could release the gripper, and all users of a computer can see the
arguments of programs. So a browser is started with a file that only this user can read, in a folder with the same
protection, and the file redirects to the address. The address is not written to a log that others can read.
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
    """Print the address of a page; opens: also show the page in a browser.

    Yields the file that redirects to the page, which is removed at the end.
    """
    with tempfile.TemporaryDirectory(prefix=f"evetac-{name.replace(' ', '-')}-", dir=_seen_by_browsers()) as folder:
        page = Path(folder) / f"{name.replace(' ', '-')}.html"
        with open(os.open(page, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(PAGE.format(url=url, name=name))
        if _is_read_by_others():
            console.say(f"{name}: open {page}; the address is left out here because others can read this log")
        else:
            console.say(f"{name}: {url}")
        if opens:
            webbrowser.open(page.as_uri())
        yield page


def _seen_by_browsers() -> Path | None:
    """Return the parent of the file's folder; None means the folder for temporary files.

    A browser installed as a snap has a separate /tmp, and sees only the parts of the home folder that are not hidden.
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
    except (AttributeError, OSError, ValueError):  # stderr is not a file
        return False
    return stat.S_ISREG(mode) and bool(mode & (stat.S_IRGRP | stat.S_IROTH))


def has_display() -> bool:
    """Whether the user at the terminal sees a browser that is opened here."""
    if "SSH_CONNECTION" in os.environ:
        return False
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
