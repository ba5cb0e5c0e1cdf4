"""Every place at which another user of the computer could come in stands in docs/safety.md."""

import ast
from collections import defaultdict

from evetac_cli.resources import PACKAGE

# Calls that make a socket, a file or folder in /tmp, shared memory, a terminal, a process, a lock or a cluster.
CALLS = {
    *("mkstemp", "mkdtemp", "TemporaryDirectory", "TemporaryFile", "NamedTemporaryFile", "SpooledTemporaryFile"),
    *("gettempdir", "mktemp", "mkfifo", "openpty", "memfd_create", "RawArray", "SharedMemory", "shm_open"),
    *("create_server", "socketpair", "Listener", "Manager", "LocalCluster", "socket"),
    *("ThreadingTCPServer", "ThreadingHTTPServer", "bind_sockets"),
    *("Popen", "check_output", "system", "Pipe", "open_lock", "flock", "umask"),
}
WHOLE = {"subprocess.run", "webbrowser.open", "serial.Serial"}
# Which module makes which. Before a row is added: who can reach it, and does docs/safety.md say so?
DOORS = {
    "cli/compiling.py": {"Listener"},  # of numba's events
    "cli/dask_engine.py": {"LocalCluster", "TemporaryDirectory"},
    "cli/exit_codes.py": {"mkstemp"},
    "cli/workers.py": {"Pipe"},
    "devices/rh_p12_rn/dynamixel_bus.py": {"serial.Serial"},
    "devices/virtual/gripper.py": {"Popen"},
    "devices/virtual/servo_plant.py": {"memfd_create", "mkstemp"},
    "devices/virtual/servo_process.py": {"openpty"},
    "devices/virtual/world.py": {"Pipe"},
    "formats/read/bags/bag_files.py": {"gettempdir", "mkdtemp"},
    "formats/read/events_on_disk.py": {"TemporaryFile"},
    "inspect/doctor/chain.py": {"TemporaryDirectory"},
    "inspect/doctor/compile_kernels.py": {"Popen", "TemporaryDirectory"},
    "inspect/doctor/compile_worker.py": {"Listener", "TemporaryFile"},  # of numba's events
    "inspect/doctor/speed.py": {"TemporaryDirectory"},
    "kernel_cache.py": {"TemporaryDirectory", "gettempdir", "mkdtemp"},
    "evaluate/cost/labels.py": {"TemporaryDirectory"},
    "evaluate/cost/pipeline.py": {"TemporaryDirectory"},
    "realtime/bell.py": {"Pipe"},
    "realtime/last_words.py": {"RawArray"},
    "testing.py": {"TemporaryDirectory"},
    "pages/view/trial_files.py": {"TemporaryDirectory"},
    "local_server.py": {"ThreadingTCPServer", "webbrowser.open"},
    "trials/live_view/shared_view.py": {"RawArray"},
    "realtime/shared_status.py": {"RawArray"},
    "trials/grasp/grasp_processes.py": {"Pipe"},
    "trials/live_view/__init__.py": {"Pipe"},
    "store/hdf5/disk.py": {"TemporaryFile", "gettempdir"},
    "store/recordings/recovery.py": {"flock", "open_lock"},
    "store/recordings/segments.py": {"flock", "open_lock"},
}


def test_all_doors_are_known() -> None:
    """Assert that no module makes a socket, a temporary file, a process or the like that the table does not know."""
    doors: defaultdict[str, set[str]] = defaultdict(set)
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            made = [node.func] if isinstance(node, ast.Call) else node.bases if isinstance(node, ast.ClassDef) else []
            for whole in map(ast.unparse, made):
                last = whole.rpartition(".")[2]
                if whole in WHOLE or last in CALLS:
                    doors[str(path.relative_to(PACKAGE))].add(whole if whole in WHOLE else last)
    assert dict(doors) == DOORS
