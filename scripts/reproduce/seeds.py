"""Compare the seeds, figures and facts that constants saw (seeds.json) with the tables of docs/results and the paper.

tests/scripts/reproduce/test_seeds.py asserts that `faults` finds nothing. A frozen table names the commit at which
methods and constants were frozen (frozen.py); its trials have seeds that no constant ever saw.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from scripts.reproduce import frozen

ROOT = Path(__file__).resolve().parents[2]
FILE = Path(__file__).with_name("seeds.json")
RESULTS = ROOT / "docs" / "results"
NAMED = ("recording_seeds", "contact_seeds", "trial_seeds")  # in the sizes of tables
USED_TO_FIT = "used to fit"  # class of a fact in likeness.toml

Table = Mapping[str, Any]
Group = Mapping[str, Any]


def known() -> dict[str, Any]:
    """Return the contents of seeds.json."""
    loaded: dict[str, Any] = json.loads(FILE.read_text())
    return loaded


def tables(results: Path = RESULTS) -> dict[str, Table]:
    """Return the stored tables by name; those in folders of docs/results as FOLDER/NAME."""
    return {
        str(path.relative_to(results).with_suffix("")): json.loads(path.read_text()) for path in results.rglob("*.json")
    }


def _in_text(text: str) -> set[int]:
    """Return the seeds of texts such as `50000-50999`."""
    found = re.findall(r"(\d+)(?:-(\d+))?", text)
    return {seed for first, last in found for seed in range(int(first), int(last or first) + 1)}


def seeds_of(table: Table) -> set[int]:
    """Return the seeds of the trials that a table reports: those of its sizes or, without any, of its commands."""
    sizes = table.get("sizes", {})
    named = {seed for key in NAMED for seed in sizes.get(key) or []}
    if {"first", "last"} <= sizes.keys():
        named |= set(range(sizes["first"], sizes["last"] + 1))
    texts = sizes.get("seeds") or ""
    for text in [texts] if isinstance(texts, str) else texts.values() if isinstance(texts, dict) else []:
        named |= _in_text(text)
    for command in () if named else table.get("commands", []):
        for text in re.findall(r"--seeds? (\d+(?:-\d+)?)", command):
            named |= _in_text(text)
    return named


def seen_by(group: Group) -> set[int]:
    """Return the seeds that the constants of a group saw; an empty set if they are unknown."""
    ranges = [one if isinstance(one, list) else [one, one] for one in group["seeds"] or []]
    return {seed for first, last in ranges for seed in range(first, last + 1)}


def concerns(group: Group, name: str, table: Table) -> bool:
    """Whether constants of a group enter a table."""
    if not any(fnmatch(name, pattern) for pattern in group["tables"]):
        return False
    first, last = group.get("label_methods", (None, None))
    method = table.get("methods", {}).get("label")
    return first is None or (method is not None and method >= first and (last is None or method <= last))


def overlaps(groups: Iterable[Group], every: Mapping[str, Table]) -> dict[tuple[str, str], list[int]]:
    """Return, by table and group, the seeds that the table reports and the group's constants saw."""
    found = {}
    for group in groups:
        seen = seen_by(group)
        for name, table in every.items():
            if concerns(group, name, table) and (both := seeds_of(table) & seen):
                found[name, str(group["name"])] = sorted(both)
    return found


def faults(seen: Mapping[str, Any], every: Mapping[str, Table]) -> Iterator[str]:
    """Yield, in words, every table and every group that breaks the rule of seeds."""
    groups = seen["groups"]
    for (name, group), seeds in overlaps(groups, every).items():
        yield f"{name}: reports the seeds {seeds[:5]}, which the constants `{group}` saw"
    for group in groups:
        if judging := sorted(seen_by(group).intersection(frozen.SEEDS)):
            yield f"{group['name']}: its constants saw {judging[:5]}, on which frozen tables are judged"
    for name, table in every.items():
        seeds = seeds_of(table)
        if table.get("frozen"):
            outside = sorted(seeds.difference(frozen.SEEDS))
            if outside or not seeds:
                yield f"{name}: is frozen, but is judged on {outside[:5] or 'unknown seeds'}"
        elif judging := sorted(seeds.intersection(frozen.SEEDS)):
            yield f"{name}: is judged on {judging[:5]}, but does not name the frozen commit"


def fit_faults(
    groups: Iterable[Group], figures: Mapping[tuple[Any, ...], Any], facts: Iterable[Table]
) -> Iterator[str]:
    """Yield, in words, figures of the paper and public facts that are fitted and named by no group, or the reverse.

    figures: PAPER.figures; facts: those of likeness.toml.
    """
    groups = list(groups)
    starts = [(group["name"], tuple(start)) for group in groups for start in group.get("paper", [])]
    for key, figure in figures.items():
        said = [name for name, start in starts if key[: len(start)] == start]
        if figure.fitted_in and not said:
            yield f"the figure {key} is fitted in `{figure.fitted_in}`, but no group names it"
        if said and not figure.fitted_in:
            yield f"the figure {key} is named by `{said[0]}`, but has no `fitted_in`"
    for name, start in starts:
        if not any(key[: len(start)] == start for key in figures):
            yield f"`{name}` names {start}, which is no figure of the paper"
    used = {fact["name"] for fact in facts if fact["class"] == USED_TO_FIT}
    named = {fact: group["name"] for group in groups for fact in group.get("likeness", [])}
    yield from (f"the fact `{fact}` is used to fit, but no group names it" for fact in sorted(used - named.keys()))
    yield from (f"`{named[fact]}` names the fact `{fact}`, which is not used to fit" for fact in named.keys() - used)
