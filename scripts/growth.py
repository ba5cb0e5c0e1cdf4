"""Measure how cost grows with events per slice, dots, slices, trajectories, workers, and files of a data set.

    python scripts/growth.py OUT.json events dots                # seconds
    python scripts/growth.py OUT.json slices --longest-min 60    # a recording of 1 s to 1 h: half an hour
    python scripts/growth.py OUT.json slices --stages export,import    # measures these again and keeps the others
    python scripts/growth.py OUT.json trajectories workers files
    python scripts/growth.py OUT.json --draw docs/growth.svg --page docs/cost.md     # all parts of OUT.json

Each part replaces its own rows in OUT.json and keeps the others. Times of a step are medians. Times of a command are
processor times, including the processes that it starts. Run it on a quiet computer. All of it is simulated.

- events: a step of the tracker, by preset, and of the detector of `grasp`, on events of the dots' rims.
- dots: a step of the default tracker, on square grids of 2 x 2 to 16 x 16 dots with 1,000 events per slice. The
  detector's network is left out, because it is made for one grid.
- slices: every stage by its default method, on the end of a trial repeated in time (attack/long_recording.py). The cost
  of a recording of 1 s is start-up and is subtracted. `over_linear` is the deviation of the rest from a linear
  extrapolation of the recording of 1 minute; it may be at most 0.1.
- trajectories, workers: record, label, track and featurize of compare_engines.py.
- files: data sets of 30 trials or more, with four real files each, made by the stages from one recording and copied
  with other recipe ids. Measured are the first index by all cores, the index again, one file more, and a command that
  has no work.
"""

import argparse
import json
import math
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Collection
from pathlib import Path
from statistics import fmean
from typing import TypedDict

import numpy as np
from attack.long_recording import Repeated
from compare_engines import STAGES, run_stage, write_scene
from data_set_cost import SEED, cpu_of, files
from made_tables import commit
from numpy.typing import NDArray
from results import put_measured

from evetac_cli.console import print_table
from evetac_cli.evaluate import picture
from evetac_cli.events import FRAME_PX, SLICES_PER_S, Events
from evetac_cli.jobs import Row
from evetac_cli.kernels.calibration.grid import MOST_DOTS
from evetac_cli.kernels.slip import features
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.resources import MODEL
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector


class Measured(TypedDict):
    """A part: its rows, and the commit at which they were measured."""

    commit: str
    rows: list[Row]


EVENTS = (0, 50, 200, 500, 1_000, 2_000, 5_000, 10_000, 20_000)
USUAL_EVENTS = 1_000
SIDES = (2, 3, 4, 6, 8, 10, 12, 14, 16)
DISTINCT = 400_000  # events in the slices that take turns; with few, their pixels would be hot and ignored
REPEAT, WARM_UP = 300, 20
BEFORE = {  # the stages whose files a stage reads, in addition to the recording
    "featurize": ("label", "track"), "evaluate labels": ("label",), "evaluate tracking": ("track",),
    "evaluate slip": ("label", "track", "featurize"), "import": ("export",),
}  # fmt: skip
LENGTHS_S = (1, 60, 600, 3600)
SLOPE = 1.1  # a minute must cost this many times as much as 1 s before it can predict the cost of an hour
TRAJECTORIES = (20, 60, 180)
MOST_OVER_LINEAR = 0.1


def grid_px(rows: int, columns: int) -> NDArray[np.float64]:
    """Return dots at rest that fill the gel, (rows, columns, 2)."""
    pitch_x, pitch_y = 540.0 / columns, 480.0 / rows
    x = pitch_x * (np.arange(columns) + 0.5)
    y = pitch_y * (np.arange(rows) + 0.5)
    return np.stack(np.meshgrid(x, y), axis=-1)


def rims(rng: np.random.Generator, rest: NDArray[np.float64], radius_px: float, count: int) -> Events:
    """Return events on the rims of dots at rest, with a blur of 0.7 px."""
    dots = rest.reshape(-1, 2)
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    away = (radius_px + 0.7 * rng.standard_normal(count))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    xy = np.clip(np.round(dots[rng.integers(0, len(dots), count)] + away), 0, np.array(FRAME_PX) - 1)
    x, y = xy.astype(np.uint16).T.copy()
    return Events(np.zeros(count, np.int64), x, y, rng.integers(0, 2, count, dtype=np.uint8))


def step_us(step: Callable[[Events], object], slices: list[Events]) -> float:
    """Return the median time of a step in us."""
    times = np.empty(REPEAT)
    for number in range(WARM_UP + REPEAT):
        events = slices[number % len(slices)]
        began = time.perf_counter_ns()
        step(events)
        times[max(number - WARM_UP, 0)] = time.perf_counter_ns() - began
    return float(np.median(times)) / 1e3


def tracking(rest: NDArray[np.float64], preset: str) -> Callable[[Events], object]:
    """Return a function that runs one step of the tracker."""
    state = tracker.start(rest.reshape(-1, 2), presets.PRESETS[preset])
    return lambda events: tracker.step(state, events.x, events.y, events.p)


def slices_of(rest: NDArray[np.float64], radius_px: float, count: int) -> list[Events]:
    rng = np.random.default_rng(0)
    return [rims(rng, rest, radius_px, count) for _ in range(min(400, DISTINCT // max(count, 1)))]


def events() -> list[Row]:
    """Return a row for every number of events and every tracker, and for the detector with the default tracker."""
    rest = grid_px(7, 8)
    rows: list[Row] = []
    for count in EVENTS:
        slices = slices_of(rest, 15.0, count)
        rows += [
            {"what": f"track {preset}", "events": count, "us": step_us(tracking(rest, preset), slices)}
            for preset in ("stable", "paper", "official")
        ]
        with StageFile(MODEL, "model") as model:
            detector = OnlineSlipDetector.start(model, rest, (540, 0, 640, 480), presets.PRESETS["stable"])
        rows.append({"what": "online step", "events": count, "us": step_us(detector.step, slices)})
    return rows


def dots() -> list[Row]:
    """Return a row for every grid: tracker, and tracker with features, at the same number of events."""
    rows: list[Row] = []
    for side in (side for side in SIDES if side * side <= MOST_DOTS):
        rest = grid_px(side, side)
        slices = slices_of(rest, min(15.0, 0.24 * 480 / side), USUAL_EVENTS)
        track_us = step_us(tracking(rest, "stable"), slices)
        history = features.start(rest.reshape(-1, 2), 10)
        moved, counted = rest.reshape(-1, 2) + 0.5, np.full(side * side, 10, np.int32)
        features_us = step_us(lambda _, h=history, m=moved, c=counted: features.step(h, m, c), slices)
        rows.append({"dots": side * side, "track_us": track_us, "features_us": features_us})
    return rows


# --- whole commands ---------------------------------------------------------------------------------------------------


def stage_commands(name: str) -> dict[str, tuple[str, ...]]:
    """Return the stages on a recording of this name, in an order in which each finds its inputs."""
    recording, rate = f"{name}.recording.h5", f"{name}-rate.report.h5"
    featured = f"{name}.features.h5"
    return {
        "label": ("label", recording),
        "track": ("track", recording),
        "featurize": ("featurize", recording),
        "track-rgb": ("track-rgb", recording),
        "evaluate labels": ("evaluate", "labels", f"{name}.labels.h5", "-o", f"{name}-labels.report.h5"),
        "evaluate tracking": ("evaluate", "tracking", f"{name}.tracks.h5", "-o", f"{name}-tracking.report.h5"),
        "evaluate slip": ("evaluate", "slip", featured, "--model", str(MODEL), "-o",
                          f"{name}-slip.report.h5"),
        "evaluate data-rate": ("evaluate", "data-rate", recording, "-o", rate),
        "trim": ("trim", recording, "--from-ms", "100", "-o", f"{name}-piece.recording.h5"),
        "validate": ("validate", recording),
        "export": ("export", "--format", "dsec", recording, "-o", f"{name}.dsec.h5"),
        "import": ("record", "--from", f"{name}.dsec.h5", "-o", f"{name}-import.recording.h5"),
    }  # fmt: skip


def slices(longest_s: int, events_a_slice: float, stages: Collection[str]) -> list[Row]:
    """Return a row for each stage and length; up to a minute, the mean of several runs, as start-up matters."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cpu_of("record", "--object", "2", "--seed", str(SEED), "-o", "trial.recording.h5", cwd=folder)
        with open_recording(folder / "trial.recording.h5") as trial:
            repeated = Repeated(trial, events_a_slice)
        lengths = [length for length in LENGTHS_S if length <= longest_s]
        short = [length for length in lengths if length <= 60]
        # Short recordings run again before and after every long one, because the speed of a computer varies over time.
        order = [*short * 2, *(length for longer in lengths[len(short) :] for length in (longer, *short * 2))]
        for length_s in order:
            rows += _stages(folder / str(length_s), repeated, length_s, stages)
            print(*rows[-len(stages) :], sep="\n", file=sys.stderr)
    return with_linear(means(rows))


def means(rows: list[Row]) -> list[Row]:
    """Return a row for every stage and length, with the mean processor time and the most memory of its runs."""
    turns: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        turns.setdefault((row["stage"], row["length_s"]), []).append(row)
    return [
        {
            "stage": stage,
            "length_s": length_s,
            "cpu_s": fmean(row["cpu_s"] for row in same),
            "memory_mb": max(row["memory_mb"] for row in same),
        }
        for (stage, length_s), same in sorted(turns.items(), key=lambda turn: turn[0][1])
    ]


def _stages(place: Path, repeated: Repeated, length_s: int, stages: Collection[str]) -> list[Row]:
    """Return a row for each stage on one recording, in a temporary folder."""
    place.mkdir()
    repeated.write(place / "long.recording.h5", SLICES_PER_S * length_s)
    rows: list[Row] = []
    before = {earlier for stage in stages for earlier in BEFORE.get(stage, ())}
    for stage, words in stage_commands("long").items():
        if stage in stages or stage in before:
            cpu_s, memory_mb = cpu_of(*words, cwd=place)
        if stage in stages:
            rows.append({"stage": stage, "length_s": length_s, "cpu_s": cpu_s, "memory_mb": memory_mb})
    shutil.rmtree(place)
    return rows


def with_linear(rows: list[Row]) -> list[Row]:
    """Return the rows with `over_linear`: the cost beyond that of 1 s, compared with the prediction from 1 minute.

    Stages whose minute costs hardly more than a second have none, because it would only show the scatter of start-up.
    """
    cpu = {(row["stage"], row["length_s"]): row["cpu_s"] for row in rows}
    for row in rows:
        first_s, minute_s = cpu[row["stage"], 1], cpu.get((row["stage"], 60))
        if row["length_s"] > 60 and minute_s is not None and minute_s > SLOPE * first_s:
            expected_s = (minute_s - first_s) * (row["length_s"] - 1) / 59
            row["over_linear"] = (row["cpu_s"] - first_s) / expected_s - 1
    return rows


def trajectories() -> list[Row]:
    """Measure the processor time of several numbers of trajectories, in one process."""
    return [_trajectories(count, "--jobs", "1") for count in TRAJECTORIES]


def workers() -> list[Row]:
    """Measure the wall-clock time of the same trajectories with one process, up to as many as there are cores."""
    return [_trajectories(TRAJECTORIES[1], "--jobs", str(jobs)) for jobs in range(1, (os.cpu_count() or 1) + 1)]


def _trajectories(count: int, *engine: str) -> Row:
    with tempfile.TemporaryDirectory() as name:
        write_scene(Path(name) / "tiny.toml")
        before, began = sum(os.times()[2:4]), time.perf_counter()
        for stage in STAGES:
            run_stage(stage, Path(name) / "made", count, *engine)
        return {"trajectories": count, "engine": " ".join(engine), "took_s": time.perf_counter() - began,
                "cpu_s": sum(os.times()[2:4]) - before}  # fmt: skip


# --- the picture ------------------------------------------------------------------------------------------------------


def draw(measured: dict[str, list[Row]], path: Path) -> None:
    """Draw a panel for every part, with logarithmic axes except for workers, in the style of the figures in reports."""
    import matplotlib
    from matplotlib.figure import Figure

    # column on the x axis, column that names a line, plotted columns with their labels, axis labels
    lines: dict[str, tuple[str, str | None, dict[str, str], str, str]] = {
        "events": ("events", "what", {"us": ""}, "events a slice", "time of a step [us]"),
        "dots": ("dots", None, {"track_us": "track", "features_us": "features"}, "dots", "time of a step [us]"),
        "slices": ("length_s", "stage", {"cpu_s": ""}, "length of the recording [s]", "processor time [s]"),
        "trajectories": ("trajectories", None, {"cpu_s": "four stages"}, "trajectories", "processor time [s]"),
        "workers": ("engine", None, {"took_s": "four stages"}, "workers", "time on the clock [s]"),
        "files": (
            "files",
            None,
            {
                "index_cpu_s": "index",
                "again_cpu_s": "index again",
                "nothing_to_do_cpu_s": "nothing to do",
            },
            "files",
            "processor time [s]",
        ),
    }
    shown = [part for part in lines if part in measured]
    # the fixed salt gives the same SVG for the same figures
    with matplotlib.rc_context({**picture.STYLE, "svg.hashsalt": "growth"}):
        rows_of_panels = math.ceil(len(shown) / 3)
        figure = Figure(figsize=(14.0, 0.4 + 4.4 * rows_of_panels), layout="constrained")
        places = figure.subfigures(rows_of_panels, math.ceil(len(shown) / rows_of_panels), squeeze=False).ravel()
        for place, part in zip(places, shown, strict=False):  # each with its own legend
            axes = place.subplots()
            across, group, values, *words = lines[part]
            number = 0
            for name in dict.fromkeys(row[group] for row in measured[part]) if group else (None,):
                chosen = [row for row in measured[part] if group is None or row[group] == name]
                for value, label in values.items():
                    drawn = [(row[across], row[value]) for row in chosen]
                    axes.plot(*zip(*drawn, strict=True), label=name or label, **picture.series(number))
                    number += 1
            axes.set(xlabel=words[0], ylabel=words[1])
            if part == "events":
                axes.set_xscale("symlog", linthresh=50)
                axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
            elif part != "workers":
                picture.log_axis(axes.xaxis)
            if part != "workers":
                picture.log_axis(axes.yaxis)
            else:
                axes.set_ylim(0, None)
            picture.legend(place, [axes])
        figure.suptitle("How cost grows (simulated)")
        figure.savefig(path, format="svg", metadata={"Date": None})


def replaced(rows: list[Row], new: list[Row]) -> list[Row]:
    """Return the rows of all stages, with those measured again replaced, sorted by length and stage."""
    by_place = {(row["length_s"], row["stage"]): row for row in (*rows, *new)}
    order = list(stage_commands(""))
    return [by_place[place] for place in sorted(by_place, key=lambda place: (place[0], order.index(place[1])))]


def said(of: Measured) -> str:
    """State by which commit a table was measured, and which stages were measured later."""
    later: dict[str, list[str]] = {}
    for row in of["rows"]:
        if "commit" in row and row["stage"] not in later.setdefault(row["commit"], []):
            later[row["commit"]].append(row["stage"])
    again = "".join(f"; {', '.join(stages)} at commit {name}" for name, stages in later.items())
    return f"Simulated, by growth.py at commit {of['commit']}{again}"


def spread(part: str, rows: list[Row]) -> list[Row]:
    """Return rows for a page: one for each stage or number of events, with the varied quantity in columns."""
    if part == "events":
        by_count: dict[int, Row] = {}
        for row in rows:
            by_count.setdefault(row["events"], {"events a slice": row["events"]})[f"{row['what']} [us]"] = row["us"]
        return list(by_count.values())
    if part == "slices":
        by_stage: dict[str, Row] = {}
        for row in rows:
            shown = by_stage.setdefault(row["stage"], {"stage": row["stage"]})
            shown[f"{row['length_s']} s"] = row["cpu_s"]
            if "over_linear" in row:
                shown[f"over linear at {row['length_s']} s"] = f"{row['over_linear']:+.1%}"
        return list(by_stage.values())
    return rows


def main() -> int:
    """Read the flags, measure the requested parts, and store them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts: dict[str, Callable[[], list[Row]]] = {
        "events": events,
        "dots": dots,
        "trajectories": trajectories,
        "workers": workers,
        "files": lambda: files(chosen.most_trials),
    }
    parser.add_argument("out", type=Path, help="JSON file: part -> commit and rows")
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"slices, {', '.join(parts)}")
    parser.add_argument(
        "--longest-min", type=float, default=60.0, help="longest recording of `slices`; lengths are 1 s to 1 h"
    )
    parser.add_argument("--events-a-slice", type=float, default=50.0, help="least events per slice in `slices`")
    parser.add_argument(
        "--stages", help="only these stages of `slices`, comma-separated; each needs files of earlier ones"
    )
    parser.add_argument(
        "--most-trials", type=int, default=1_000, help="largest data set of `files`; 3.6 MB and 0.1 s per trial"
    )
    parser.add_argument("--draw", type=Path, help="draw all parts of OUT")
    parser.add_argument("--page", type=Path, help="put tables of all parts of OUT into this page")
    chosen = parser.parse_args()
    wrong = [part for part in chosen.parts if part not in (*parts, "slices")]
    if wrong:
        parser.error(f"there is no part {', '.join(wrong)}; choose from slices, {', '.join(parts)}")
    measured: dict[str, Measured] = json.loads(chosen.out.read_text()) if chosen.out.exists() else {}
    known = list(stage_commands(""))
    stages = chosen.stages.split(",") if chosen.stages else known
    if set(stages) - set(known):
        parser.error(f"--stages: choose from {', '.join(known)}")
    for part in chosen.parts:
        longest_s = round(60 * chosen.longest_min)
        rows = slices(longest_s, chosen.events_a_slice, stages) if part == "slices" else parts[part]()
        if part == "slices" and part in measured and chosen.stages:
            again = [{**row, "commit": commit()[0]} for row in rows]
            measured[part]["rows"] = replaced(measured[part]["rows"], again)
        else:
            measured[part] = {"commit": commit()[0], "rows": rows}
        chosen.out.write_text(json.dumps(measured, indent=1) + "\n")
        print_table(part, rows, {}, simulated=True)
    if chosen.draw:
        draw({part: of["rows"] for part, of in measured.items()}, chosen.draw)
    if chosen.page:
        for part, of in measured.items():
            put_measured(chosen.page, part, spread(part, of["rows"]), said(of))
    lengths = measured["slices"]["rows"] if "slices" in measured else []
    over = [row for row in lengths if abs(row.get("over_linear", 0.0)) > MOST_OVER_LINEAR]
    for row in over:
        print(f"not linear: {row['stage']}, {row['length_s']} s: {row['over_linear']:+.0%}", file=sys.stderr)
    return bool(over)


if __name__ == "__main__":
    sys.exit(main())
