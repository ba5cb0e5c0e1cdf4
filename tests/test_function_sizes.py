"""Functions that a reader takes in at once: at most 60 lines and 8 arguments, but for the tables below.

Compiled kernels are left out: numba takes no settings object, and cutting a loop costs time (measured where it stands).
"""

import ast
from collections.abc import Iterator
from pathlib import Path

from evetac_cli.resources import PACKAGE

ROOT = PACKAGE.parent
MOST_LINES, MOST_ARGUMENTS = 60, 8

LONG = {
    "trials/grasp/controller_process.py _command": "a step is safe by the order of its parts, from top to bottom",
    "trials/grasp/real_time.py run": "what is opened is closed in the reverse order, also by Ctrl-C between two lines",
    "sim/camera/gel_camera.py __init__": "",
    "sim/camera/scanning/camera.py start": "",
    "sim/scenes/gripped.py __init__": "",
    "sim/scenes/gripped.py _build_mechanics": "",
    "sim/gel/gel.py start": "",
    "sim/grasp_outcome.py outcome": "",
    "sim/setup/sampling.py sample_trial": "",
    "kernels/slip/training.py train": "",
    "kernels/force/gel_forces.py adapt": "",
    "kernels/identify/thresholds.py of_either_polarity": "",
    "attack/kill_grasps.py one": "",
}
MANY = {
    "api.py __init__": "public, by keyword only",
    "gym.py __init__": "public, by keyword only",
    "commands/parameter.py parameter": "what a flag may state, by keyword only",
    "kernels/slip/training.py train": "",
    "sim/setup/plan.py plans": "",
    "sim/gel/gel.py step": "",
    "sim/gel/contact.py force_curve": "",
    "studies/tables.py table_of": "",
    "reproduce/run.py perform": "",
}


def functions(folder: Path) -> Iterator[tuple[str, ast.FunctionDef]]:
    """Every function that is no kernel, by file and name."""
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and not any(
                "jit" in ast.unparse(each) for each in node.decorator_list
            ):
                yield f"{path.relative_to(folder)} {node.name}", node


def arguments(node: ast.FunctionDef) -> int:
    """How many arguments a caller can give."""
    named = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return len([each for each in named if each.arg not in ("self", "cls")])


def test_functions_are_short_and_take_few_arguments() -> None:
    """Assert that only the functions of the tables are longer, or take more arguments, and that these exist."""
    every = [each for folder in (PACKAGE, ROOT / "scripts") for each in functions(folder)]
    assert {name for name, node in every if (node.end_lineno or 0) - node.lineno >= MOST_LINES} <= LONG.keys()
    assert {name for name, node in every if arguments(node) > MOST_ARGUMENTS} <= MANY.keys()
