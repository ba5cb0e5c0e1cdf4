"""Every port, and every file whose name another user of the computer could guess, is known."""

import ast
from collections import defaultdict

from evetac_cli.resources import PACKAGE

# Calls and classes that make a port, a terminal, or something with a name that all users share.
NAMES = {
    *("bind_sockets", "create_server", "HTTPServer", "LocalCluster", "Manager", "socket", "ThreadingHTTPServer"),
    *("gettempdir", "mkfifo", "mktemp", "openpty", "SharedMemory", "shm_open", "ThreadingTCPServer", "umask"),
}
# Which module makes which. Before a row is added: who can reach it, and does docs/safety.md say so?
DOORS = {
    "devices/virtual/gripper.py": {"openpty"},
    "formats/read/bags/bag_files.py": {"gettempdir"},
    "kernels/kernel_cache.py": {"gettempdir"},
    "realtime/local_server.py": {"ThreadingTCPServer"},
    "store/hdf5/disk.py": {"gettempdir"},
}


def test_all_doors_are_known() -> None:
    """Assert that no module makes a port or a shared name that the table does not know."""
    doors: defaultdict[str, set[str]] = defaultdict(set)
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            made = [node.func] if isinstance(node, ast.Call) else node.bases if isinstance(node, ast.ClassDef) else []
            for name in (ast.unparse(each).rpartition(".")[2] for each in made):
                if name in NAMES:
                    doors[str(path.relative_to(PACKAGE))].add(name)
    assert dict(doors) == DOORS
