"""Functions that a reader takes in at once: at most 60 lines and 8 arguments, but for the tables below.

Compiled kernels are left out: numba takes no settings object, and cutting a loop costs time (measured where it stands).
"""

import ast
from collections.abc import Iterator
from pathlib import Path

from evetac_cli.resources import PACKAGE

ROOT = PACKAGE.parent
MOST_LINES, MOST_ARGUMENTS = 60, 8

# By the name of their file, as folders move.
LONG = {
    "controller_process.py _command": "a step is safe by the order of its parts, from top to bottom",
    "real_time.py run": "what is opened is closed in the reverse order, also by Ctrl-C between two lines",
    "camera.py start": "many fields of one record, drawn in the order of its lines",
    "gel_camera.py __init__": "the camera of a gel is put together here, part by part",
    "training.py train": "one run of the optimiser: what it saves is what it resumes from",
    "gel_forces.py adapt": "one regression, with its prior and its errors",
    "thresholds.py of_either_polarity": "one fit: what it excludes, fits and bounds",
    "sampling.py sample_trial": "the order of drawing is that of the lines: a part must not shift another's numbers",
    "kill_grasps.py one": "one trial, from the start of the command to its judgement",
}
MANY = {
    "api.py __init__": "public, by keyword only",
    "gym.py __init__": "public, by keyword only",
    "parameter.py parameter": "what a flag may state, by keyword only",
    "training.py train": "what a run is given, by keyword but for its data",
    "gel.py step": "the physics of a step; by keyword, how exactly it is solved",
}


def functions(folder: Path) -> Iterator[tuple[str, ast.FunctionDef]]:
    """Every function that is no kernel, by the names of its file and itself."""
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and not any(
                "jit" in ast.unparse(each) for each in node.decorator_list
            ):
                yield f"{path.name} {node.name}", node


def arguments(node: ast.FunctionDef) -> int:
    """How many arguments a caller can give."""
    named = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return len([each for each in named if each.arg not in ("self", "cls")])


def test_functions_are_short_and_take_few_arguments() -> None:
    """Assert that only the functions of the tables are longer, or take more arguments, and that these exist."""
    every = [each for folder in (PACKAGE, ROOT / "scripts") for each in functions(folder)]
    assert {name for name, node in every if (node.end_lineno or 0) - node.lineno >= MOST_LINES} <= LONG.keys()
    assert {name for name, node in every if arguments(node) > MOST_ARGUMENTS} <= MANY.keys()
