"""Constants of ours that stand beside a public fact: entries of sensors, scenes, objects, and of the gripper."""

from collections.abc import Sequence
from typing import Any

from evetac_cli import resources
from evetac_cli.evaluate.likeness.facts import Values
from evetac_cli.text_files import read_toml

EVERY = "*"  # in a path: all entries of a table, of which the least and the largest value count


def constant_of(path: Sequence[str]) -> Values:
    """The value, or the two ends, of a constant by its path, as in sensors, evetac, threshold; KeyError if it is none.

    The first part is sensors, objects, scenes (then the scene's name) or gripper.
    """
    kind, *rest = path
    if kind == "gripper":
        from evetac_cli.sim.gripper import Drive  # here, as it loads compiled code

        return (float(getattr(Drive(), rest[0])),)
    if kind == "scenes":
        name, *rest = rest
        found: Any = read_toml(resources.SCENES / f"{name}.toml")
    else:
        found = resources.table(kind)
    if rest[0] == EVERY:
        values = [row[rest[1]] for row in found.values()]
        return float(min(values)), float(max(values))
    for key in rest:
        found = found[key]
    return tuple(float(one) for one in found) if isinstance(found, list) else (float(found),)
