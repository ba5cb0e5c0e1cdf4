"""evaluate likeness: what recordings, simulated and real alike, say of each public fact about the sensor.

A row for each fact, in the order of docs/likeness.md: what is public, what the simulated recordings say and what the
real ones, and how both compare. What needs trainings, grasps or many trials is read from docs/results. Where neither
tells a fact, the row says what would. Then a row for each recording with all that it tells.
`_values` are the figures as a JSON list, as a fact may have several.

Kernels are imported where they are called, so that a report that is up to date loads none.

A measure that belongs to a scene is taken of this scene alone where recordings are simulated; of a real recording, who
made it knows what was done. Means over recordings for shares of a data rate, as in the paper, medians for all else.
"""

import hashlib
import json
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evetac_cli import resources
from evetac_cli.commands.evaluate import EvaluateLikeness
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.evaluate import report, report_job
from evetac_cli.evaluate.likeness import beside
from evetac_cli.evaluate.likeness.facts import NEAR, WITHIN, Fact, as_text, constant_of, facts, named_tables
from evetac_cli.evaluate.likeness.tables import Ours, ResultTables
from evetac_cli.jobs import Job, Outcome, Progress, Row, Rows, Stage, silent
from evetac_cli.store.index import scene_words
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings.read import open_recording

if TYPE_CHECKING:
    from evetac_cli.evaluate.likeness.single_slice import Slip

OUTPUT = "report"
METHOD = 1
SLIPS = ("slip", "slip-varied")  # scenes whose slips one threshold is judged on
HERE = "these recordings"  # where a figure comes from
SHARES = "share_"  # measures that are means, as in the paper


@dataclass(frozen=True)
class Told:
    """What a recording tells, and what it is: its scene, None where nobody says it, and its object."""

    row: Row
    simulated: bool
    scene: str | None
    slip: "Slip | None"


def jobs(files: list[Path], params: EvaluateLikeness, out: Path | None) -> list[Job]:
    """One report over all recordings."""
    ResultTables(params.results)
    return report_job(files, "likeness", out)


def run(job: Job, params: EvaluateLikeness, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """A row for every fact, then one for every recording."""
    tables = ResultTables(params.results)
    parents: list[Header] = []
    for path in job.inputs:
        with open_recording(path) as recording:
            parents += beside.headers(recording)
    listed = hashlib.sha256((resources.DATA / "likeness.toml").read_bytes()).hexdigest()
    parameters = {**recipe_of(params), "facts": listed, "tables": tables.digests(named_tables())}

    def measured() -> tuple[Rows, dict[str, Any]]:
        told = []
        for number, path in enumerate(job.inputs):
            told.append(_told(path))
            progress(number + 1, len(job.inputs))
        rows = [_fact_row(fact, told, tables) for fact in facts()]
        return [*rows, *(one.row for one in told)], _summary(rows, told)

    return report(job, "evaluate likeness", METHOD, parameters, parents, measured, force=force)


def for_people(rows: Rows, params: EvaluateLikeness) -> tuple[Rows, list[str]]:
    """The facts that these recordings tell, how many of those that count are known and hold, and what is not told."""
    of_facts = [row for row in rows if "fact" in row]
    told = [row for row in of_facts if row["simulated_from"] == HERE or row["real"] is not None]
    shown = [
        {
            "fact": row["name"],
            "public": row["published"],
            "simulated": row["simulated"] if row["simulated_from"] == HERE else None,
            "compared": row["compared"] if row["simulated_from"] == HERE else None,
            "real": row["real"],
            "real_compared": row["real_compared"],
            "class": row["class"],
        }
        for row in told
    ]
    counted = [row for row in of_facts if row["counts"] is not None]
    within, near = (sum(row["compared"] == one for row in counted) for one in (WITHIN, NEAR))
    known = sum(row["compared"] is not None for row in counted)
    elsewhere = sum(row["not_told"] is None for row in of_facts) - len(told)
    lines = [
        f"These recordings tell {len(told)} facts, docs/results and constants {elsewhere} more (--json has them all);"
        " docs/likeness.md says what each is.",
        f"Of the {len(counted)} simulated facts that count, {known} are known: {within} within the published spread,"
        f" {near} more of the same sign and between half and twice.",
    ]
    if any(row["real"] is not None for row in told):
        lines.append("A real recording is taken for what each fact is about: who made it knows what was done.")
    reasons: dict[str, list[str]] = defaultdict(list)
    for row in of_facts:
        if row["not_told"]:
            reasons[row["not_told"]].append(row["name"])
    return shown, [*lines, *(f"Not told, as {why}: {', '.join(names)}." for why, names in reasons.items())]


def _told(path: Path) -> Told:
    from evetac_cli.evaluate.likeness import single_slice
    from evetac_cli.evaluate.likeness.counts import count
    from evetac_cli.evaluate.likeness.measures import measure

    with open_recording(path) as recording:
        header = recording.header
        simulated = bool(header["simulated"])
        scene = scene_words(header["parameters"], "name") if simulated else None
        called = header["parameters"].get("object")
        counts = count(recording)
        judged = counts.onset is not None and (scene is None or scene in SLIPS)
        about = {"file": path.name, "scene": scene, "object": called, "onset_ms": counts.onset}
        row = {**about, "real": not simulated, **measure(recording, counts)}
        return Told(row, simulated, scene, single_slice.slip(str(called or path.name), counts) if judged else None)


def _fact_row(fact: Fact, told: Iterable[Told], tables: ResultTables) -> Row:
    """What is told of a fact: by simulated recordings, or else by results or a constant; and by real recordings."""
    by_source: dict[bool, list[Told]] = defaultdict(list)
    for one in told:
        by_source[one.simulated].append(one)
    simulated, real = (_of_recordings(fact, by_source[source]) for source in (True, False))
    if not simulated.values and fact.table:
        simulated = tables.ours(fact)
    elif not simulated.values and fact.constant:
        simulated = Ours(constant_of(fact.constant), origin=f"{'.'.join(fact.constant)} as it is set")
    elif not simulated.values and not fact.measures:
        simulated = Ours(untold=f"it needs {fact.needs}" if fact.needs else "no command measures it")
    return {
        "counts": fact.counts,
        "name": fact.name,
        "fact": fact.fact,
        "public": fact.public,
        "published": fact.published,
        "class": fact.kind,
        "unit": fact.unit,
        "simulated": as_text(simulated.values) or None,
        "simulated_values": json.dumps(simulated.values),
        "simulated_n": simulated.n,
        "simulated_from": simulated.origin,
        "compared": fact.compare(simulated.values),
        "real": as_text(real.values) or None,
        "real_values": json.dumps(real.values),
        "real_n": real.n,
        "real_compared": fact.compare(real.values),
        "not_told": None if simulated.values or real.values else simulated.untold,
        "source": fact.source,
        "command": fact.command,
    }


def _of_recordings(fact: Fact, told: list[Told]) -> Ours:
    """The figures of a fact by recordings of one kind, simulated or real."""
    if not fact.measures:
        return Ours(untold=fact.needs)
    judged = _judged(told)
    values: list[float | None] = []
    numbers: list[int] = []
    for named in fact.measures:
        name, _, scene = named.partition("@")
        if name in judged:
            values.append(judged[name])
            numbers.append(sum(one.slip is not None for one in told))
            continue
        fitting = [one.row[name] for one in told if name in one.row and (not scene or one.scene in (None, scene))]
        values.append(None if not fitting else _middle(name, fitting))
        numbers.append(len(fitting))
    if all(value is None for value in values):
        pairs = [named.partition("@")[::2] for named in fact.measures]
        scenes = sorted({scene for name, scene in pairs if scene and any(name in one.row for one in told)})
        if scenes:  # it was measured, but of a simulation that shows something else
            return Ours(untold=f"no simulated recording here is of the scene {' or '.join(scenes)}")
        return Ours(untold=f"these recordings do not have {fact.needs}")
    return Ours(tuple(values), min(number for number in numbers if number), HERE)


def _judged(told: list[Told]) -> Row:
    """How well one threshold tells the slips of recordings; empty where they are of one object."""
    from evetac_cli.evaluate.likeness.single_slice import judge

    return judge([one.slip for one in told if one.slip is not None])


def _middle(name: str, values: list[float]) -> float:
    return float(np.mean(values) if name.startswith(SHARES) else np.median(values))


def _summary(rows: Rows, told: list[Told]) -> Row:
    """How many recordings there were, how many facts are told, and how many that count compare in each way."""
    counted = [row for row in rows if row["counts"] is not None]
    return {
        "recordings": len(told),
        "facts": len(rows),
        "facts_told": sum(row["not_told"] is None for row in rows),
        "counted": len(counted),
        "counted_known": sum(row["compared"] is not None for row in counted),
        "counted_within": sum(row["compared"] == WITHIN for row in counted),
        "counted_half_to_twice": sum(row["compared"] == NEAR for row in counted),
        **_judged([one for one in told if one.simulated]),
    }


STAGE = Stage(jobs, run, for_people=for_people)
