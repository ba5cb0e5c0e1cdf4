"""Who may import whom (design, section 4), and what starting the program must not load."""

import ast
import functools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from evetac_cli.resources import PACKAGE
from tests.conftest import Made
from tests.patience import PATIENCE_S

MODULES = sorted(PACKAGE.rglob("*.py"))

# Who may import whom, from the top down; a package may import itself too. CONTRIBUTING's table is made from this one.
GROUND = frozenset(
    {"names", "plugins", "errors", "events", "arrays", "interrupts", "jobs", "commands", "console"}
    | {"resources", "text_files"}
)
MAY_IMPORT: dict[str, frozenset[str]] = {
    "cli": GROUND | {"evaluate", "store", "kernels"},
    "api": GROUND | {"evaluate", "trials", "stages", "devices", "store", "sim", "kernels"},
    "testing": GROUND | {"devices", "formats", "store", "sim", "kernels"},
    "gym": GROUND | {"trials", "stages", "devices", "store", "sim", "kernels"},
    "inspect": GROUND
    | {"pages", "evaluate", "trials", "stages", "devices", "formats", "store", "sim", "realtime", "kernels"},
    "pages": GROUND | {"evaluate", "trials", "stages", "devices", "formats", "store", "sim", "kernels"},
    "evaluate": GROUND | {"trials", "stages", "devices", "formats", "store", "sim", "kernels"},
    "trials": GROUND | {"stages", "devices", "formats", "store", "sim", "realtime", "kernels"},
    "stages": GROUND | {"devices", "formats", "store", "sim", "realtime", "kernels"},
    "devices": frozenset(
        {"names", "plugins", "console", "interrupts", "errors", "events", "resources"}
        | {"store", "sim", "realtime", "kernels"}
    ),
    "formats": frozenset(
        {"names", "plugins", "interrupts", "arrays", "errors", "events", "jobs", "resources", "text_files"}
        | {"store", "kernels"}
    ),
    "store": frozenset({"names", "plugins", "interrupts", "errors", "events", "resources", "text_files", "kernels"}),
    "sim": frozenset({"plugins", "arrays", "errors", "events", "resources", "text_files", "kernels"}),
    "realtime": frozenset({"console", "interrupts", "errors", "events", "text_files", "kernels"}),
    "kernels": frozenset({"names", "arrays", "errors", "events", "resources"}),
    "console": frozenset({"errors", "jobs"}),
    "commands": frozenset({"names", "plugins", "errors"}),
    "resources": frozenset({"errors"}),
    "text_files": frozenset({"errors"}),
    "jobs": frozenset({"errors"}),
    "interrupts": frozenset(),
    "events": frozenset({"errors"}),
    "arrays": frozenset(),
    "errors": frozenset(),
    "plugins": frozenset({"names", "errors"}),
    "names": frozenset(),
}

# Libraries that only some modules may import.
ONLY_IN = {
    "h5py": ("store/*", "store/hdf5/*", "store/layout/*", "store/recordings/*", "formats/read/*", "formats/write/*"),
    "usb": ("devices/dvxplorer/*", "devices/virtual/dvxplorer.py", "devices/probe.py"),
    "dynamixel_sdk": ("devices/rh_p12_rn/*",),
    "torch": (
        "kernels/slip/networks.py",
        "kernels/slip/training.py",
        "kernels/slip/memory_training.py",
        "kernels/force/training.py",
        "stages/train/networks.py",
        "testing.py",
    ),
    "typer": ("cli/main.py", "cli/flags.py", "cli/exit_codes.py"),
    "rich": ("console.py",),
    "numba": ("kernels/compiled.py", "cli/workers.py"),
    "distributed": ("cli/dask_engine.py",),
    "pyarrow": ("formats/read/*", "formats/write/*", "formats/write/lerobot/*"),
    "av": ("formats/write/lerobot/write_lerobot.py",),
    "mcap": ("formats/write/write_mcap.py", "formats/read/bags/*"),
    "gymnasium": ("gym.py",),
}


@functools.cache
def imports(path: Path) -> tuple[str, ...]:
    """Full names of all that a module imports, at its head, in its functions and for type checking."""
    package = ("evetac_cli", *path.relative_to(PACKAGE).parent.parts)
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [name.name for name in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = list(package[: len(package) - node.level + 1]) if node.level else []
            base += node.module.split(".") if node.module else []
            names += [".".join([*base, name.name]) for name in node.names]
    return tuple(names)


def part_of(name: str) -> str:
    """The part of the package that a name belongs to; `evetac_cli`, which nothing may import, for the package's own."""
    known = (name.split(".") + [""])[1]
    return known if (known and (PACKAGE / known).is_dir()) or (PACKAGE / f"{known}.py").is_file() else "evetac_cli"


def test_names_are_resolved() -> None:
    """Assert that this test sees relative, function-level and plain imports (else it would prove nothing)."""
    names = set(imports(PACKAGE / "cli/main.py"))
    assert {"typer", "importlib", "evetac_cli.errors.EvetacError"} <= names
    assert {"traceback", "evetac_cli.console"} <= set(imports(PACKAGE / "cli/exit_codes.py"))
    assert "evetac_cli.cli.main.main" in set(imports(PACKAGE / "__main__.py"))
    assert part_of("evetac_cli.store.files.StageFile") == "store"
    assert part_of("evetac_cli.errors") == "errors"
    assert part_of("evetac_cli.__version__") == part_of("evetac_cli") == "evetac_cli"


def test_directions() -> None:
    """Assert that each module imports only from its own package and those below it."""
    wrong = []
    for path in MODULES:
        part = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if part not in ("__main__", "__init__"):
            ours = [name for name in imports(path) if name.split(".")[0] == "evetac_cli"]
            wrong += [(str(path), name) for name in ours if part_of(name) not in MAY_IMPORT[part] | {part}]
    assert wrong == []


def test_no_circles_of_modules() -> None:
    """Assert that no module needs itself through others, also not by imports inside functions or for types."""
    modules = {".".join(("evetac_cli", *path.relative_to(PACKAGE).with_suffix("").parts)): path for path in MODULES}
    modules = {name.removesuffix(".__init__"): path for name, path in modules.items()}
    needed: dict[str, set[str]] = {}
    for name, path in modules.items():
        named = imports(path)
        needed[name] = modules.keys() & {*named, *(each.rpartition(".")[0] for each in named if each not in modules)}
    assert needed["evetac_cli.stages.label"] >= {"evetac_cli.jobs", "evetac_cli.stages.label_review"}
    while leaves := {name for name, below in needed.items() if not below & needed.keys()}:
        needed = {name: below - leaves for name, below in needed.items() if name not in leaves}
    while tops := needed.keys() - set().union(*needed.values()):
        needed = {name: below for name, below in needed.items() if name not in tops}
    assert sorted(needed) == []


def test_no_module_of_ours_is_imported_by_name() -> None:
    """Assert that import_module, which the tests above do not see, gets only names of other libraries.

    main, execution and workers choose a stage by name, and `import evetac_cli` the module of a public name.
    """
    for path in MODULES:
        text = path.read_text()
        if "import_module" not in text and "__import__" not in text:
            continue
        calls = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
        by_name = [call for call in calls if ast.unparse(call.func).split(".")[-1] in ("import_module", "__import__")]
        names = [
            ast.literal_eval(call.args[0])
            for call in by_name
            if path.name not in ("main.py", "execution.py", "workers.py", "__init__.py")
        ]
        known = {"evetac_cli", "", *ONLY_IN}
        assert [name for name in names if name.split(".")[0] in known] == [], path


def test_nothing_imports_main() -> None:
    """Assert that main is at the top: only `python -m evetac_cli` imports it."""
    importers = {path.name for path in MODULES if any(name.startswith("evetac_cli.cli.main") for name in imports(path))}
    assert importers == {"__main__.py"}


@pytest.mark.parametrize("library", ONLY_IN)
def test_libraries_have_one_home(library: str) -> None:
    """Assert that a library is imported only where it belongs."""
    users = [path.relative_to(PACKAGE) for path in MODULES if library in {name.split(".")[0] for name in imports(path)}]
    assert [str(user) for user in users if not any(user.match(place) for place in ONLY_IN[library])] == []


def test_wrong_imports_would_be_seen() -> None:
    """Assert that the rule above is not empty: each of these directions is forbidden."""
    for part, wrong in (("kernels", "store"), ("sim", "devices"), ("store", "sim"), ("stages", "inspect")):
        assert wrong not in MAY_IMPORT[part]


HEAVY = ("numpy", "h5py", "torch", "cv2", "scipy", "numba", "matplotlib", "dask", "distributed", "pydantic")
COMPILED = ("numba", "scipy", "cv2", "torch", "onnx", "pandas")  # or what takes as long to load
START = """
import runpy, sys
sys.argv = ["evetac", *sys.argv[1:]]
try:
    runpy.run_module("evetac_cli", run_name="__main__", alter_sys=True)
except SystemExit as end:
    print("exit", end.code, file=sys.stderr)
print(*sorted({name.split(".")[0] for name in sys.modules}), file=sys.stderr)
"""


def loaded_by(arguments: list[str], folder: Path = PACKAGE.parent) -> tuple[str, list[str]]:
    """What a command prints, and the names of all packages that it has loaded at its end."""
    run = [sys.executable, "-P", "-c", START, *arguments]
    environment = os.environ | {"PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run(
        run, capture_output=True, text=True, timeout=PATIENCE_S, check=True, cwd=folder, env=environment
    )
    end, loaded = done.stderr.splitlines()[-2:]
    assert end == "exit 0", done.stderr
    assert "evetac_cli" in loaded.split()
    return done.stdout, loaded.split()


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["track", "--help"], ["evaluate", "slip", "--help"]])
def test_start_is_light(arguments: list[str]) -> None:
    """Assert that help and version load none of the heavy libraries."""
    shown, loaded = loaded_by(arguments)
    assert shown
    assert [name for name in HEAVY if name in loaded] == []


def test_a_command_loads_no_other() -> None:
    """Assert that the flags of other commands are neither made nor loaded."""
    code = (
        "import sys; from evetac_cli.cli.main import command_line; command_line('track')\n"
        "print(*sorted(name for name in sys.modules if name.startswith('evetac_cli.commands.')))"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE)
    assert {name.split(".")[-1] for name in done.stdout.split()} == {"parameter", "track"}


@pytest.mark.parametrize(
    "words",
    [
        "info apart.recording.h5",
        "info .",
        "validate apart.recording.h5 apart.tracks.h5 apart.labels.h5 apart.features.h5",
        "export apart.recording.h5 --format parquet --out a.parquet",
        "export apart.recording.h5 --format csv --out a.csv",
        "export apart.recording.h5 --format raw --out a.raw",
        "export apart.recording.h5 --format mcap --out a.mcap",
        "export apart.recording.h5 --format text --out a.txt; record --from a.txt --out a.recording.h5",
        "report . --out a.html",
    ],
)
def test_looking_and_exporting_is_light(words: str, made: Made, tmp_path: Path) -> None:
    """Assert that no compiled code is loaded where nothing is computed, no pandas for tables, no pydantic for flags."""
    shutil.copytree(made.folder, tmp_path / "work")
    for library in ("pyarrow", "bokeh", "mcap", "PIL"):
        pytest.importorskip(library)
    *before, last = words.split("; ")
    for command in before:
        loaded_by(command.split(), tmp_path / "work")
    _, loaded = loaded_by(last.split(), tmp_path / "work")
    assert [name for name in (*COMPILED, "pydantic") if name in loaded] == []


@pytest.mark.slow
def test_programs_that_are_started_load_nothing_from_the_working_folder() -> None:
    """Assert that whatever starts Python by a module's name or with code says -P.

    Else a json.py that lies where somebody works would be run.
    """
    places = (PACKAGE, PACKAGE.parent / "scripts", PACKAGE.parent / "examples")
    nodes = [
        (path.name, node)
        for place in places
        for path in place.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
    ]
    starts = [
        (name, [ast.unparse(item) for item in node.elts[1:]])
        for name, node in nodes
        if isinstance(node, ast.List) and node.elts and ast.unparse(node.elts[0]) == "sys.executable"
    ]
    assert len(starts) > 15
    assert [start for start in starts if start[1][:1] in (["'-m'"], ["'-c'"])] == []
