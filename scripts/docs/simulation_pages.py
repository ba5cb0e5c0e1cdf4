"""Build the pages of the simulation: scenes, sensors, their parts, objects, and every key of a scene or a sensor."""

from collections.abc import Iterator, Mapping
from typing import Any

from evetac_cli.inspect.listing import flat_rules, rules_of
from evetac_cli.resources import SCENES
from evetac_cli.resources import table as packaged
from evetac_cli.sim.setup.parts import PARTS, rows_of
from evetac_cli.sim.setup.plan import Plan, first_plan
from evetac_cli.sim.setup.sensor_file import FOR_EACH_TRIAL
from evetac_cli.sim.setup.sensor_file import rows as sensor_rows
from evetac_cli.text_files import read_toml
from scripts.docs.page_text import bounds, code, fenced, folded, prose, sentence, table, value

Rules = Mapping[str, Any]
EXAMPLE = "evetac"  # the sensor with which others are compared


def pages() -> dict[str, str]:
    """Return the text of every page by its path."""
    return {
        "scenes.md": _scenes(),
        "sensors.md": _sensors(),
        "parts.md": _parts(),
        "scene-keys.md": _keys_page("scene", "A scene of your own", "--scene mine.toml"),
        "objects.md": _objects(),
    }


def scene_names() -> list[str]:
    """Return the names of the packaged scenes."""
    return sorted(path.stem for path in SCENES.glob("*.toml"))


def plan_of(name: str, sensor: str = EXAMPLE) -> Plan:
    """Return the plan that a packaged scene builds with a sensor."""
    return first_plan(name, sensor=sensor)


def _scenes() -> str:
    lines = [
        "# Scenes\n",
        "A scene describes a simulated trial. All files made from a scene are marked as simulated. `--dry-run` shows"
        " which [parts](parts.md) a scene builds; parts that it does not name cost no run time. To write your own"
        " scene, copy one of the TOML files below and change [its keys](scene-keys.md).\n",
    ]
    for name in scene_names():
        text = (SCENES / f"{name}.toml").read_text()
        comment = " ".join(line.removeprefix("#").strip() for line in _head(text))
        named = read_toml(SCENES / f"{name}.toml")
        command = "grasp" if named["kind"] == "lift" else "record"
        built = [row["part"] for row in rows_of(plan_of(name)) if row["built"] is not None]
        lines += [
            f"## {name}\n",
            sentence(prose(named["summary"])) + "\n",
            prose(comment) + "\n" if comment else "",
            fenced(f"evetac {command} --scene {name} --out {name}/", "console"),
            f"Kind `{named['kind']}`. Parts: {', '.join(built)}.\n",
            folded(f"{name}.toml", fenced(text, "toml")),
        ]
    return "\n".join(lines)


def _head(text: str) -> Iterator[str]:
    """Yield the lines of the comment at the head of a file."""
    for line in text.splitlines():
        if not line.startswith("#"):
            return
        yield line


def _sensors() -> str:
    rows = sensor_rows()
    rules = rules_of("sensor")
    lines = [
        "# Sensors\n",
        "Simulated sensors for `--sensor NAME`: gel, dots, camera and noise. None of them was measured on a real"
        " Evetac. `evetac` is fitted to figures in the paper. [`identify`](commands/identify.md) estimates a sensor"
        " like yours from recordings ([how it works](../identify.md)).\n",
    ]
    for name, row in rows.items():
        lines += [f"## {name}\n", sentence(prose(row["summary"])) + "\n"]
        if name in FOR_EACH_TRIAL:
            lines.append("Each value below is sampled from its own random stream. All others are those of `evetac`.\n")
            lines.append(table(("key", "value or range"), [(code(key), _range(item)) for key, item in _flat(row)]))
        elif name != EXAMPLE:
            base = dict(_flat(rows[EXAMPLE]))
            differing = [(key, item) for key, item in _flat(row) if key != "summary" and item != base.get(key)]
            shown = [(code(key), value(base[key]) if key in base else "", value(item)) for key, item in differing]
            lines.append(table(("key", f"`{EXAMPLE}`", code(name)), shown))
    lines += [
        "## Keys of a sensor's file\n",
        "Write your own sensor as a TOML file and pass it with `--sensor mine.sensor.toml`. With"
        ' `like = "evetac"` it needs only the keys that differ from `evetac`.\n',
        table(
            ("key", "meaning", "values", f"`{EXAMPLE}`"),
            [
                (code(path), prose(rule.get("description", "")), _values(rule), value(_at(rows[EXAMPLE], path)))
                for path, rule in flat_rules(rules)
            ],
        ),
    ]
    return "\n".join(lines)


def _parts() -> str:
    rules = {"sensor": rules_of("sensor"), "scene": rules_of("scene")}
    built: dict[str, list[str]] = {}
    for name in scene_names():
        for row in rows_of(plan_of(name)):
            built.setdefault(row["part"], []).extend([] if row["built"] is None else [name])
    realistic = {row["part"]: row["built"] for row in rows_of(plan_of("slip", "realistic")) if row["built"] is not None}
    lines = [
        "# Parts of a scene and a sensor\n",
        "A simulation is built from parts. A part that neither scene nor sensor names is left out and costs no run"
        " time. [Disturbances](../disturbances.md) shows how each part changes events, labels, tracks and grasps.\n",
    ]
    for part in PARTS:
        name = part.name
        lines.append(f"## {name}\n")
        rows = [
            (code(path), owner, prose(rule.get("description", "")), _values(rule))
            for owner, path in (key.split(".", 1) for key in part.keys)
            for rule in (_rule(rules[owner], path),)
        ]
        lines.append(table(("key", "of", "meaning", "values"), rows))
        scenes = built[name]
        if len(scenes) == len(scene_names()):
            lines.append("In every packaged scene.\n")
        elif scenes:
            listed = ", ".join(f"[{each}](scenes.md#{each})" for each in scenes)
            lines.append(f"In {listed}.\n")
        else:
            lines.append(f"Left out of all packaged scenes with the sensor `{EXAMPLE}`.\n")
        if name in realistic and not scenes:
            lines.append(f"The sensor [`realistic`](sensors.md#realistic) has it: `{realistic[name]}`.\n")
    return "\n".join(lines)


def _keys_page(owner: str, title: str, flag: str) -> str:
    rules = rules_of(owner)
    rows = [(code(path), prose(rule.get("description", "")), _values(rule)) for path, rule in flat_rules(rules)]
    return "\n".join(
        (
            f"# {title}\n",
            f"All keys that a file for `{flag}` may have. A dot separates a table from its key: `gel.cut` is `cut` in"
            " the table `[gel]`. Start with a copy of a [packaged scene](scenes.md). evetac reports missing keys, and"
            " keys that this kind of scene does not support, when it reads the file.\n",
            table(("key", "meaning", "values"), rows),
        )
    )


def _objects() -> str:
    objects = packaged("objects")
    keys = list(dict.fromkeys(key for row in objects.values() for key in row))
    rows = [(number, *(value(row[key]) if key in row else "" for key in keys)) for number, row in objects.items()]
    comment = " ".join(line.removeprefix("#").strip() for line in _head((SCENES.parent / "objects.toml").read_text()))
    return "\n".join(
        (
            "# Objects\n",
            prose(comment) + "\n",
            "Choose objects by number: `--object 3,8` or `--object 1-9`.\n",
            table(("number", *(key.replace("_", " ") for key in keys)), rows),
        )
    )


def _rule(rules: Rules, path: str) -> Rules:
    """Return the rule of a key; KeyError if there is none."""
    return dict(flat_rules(rules))[path]


def _values(rule: Rules) -> str:
    """Describe the values that a key accepts."""
    if "enum" in rule:
        return ", ".join(map(code, rule["enum"]))
    if "const" in rule:
        return value(rule["const"])
    kind = rule.get("type")
    if kind == "boolean":
        return "yes or no"
    if kind == "object":
        return "a table"
    if kind == "string":
        return "text"
    if "anyOf" in rule:
        return "a number or a range"
    if kind == "array":
        items = rule.get("items", {})
        least, most = rule.get("minItems"), rule.get("maxItems")
        count = f"{least}" if least == most and least else f"{least or 0} to {most}" if most else "several"
        of = _values(items) if items.get("type") in ("number", "integer") else "values"
        return f"a list of {count}" + (f", {of}" if of != "values" else "")
    low, above = rule.get("minimum"), rule.get("exclusiveMinimum")
    whole = "whole, " if kind == "integer" else ""
    return whole + bounds(low, rule.get("maximum"), above)


def _flat(row: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value of a row with its key; a range to sample from counts as one value."""
    for name, item in row.items():
        here = f"{path}.{name}" if path else name
        if isinstance(item, Mapping) and "stream" not in item:
            yield from _flat(item, here)
        else:
            yield here, item


def _range(item: Any) -> str:
    """Return a value, or the range that it is sampled from, as text."""
    if isinstance(item, list):
        return ", ".join(map(_range, item))
    if not isinstance(item, Mapping):
        return value(item)
    (how, (low, high)) = next((key, ends) for key, ends in item.items() if key != "stream")
    return f"{low:g} to {high:g} ({how.replace('_', '-')})"


def _at(row: Mapping[str, Any], path: str) -> Any:
    """Return the value of a dotted key in a row; empty if the key is missing or names a table."""
    item: Any = row
    for name in path.split("."):
        item = item.get(name, "") if isinstance(item, Mapping) else ""
    return "" if isinstance(item, Mapping) else item
