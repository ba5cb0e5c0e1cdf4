"""evaluate likeness: what recordings, simulated or real, show for each public fact about the sensor.

There is a row per fact, in the order of docs/evidence/likeness.md: the public figure, the figures of simulated and of
real recordings, and how both compare. If there is no figure, the row states what is needed for one, such as trainings
or grasps; docs/evidence/likeness.md has those of evetac. Then there is a row per recording with all its measures.
`_values` are the figures as a JSON list, because a fact may have several.

Kernels are imported where they are called, so that a report that is up to date loads none.

For simulated recordings, a measure that belongs to a scene is taken only from recordings of this scene. For real
recordings only the person who recorded them knows the motions, so all are used. Shares of a data rate are averaged over
recordings, as in the paper; all other measures are medians.
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
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.evaluate.common.report import report, report_job
from evetac_cli.evaluate.common.rows import each
from evetac_cli.evaluate.data_rate.measure import headers_beside
from evetac_cli.evaluate.likeness import EvaluateLikeness
from evetac_cli.evaluate.likeness.facts import (
    NEAR,
    WITHIN,
    Fact,
    Ours,
    as_text,
    constant_of,
    facts,
)
from evetac_cli.jobs import Job, Outcome, Progress, Row, Rows, Stage, silent
from evetac_cli.store.layout.ancestry import scene_words
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings.read import open_recording

if TYPE_CHECKING:
    from evetac_cli.evaluate.likeness.measures import Slip

METHOD = 3
SLIPS = ("slip", "slip-varied")  # scenes whose slips are used to evaluate the single threshold
HERE = "these recordings"  # origin of a figure
SHARES = "share_"  # prefix of measures that are averaged, as in the paper


@dataclass(frozen=True)
class MeasuredRecording:
    """The measures of a recording, its scene, None if unknown, and its slip, if any."""

    row: Row
    simulated: bool
    scene: str | None
    slip: "Slip | None"


def jobs(files: list[Path], params: EvaluateLikeness, out: Path | None) -> list[Job]:
    """Return one report job over all recordings."""
    return report_job(files, "likeness", out)


def run(job: Job, params: EvaluateLikeness, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return a row per fact, then a row per recording."""
    parents: list[Header] = []
    for path in job.inputs:
        with open_recording(path) as recording:
            parents += headers_beside(recording)
    listed = hashlib.sha256((resources.DATA / "likeness.toml").read_bytes()).hexdigest()
    parameters = {**recipe_of(params), "facts": listed}

    def measured() -> tuple[Rows, dict[str, Any]]:
        recordings = [_measured_recording(path) for path in each(job.inputs, progress)]
        rows = [_fact_row(fact, recordings) for fact in facts()]
        return [*rows, *(one.row for one in recordings)], _summary(rows, recordings)

    return report(job, "evaluate likeness", METHOD, parameters, parents, measured, force=force)


def for_people(rows: Rows, params: EvaluateLikeness) -> tuple[Rows, list[str]]:
    """Return the facts that these recordings can check, and sentences.

    The sentences state how many of the counted facts are known and agree, and why the others are unknown.
    """
    of_facts = [row for row in rows if "fact" in row]
    checkable = [row for row in of_facts if row["simulated_from"] == HERE or row["real"] is not None]
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
        for row in checkable
    ]
    counted = [row for row in of_facts if row["counts"] is not None]
    within, near = (sum(row["compared"] == one for row in counted) for one in (WITHIN, NEAR))
    known_count = sum(row["compared"] is not None for row in counted)
    elsewhere = sum(row["not_measured"] is None for row in of_facts) - len(checkable)
    lines = [
        f"These recordings provide {len(checkable)} facts, constants {elsewhere} more (--json lists all);"
        " docs/evidence/likeness.md explains each.",
        f"Of the {len(counted)} counted facts, {known_count} are known in simulation: {within} within the published"
        f" spread, {near} more of the same sign and between half and twice the published figure.",
    ]
    if any(row["real"] is not None for row in checkable):
        lines.append("Real recordings are assumed to show the motions of each fact; only their author can check this.")
    reasons: dict[str, list[str]] = defaultdict(list)
    for row in of_facts:
        if row["not_measured"]:
            reasons[row["not_measured"]].append(row["name"])
    return shown, [*lines, *(f"Unknown, because {why}: {', '.join(names)}." for why, names in reasons.items())]


def _measured_recording(path: Path) -> MeasuredRecording:
    from evetac_cli.evaluate.likeness.measures import count, measure, slip

    with open_recording(path) as recording:
        header = recording.header
        simulated = bool(header["simulated"])
        scene = scene_words(header["parameters"], "name") if simulated else None
        called = header["parameters"].get("object")
        counts = count(recording)
        judged = counts.onset is not None and (scene is None or scene in SLIPS)
        about = {"file": path.name, "scene": scene, "object": called, "onset_ms": counts.onset}
        row = {**about, "real": not simulated, **measure(recording, counts)}
        return MeasuredRecording(row, simulated, scene, slip(str(called or path.name), counts) if judged else None)


def _fact_row(fact: Fact, measured: Iterable[MeasuredRecording]) -> Row:
    """Return the row of a fact: figures of simulated recordings, or else of a constant; and of real ones."""
    by_source: dict[bool, list[MeasuredRecording]] = defaultdict(list)
    for one in measured:
        by_source[one.simulated].append(one)
    simulated, real = (_of_recordings(fact, by_source[source]) for source in (True, False))
    if not simulated.values and fact.constant:
        simulated = Ours(constant_of(fact.constant), origin=f"{'.'.join(fact.constant)} as it is set")
    elif not simulated.values and not fact.measures:
        simulated = Ours(not_measured=f"it needs {fact.needs}" if fact.needs else "no command measures it")
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
        "not_measured": None if simulated.values or real.values else simulated.not_measured,
        "source": fact.source,
        "command": fact.command,
    }


def _of_recordings(fact: Fact, measured: list[MeasuredRecording]) -> Ours:
    """Return the figures of a fact from recordings of one kind, simulated or real."""
    if not fact.measures:
        return Ours(not_measured=fact.needs)
    judged = _judged(measured)
    values: list[float | None] = []
    numbers: list[int] = []
    for entry in fact.measures:
        name, _, scene = entry.partition("@")
        if name in judged:
            values.append(judged[name])
            numbers.append(sum(one.slip is not None for one in measured))
            continue
        fitting = [one.row[name] for one in measured if name in one.row and (not scene or one.scene in (None, scene))]
        values.append(None if not fitting else _middle(name, fitting))
        numbers.append(len(fitting))
    if all(value is None for value in values):
        pairs = [entry.partition("@")[::2] for entry in fact.measures]
        scenes = sorted({scene for name, scene in pairs if scene and any(name in one.row for one in measured)})
        if scenes:  # measured, but only in simulations of other scenes
            return Ours(not_measured=f"no simulated recording here is of the scene {' or '.join(scenes)}")
        return Ours(not_measured=f"these recordings do not have {fact.needs}")
    return Ours(tuple(values), min(number for number in numbers if number), HERE)


def _judged(measured: list[MeasuredRecording]) -> Row:
    """Return how well one threshold detects the slips of recordings; empty if they are of one object."""
    from evetac_cli.evaluate.likeness.measures import judge

    return judge([one.slip for one in measured if one.slip is not None])


def _middle(name: str, values: list[float]) -> float:
    return float(np.mean(values) if name.startswith(SHARES) else np.median(values))


def _summary(rows: Rows, measured: list[MeasuredRecording]) -> Row:
    """Return the number of recordings and known facts, and how many of the counted facts compare in each way."""
    counted = [row for row in rows if row["counts"] is not None]
    return {
        "recordings": len(measured),
        "facts": len(rows),
        "facts_measured": sum(row["not_measured"] is None for row in rows),
        "counted": len(counted),
        "counted_known": sum(row["compared"] is not None for row in counted),
        "counted_within": sum(row["compared"] == WITHIN for row in counted),
        "counted_half_to_twice": sum(row["compared"] == NEAR for row in counted),
        **_judged([one for one in measured if one.simulated]),
    }


STAGE = Stage(jobs, run, for_people=for_people)
