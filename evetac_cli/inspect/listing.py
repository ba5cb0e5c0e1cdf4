"""list: the scenes, objects, sensors, networks and controllers that flags can name, and the keys of own files."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

from evetac_cli import names, plugins, resources
from evetac_cli.console import print_table, print_text
from evetac_cli.jobs import LookCall, Outcome, Row, Rows
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, MemoryArchitecture, OverImages
from evetac_cli.sim.setup import sensor_file
from evetac_cli.text_files import read_toml

OWNERS = ("scene", "sensor", "object")  # kinds of files of one's own
BOUNDS = {"minimum": "least", "exclusiveMinimum": "more_than", "maximum": "most"}  # of a schema; columns of keys
SHOWN = ("file", "name", "command", "about")  # columns on a terminal; -v and --json have all


def look(call: LookCall) -> Outcome:
    """Return a row for each name, those of plug-ins last, or for each key."""
    what = call.params.what
    rows = _LISTS[what]()
    return Outcome(rows, False, {what: len(rows)})


def show(result: Outcome, *, verbose: bool = False) -> None:
    """Print a line for each row with its words last; rows without words as a table."""
    shown = [[str(row[name]) for name in SHOWN if row.get(name) is not None] for row in result.rows]
    if any(len(line) == 1 for line in shown) or verbose:
        print_table("list", result.rows, {}, simulated=False, verbose=verbose)
        return
    widths = [max(map(len, column)) for column in zip(*shown, strict=False)]
    for line in shown:
        cells = [f"{text:<{width}}" for text, width in zip(line[:-1], widths, strict=False)]
        print_text("  ".join([*cells, line[-1]]).rstrip())


def rules_of(owner: str) -> dict[str, Any]:
    """Return the JSON schema of a file of one's own: a scene, a sensor or an object."""
    rules: dict[str, Any] = json.loads((resources.schemas() / f"{owner}.v1.json").read_text())
    return rules


def flat_rules(rule: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield every key with its rule; the keys of a table follow the table, with a dot between."""
    for name, inner in rule.get("properties", {}).items():
        here = f"{path}.{name}" if path else name
        yield here, inner
        yield from flat_rules(inner, here)


def _of_plugins(group: str) -> Rows:
    return [{"name": name, "about": "of a plug-in"} for name in plugins.usable(group)]


def _scenes() -> Rows:
    commands = {name: "record" for name in names.RECORDED_SCENES} | {name: "grasp" for name in names.GRASPED_SCENES}
    summaries = {name: read_toml(resources.SCENES / f"{name}.toml")["summary"] for name in commands}
    rows = [{"name": name, "command": command, "about": summaries[name]} for name, command in commands.items()]
    return rows + [{**row, "command": "-"} for row in _of_plugins(plugins.SCENES)]


def _objects() -> Rows:
    objects = resources.table("objects")
    columns = dict.fromkeys(key for row in objects.values() for key in row)
    rows = [{"name": name} | {key: row.get(key) for key in columns} for name, row in objects.items()]
    return rows + _of_plugins(plugins.OBJECTS)


def _sensors() -> Rows:
    rows = [{"name": name, "about": row["summary"]} for name, row in sensor_file.rows().items()]
    return rows + _of_plugins(plugins.SENSORS)


def _networks() -> Rows:
    def about(architecture: Any) -> str:
        what = "images" if isinstance(architecture, OverImages) else "dots"
        if isinstance(architecture, MemoryArchitecture):
            return f"{what}, the whole contact, every {architecture.every} ms"
        return f"{what}, {architecture.history} ms, every {architecture.every} ms"

    rows = [{"name": name, "about": about(architecture)} for name, architecture in ARCHITECTURES.items()]
    return rows + _of_plugins(plugins.NETWORKS)


def _controllers() -> Rows:
    rows = [{"name": name, "about": about} for name, about in names.CONTROLLERS.items()]
    return rows + _of_plugins(plugins.CONTROLLERS)


def _keys() -> Rows:
    def row(owner: str, key: str, rule: Mapping[str, Any]) -> Row:
        bounds = {column: rule.get(name) for name, column in BOUNDS.items()}
        values = rule.get("enum") or ([rule["const"]] if "const" in rule else None)
        choices = None if values is None else ", ".join(map(str, values))
        about = {"file": owner, "name": key, "about": rule.get("description", "")}
        return {**about, "type": rule.get("type"), **bounds, "choices": choices}

    return [row(owner, key, rule) for owner in OWNERS for key, rule in flat_rules(rules_of(owner))]


_LISTS = {
    "scenes": _scenes,
    "objects": _objects,
    "sensors": _sensors,
    "networks": _networks,
    "controllers": _controllers,
    "keys": _keys,
}
