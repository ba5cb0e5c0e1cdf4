"""Measure the effect of each part of a sensor or a scene on each stage: the same slips and grasps with and without it.

    make part-effects                                       # continues where it was stopped
    make part-effects SIZES="slips=0 grasps=0"              # the table of the existing trials
    python scripts/reproduce/run.py --only part-effects --size seed=0 --size slips=3 --size "parts=leak,slow pixels"

Every part is added alone to the quiet sensor `evetac` in the scenes `slip` (objects 2, 8, 14 in turn) and `lift` (11,
12, 17). Its size is the worse end of the range of `--sensor randomized`, or that of the docs. A part that needs another
part is compared with that one alone.

Every slip is labelled, tracked, featurized and evaluated by the pretrained detector, with the default methods. A grasp
uses the paper's controller. A trial is a line of data/part-effects/effects.jsonl; trials that already have a line are
not run again.

All figures are averages over the trials, against the truth of the same simulation:

- events_ms and tracking_px (root mean square over all dots), up to gross slip;
- the share of trials with the labels' onset -4 to +3 ms from the true one, and the F1 of the labelled slices;
- the share with the first detection -50 to +20 ms from the true onset, and the F1 of the detected slices;
- microseconds of processor time per slice of a slip, to simulate it, and to label, track, featurize and evaluate it;
- how many grasps hold, and how far their object moves.

The 95 % intervals of changes are a bootstrap over the pairs of trials; with fewer than about ten pairs they are too
narrow.
"""

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.record import Record
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.evaluate.labels.measure import EARLIEST_MS, LATEST_MS
from evetac_cli.jobs import Row, silent
from evetac_cli.kernels.slip import metrics
from evetac_cli.kernels.slip.metrics import shift_labels
from evetac_cli.sim.setup.scene_file import changed
from evetac_cli.stages import label, label_methods
from evetac_cli.store.files import StageFile, output_path
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.text_files import as_toml
from evetac_cli.trials import grasp, record
from evetac_cli.trials.grasp import simulated as simulated_grasp
from evetac_cli.trials.trial import SimulatedTrial
from scripts.reproduce.experiment import Experiment, Study, measured
from scripts.reproduce.facts import commit_in_words
from scripts.reproduce.steps import Sizes
from scripts.reproduce.tables import Evaluation, Evaluations
from scripts.studies.parts.chain import chain_of, package_model, prediction, timed
from scripts.studies.rows import add_rows, rows_in

# A figure of parts/effects.py: heading and format of its cells.
PART_FIGURES = {
    "events_ms": ("events per ms", ".1f"),
    "tracking_px": ("tracking error [px]", ".3f"),
    "labels_in_time": ("labels in time", ".2f"),
    "labels_f1": ("F1 of labels", ".2f"),
    "slip_in_time": ("slip detected in time", ".2f"),
    "slip_f1": ("F1 of detector", ".2f"),
    "record_us": ("time to simulate [us per slice]", ".0f"),
    "rest_us": ("time to label, track, featurize and evaluate [us per slice]", ".0f"),
    "held": ("grasps held", ".2f"),
    "moved_mm": ("object moved in a grasp [mm]", ".2f"),
}
PART_EFFECTS = measured(
    "part-effects",
    "Effect of each part on each stage, {slips} slips and {grasps} grasps with each",
    ("part", "{part}"),
    ("size", "{size}"),
    *(
        (heading, f"{{{name}:{form}}}, {{{name}_low:+{form}}} to {{{name}_high:+{form}}}")
        for name, (heading, form) in PART_FIGURES.items()
    ),
    notes=(
        "A figure is followed by the 95 % interval of its change (bootstrap over pairs of trials) if the interval"
        " excludes 0. With fewer than some ten pairs the interval is too narrow, and one in 20 figures would have one"
        " by chance. Run times are processor times, measured while other work ran.",
    ),
)
NONE = "none"
SLIPPED, GRASPED = (2, 8, 14), (11, 12, 17)  # objects, in turn
RESAMPLES = 2000
LIFT_S, BALANCE_S = 3.5, 0.5  # of a grasp: the hand reaches 50 mm, the least that counts as held, after 3.1 s
LEAST_PAIRS = 3  # fewest pairs of trials for the interval of a change


@dataclass(frozen=True)
class Part:
    """A part's additions to a scene's tables and a sensor's row, and the part that it is compared with."""

    name: str
    size: str  # its size, in words
    scene: Row = field(default_factory=dict)
    sensor: Row = field(default_factory=dict)
    against: str = NONE
    slips: bool = True  # False: the part has no effect in a slip trial


SLOW = {"bandwidth_hz": 600.0}
BY_LIGHT = {**SLOW, "bandwidth_by_light": True}
PARTS = (
    Part(NONE, "the sensor evetac"),
    Part("creep", "10 % in 0.3 s and in 5 s", sensor={"creep": {"share": [0.1, 0.1], "time_s": [0.3, 5.0]}}),
    Part("friction that varies", "by 20 % over 3 mm", sensor={"friction": {"patch_spread": 0.2, "patch_mm": 3.0}}),
    Part(
        "second finger",
        "friction x 0.8, stiffness x 1.2",
        {"gripper": {"second_finger": {"friction_factor": 0.8, "stiffness_factor": 1.2}}},
    ),
    Part(
        "vibration of the hand",
        "0.5 m/s2 at 18 Hz, 0.2 at 41 Hz",
        {"hand": {"vibration": {"acceleration_m_s2": [0.5, 0.2], "frequency_hz": [18.0, 41.0]}}},
    ),
    Part("hand in an s-curve", "not a trapezoid of speed", {"hand": {"profile": "s-curve"}}, slips=False),
    Part("hand in steps", "of 8 ms", {"hand": {"profile": "steps"}}, slips=False),
    Part("encoder noise", "0.7 ticks", {"gripper": {"encoder_noise_ticks": 0.7}}, slips=False),
    Part("late commands", "by 8 to 12 ms", {"gripper": {"command_delay_ms": 8.0, "command_jitter_ms": 4.0}}),
    Part("backlash", "3 ticks", {"gripper": {"backlash_ticks": 3.0}}),
    Part("less gear friction", "x 0.7", {"gripper": {"friction_factor": 0.7}}, slips=False),
    Part("more gear friction", "x 1.3", {"gripper": {"friction_factor": 1.3}}, slips=False),
    Part("OFF threshold of its own", "1.25 of that of ON", sensor={"threshold_off": 0.25}),
    Part("high thresholds", "0.35, not 0.2", sensor={"threshold": 0.35}),
    Part("uneven thresholds", "by 8 %, not 3 %", sensor={"mismatch": 0.08}),
    Part("limit of the readout", "0.1 million events per second", sensor={"readout": {"events_per_s": 1e5}}),
    Part("slow pixels", "600 Hz", sensor=SLOW),
    Part("bandwidth by light", "on top of slow pixels", sensor=BY_LIGHT, against="slow pixels"),
    Part(
        "uneven light", "50 %, on top of both", sensor={**BY_LIGHT, "light_gradient": 0.5}, against="bandwidth by light"
    ),
    Part("blind pixels", "1 ms after an event", sensor={"refractory_us": 1000.0}),
    Part("leak", "0.1 Hz a pixel", sensor={"leak_hz": 0.1}),
    Part("noise", "0.11 Hz a pixel, not 0.03", sensor={"noise_hz": 0.11}),
    Part("hot pixels", "400, not 6", sensor={"hot_pixels": 400}),
    Part("noise filter", "100 ms", sensor={"noise_filter": {"support_ms": 100.0}}),
    Part(
        "dots that differ",
        "radius by 6 %, contrast by 15 %",
        sensor={"dot_radius_spread": 0.06, "dot_contrast_spread": 0.15},
    ),
    Part("lens", "k1 -0.05", sensor={"distortion": [-0.05, 0.0]}),
    Part("light that flickers", "by 5 % at 100 Hz", {"light": {"flicker": {"depth": 0.05, "frequency_hz": 100.0}}}),
    Part("light that steps", "to a half at 1 s", {"light": {"step": {"at_s": 1.0, "factor": 0.5}}}),
    Part(
        "calibration that is off", "3, -1 px and 1 deg", {"calibration": {"offset_px": [3.0, -1.0], "turned_deg": 1.0}}
    ),
)
BY_NAME = {part.name: part for part in PARTS}


def planned(part: Part, kind: str, object_: int, seed: int, folder: Path) -> tuple[SimulatedTrial, Any]:
    """Return the trial with a part, from the files of a scene and a sensor, and the parameters of its stage."""
    files = {"scene": changed(kind, part.scene), "sensor": as_toml({"like": "evetac", **part.sensor})}
    for name, text in files.items():
        (folder / f"{name}.toml").write_text(text)
    chosen: Row = {name: str(folder / f"{name}.toml") for name in files} | {"objects": str(object_), "seed": seed}
    stage: Any = record
    params: Any = Record(**chosen)
    if kind == "lift":
        stage, params = (
            grasp,
            Grasp(**chosen, controller="paper", model=Path("shipped"), lift_s=LIFT_S, balance_s=BALANCE_S),
        )
    (made,) = stage.jobs([], params, folder)
    return made, params


def slip(part: Part, object_: int, seed: int, folder: Path) -> Row:
    """Return the figures of one slip; onsets in slices from the start of the recording, None if there is none."""
    made, _ = planned(part, "slip", object_, seed, folder)
    chain = chain_of(made)
    truth_ms, stop = chain.gross_slip_ms, chain.gross_slip_ms
    with open_recording(made.output) as recording:
        events = np.diff(recording.starts)[:stop]
        true = label_methods.from_truth(recording, metrics.F1_CUT_MS)
    with StageFile(output_path(made.output, "labels", None), "labels") as labels:
        labelled: NDArray[np.int8] = labels.read("label")
    predicted = prediction(output_path(made.output, "features", None))
    model = package_model()
    known = np.where(np.isnan(predicted.probability), np.int8(-1), shift_labels(true.label, model.horizon_ms))
    detector = metrics.counts(known, predicted.detected(model.threshold), true.onset)
    apart_px = (chain.dot_xy_px - chain.true_dot_xy_px)[:stop]
    first_ms = -1 if chain.detection_ms is None else chain.detection_ms
    return {
        "t_s_ms": truth_ms,
        "label_ms": chain.label_ms,
        "detection_ms": chain.detection_ms,
        "events_ms": float(events.mean()),
        "tracking_px": float(np.sqrt((apart_px**2).sum(-1).mean())),
        "labels_in_time": truth_ms is not None
        and chain.label_ms is not None
        and EARLIEST_MS <= chain.label_ms - truth_ms <= LATEST_MS,
        "slip_in_time": truth_ms is not None and metrics.timing(first_ms, truth_ms) == "correct",
        "labels_counts": list(metrics.counts(true.label, labelled == 1, true.onset)),
        "slip_counts": list(detector),
        "record_us": chain.record_us,
        "rest_us": chain.chain_us - chain.record_us,
    }


def lift(part: Part, object_: int, seed: int, folder: Path) -> Row:
    """Return the outcome of one grasp."""
    made, params = planned(part, "lift", object_, seed, folder)
    outcome, seconds = timed(lambda: simulated_grasp.run(made, params, force=False, progress=silent))
    (row,) = outcome.rows
    return {
        "held": bool(row["balanced"]),
        "moved_mm": float(row["moved_mm"]),
        "grasp_us": 1e6 * seconds / row["slices"],
    }


def identity(row: Row) -> tuple[Any, ...]:
    """Return the fields that identify a trial; `size` is one of them, so another size of a part is another trial."""
    return tuple(row[name] for name in ("part", "size", "kind", "object", "seed"))


def trials(sizes: Sizes) -> Iterator[Row]:
    """Return the requested trials; for each seed, one part after the other."""
    for kind, count, objects in (("slip", sizes["slips"], SLIPPED), ("lift", sizes["grasps"], GRASPED)):
        for number in range(count):
            for part in named(sizes["parts"]):
                if part.slips or kind == "lift":
                    what = {"part": part.name, "size": part.size, "kind": kind}
                    yield {**what, "object": objects[number % len(objects)], "seed": sizes["seed"] + number}


def named(names: Sequence[str]) -> list[Part]:
    """Return the parts of these names and the parts that they are compared with; all parts if no name is given."""
    if wrong := set(names) - set(BY_NAME):
        raise InputError("no such part", where="--size parts", expected=", ".join(BY_NAME), found=", ".join(wrong))
    wanted = [BY_NAME[name] for name in names] if names else list(PARTS)
    while others := {part.against for part in wanted} - {part.name for part in wanted}:
        wanted += [BY_NAME[name] for name in others]
    return sorted(wanted, key=PARTS.index)


def run(row: Row) -> Row:
    """Run one trial in a folder of its own; if a stage refuses it, the reason replaces the figures."""
    made = slip if row["kind"] == "slip" else lift
    with tempfile.TemporaryDirectory() as folder:
        try:
            return {**row, **made(BY_NAME[row["part"]], row["object"], row["seed"], Path(folder))}
        except EvetacError as error:  # a part that a stage does not support is also a result
            return {**row, "refused": str(error)}


def source(name: str) -> str:
    """Return the part of a trial's line from which a figure is computed."""
    return name.replace("_f1", "_counts")


def has_figure(name: str, row: Row) -> bool:
    """Whether a trial has the values from which a figure is computed."""
    return row.get(source(name)) is not None


def figure(name: str, rows: list[Row]) -> float | None:
    """Return a figure over trials: F1 of all slices, median of run times, otherwise the mean; None if no trial has it.

    Run times use the median because the first trial of a process also loads compiled code.
    """
    if name.endswith("_f1"):
        counted = [row[source(name)] for row in rows if has_figure(name, row)]
        return metrics.Counts(*(sum(column) for column in zip(*counted, strict=True))).f1 if counted else None
    values = [float(row[name]) for row in rows if has_figure(name, row)]
    if not values:
        return None
    return float(np.median(values) if name.endswith("_us") else np.mean(values))


def change(name: str, pairs: list[tuple[Row, Row]]) -> Row:
    """Return the increase of a figure by the part, over pairs of trials with and without it, and its interval."""

    def more(chosen: Iterable[tuple[Row, Row]]) -> float:
        own, theirs = (figure(name, list(rows)) for rows in zip(*chosen, strict=True))
        assert own is not None and theirs is not None
        return own - theirs

    rng = np.random.default_rng(0)
    resampled = (rng.integers(len(pairs), size=len(pairs)) for _ in range(RESAMPLES))
    low, high = np.percentile([more(pairs[one] for one in chosen) for chosen in resampled], (2.5, 97.5))
    return {"more": more(pairs), "low": float(low), "high": float(high)}


def tables(rows: list[Row]) -> tuple[list[Row], list[Row]]:
    """Return the figures of each part, and every change against its reference."""
    figures, changes = [], []
    for part in PARTS:
        if not (own := of_part(rows, part)):
            continue
        kinds = [row["kind"] for row in own]
        shown: Row = {"part": part.name, "size": part.size, "slips": kinds.count("slip"), "grasps": kinds.count("lift")}
        shown["refused"] = sum("refused" in row for row in own)
        for name in PART_FIGURES:
            shown[name] = figure(name, own)
            theirs = {pair(row): row for row in of_part(rows, BY_NAME[part.against]) if has_figure(name, row)}
            both = [(row, theirs[pair(row)]) for row in own if has_figure(name, row) and pair(row) in theirs]
            if part.name != NONE and len(both) >= LEAST_PAIRS:
                what = {"part": part.name, "against": part.against, "figure": name, "trials": len(both)}
                changes.append({**what, **change(name, both)})
        figures.append(shown)
    return figures, changes


def of_part(rows: list[Row], part: Part) -> list[Row]:
    """Return the trials with a part at its present size."""
    return [row for row in rows if (row["part"], row["size"]) == (part.name, part.size)]


def pair(row: Row) -> tuple[Any, ...]:
    """Return the fields that a trial with a part shares with the same trial without it."""
    return row["kind"], row["object"], row["seed"]


def sure(changes: Iterable[Row]) -> list[Row]:
    """Return the changes whose interval excludes 0."""
    return [row for row in changes if row["low"] > 0.0 or row["high"] < 0.0]


def evaluation(rows: list[Row]) -> Evaluation:
    """Return the figures of each part, with intervals of changes that exclude 0; the file has every change."""
    figures, changes = tables(rows)
    certain = {(row["part"], row["figure"]): row for row in sure(changes)}
    for row in figures:
        for name in PART_FIGURES:
            one = certain.get((row["part"], name))
            row |= {f"{name}_low": one and one["low"], f"{name}_high": one and one["high"]}
    commits = sorted({row["commit"] for row in rows})
    counts = {"trials": len(rows), "slips": figures[0]["slips"], "grasps": figures[0]["grasps"]}
    about = {
        "made": f"commit {', '.join(commits)}",
        "commit": ", ".join(commits),
        "uncommitted_changes": any("uncommitted" in one for one in commits),
        "methods": {"record": record.METHOD, "label": label.METHOD, "grasp": grasp.METHOD},
        "recipe_ids": [package_model().header["id"]],
        "sizes": {**counts, "recording_seeds": sorted({row["seed"] for row in rows})},
        "changes": changes,
    }
    return Evaluation(figures, {}, simulated=True, about=about)


def measure(sizes: Sizes, folder: Path, jobs: int) -> Evaluations:
    """Run the missing trials in parallel; return the figures of all existing trials."""
    path = folder / "effects.jsonl"
    rows = rows_in(path)
    done, made_by = {identity(row) for row in rows}, {"commit": commit_in_words()}
    missing = [row for row in trials(sizes) if identity(row) not in done]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for future in as_completed([pool.submit(run, row | made_by) for row in missing]):
            rows.append(future.result())
            add_rows(path, rows[-1:])
    if not rows:
        raise InputError("no trials", where=str(path), expected="--size slips or grasps above 0")
    return {"part-effects": evaluation(rows)}


STUDY = Study(
    experiments=(
        Experiment(
            "part-effects", "effect of each part of a sensor or a scene on each stage", "data/part-effects", 1.0,
            full={"seed": 20_000, "slips": 15, "grasps": 9, "parts": ()},
            small={"slips": 3, "grasps": 0, "parts": ("leak",)},
            measure=measure,
            tables=(PART_EFFECTS,),
        ),
    ),
    checks={"part-effects": "not frozen: a tenth of its pairs of trials has no interval"},
)  # fmt: skip
