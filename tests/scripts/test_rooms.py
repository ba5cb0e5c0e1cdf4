"""scripts/: rooms of at most fifteen modules, none of which needs itself through others."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MODULES = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in ROOT.glob("scripts/**/*.py")}
MOST_MODULES = 15


def needed(path: Path) -> set[str]:
    """The modules of scripts that a module imports, also in its functions."""
    imports = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
    named = {name for node in imports for one in node.names for name in (f"{node.module}.{one.name}", node.module)}
    return {name for name in named if name in MODULES}


def test_no_circles_of_modules() -> None:
    """Assert that modules can be sorted so that each imports only earlier ones; CycleError names a circle."""
    graph = {name: needed(path) for name, path in MODULES.items()}
    assert "scripts.reproduce.steps" in graph["scripts.reproduce.plan"]  # else it would prove nothing
    order = list(TopologicalSorter(graph).static_order())
    assert order.index("scripts.reproduce.experiment") < order.index("scripts.reproduce.run")


def test_no_room_is_crowded() -> None:
    """Assert that no folder of scripts, or of their tests, has more than fifteen modules."""
    folders = {path.parent for path in (*MODULES.values(), *(ROOT / "tests" / "scripts").rglob("test_*.py"))}
    crowded = {str(one) for one in folders if len(set(one.glob("*.py")) - {one / "__init__.py"}) > MOST_MODULES}
    assert crowded == set()
