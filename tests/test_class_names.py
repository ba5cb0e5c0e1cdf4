"""Names: what a reader finds by a name is one thing."""

import ast
from collections import defaultdict

from evetac_cli.resources import PACKAGE

# Kinds of cameras and of grippers, called what --camera and --gripper call them; they are read with their module.
TWICE = {"Simulated", "Virtual"}
MOST_TWICE = 5


def test_a_class_name_stands_for_one_class() -> None:
    """Assert that hardly any two classes of the package have one name, and which those are."""
    places = defaultdict(list)
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(str(path.relative_to(PACKAGE)))
    twice = {name: where for name, where in places.items() if len(where) > 1}
    assert twice.keys() == TWICE, twice
    assert len(twice) <= MOST_TWICE
