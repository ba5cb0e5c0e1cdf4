"""Behind the door nothing asks a scene, a sensor, an object, a solver or a plan by string: mypy sees every key."""

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[3] / "evetac_cli"
TYPED = {"plan", "scene", "sensor_row", "object_row", "object", "solver", "randomise", "like"}
DOOR = "sim/setup/"  # where tables are read


def asked(path: Path) -> Iterator[str]:
    """Where a module takes a key of something typed by a literal string."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        key: ast.expr | None = None
        if isinstance(node, ast.Subscript):
            owner, key = node.value, node.slice
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "get":
            owner, key = node.func.value, node.args[0] if node.args else None
        if isinstance(key, ast.Constant) and isinstance(key.value, str):
            name = owner.attr if isinstance(owner, ast.Attribute) else owner.id if isinstance(owner, ast.Name) else ""
            if name in TYPED:
                yield f"{node.lineno}: {ast.unparse(node)}"


def test_nothing_is_asked_by_string() -> None:
    """Assert that no module but those that read files takes a key of a plan, scene, sensor or solver by its name."""
    modules = [path for path in PACKAGE.rglob("*.py") if not str(path.relative_to(PACKAGE)).startswith(DOOR)]
    assert {str(path): places for path in modules if (places := list(asked(path)))} == {}


def test_the_search_finds_what_it_is_for(tmp_path: Path) -> None:
    """Assert that a subscript and a `get` by string are found, of a name and of an attribute."""
    module = tmp_path / "module.py"
    module.write_text('plan["scene"]\ntrial.plan["tone_hz"]\nsensor_row.get("creep", {})\nscene[0]\nother["scene"]\n')
    assert [place.split(":")[0] for place in asked(module)] == ["1", "2", "3"]
