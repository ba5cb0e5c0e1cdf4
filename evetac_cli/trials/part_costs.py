"""The cost per slice of the parts of a simulated scene on this machine, measured on the first slices of a trial.

Optional parts are measured with and without, alternately. Gel, gripper, camera and the slip detector of a grasp are
measured by a timer of their calls, which is passed to the trial. The trial is the same every time, so the fastest run
of each stretch counts, which leaves out other load on the machine. Only the time of this thread counts, without writing
the file.
"""

import math
import textwrap
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from time import thread_time
from typing import Any, TypeVar

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.events import SLICES_PER_S, Events
from evetac_cli.jobs import Outcome, Progress, silent
from evetac_cli.sim.setup.parts import CAMERA, DOTS, Call, Timer, rows_of, switched
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.trials.trial import SimulatedTrial, grid_notes

REPEATS = 3  # most repeats
BUDGET_S = 3.0  # total time of the runs; a slow scene is measured on fewer slices
MOVING_S = 0.5  # measured duration of a trial once something moves
BLOCK = 50  # slices that are timed together: the fastest run of each counts
SHOWN = 40  # letters of the values of a part that a terminal shows
MOST_FILES = 5  # most files that a plan with devices lists on a terminal
SURE = 2.0  # a difference below this many standard errors of its mean over the blocks is noise

Append = Callable[[Events, dict[str, Any]], None]
SomeTrial = TypeVar("SomeTrial", bound=SimulatedTrial)
Play = Callable[[SomeTrial, Append, Timer], Any]  # runs the trial and passes on every slice and its rows


@dataclass(frozen=True)
class PartCosts:
    """Microseconds per slice of a trial, each from the fastest of its runs.

    parts: the parts of its plan; whole_us: of each block, the trial as it is; timed_us: mean in the timed calls;
    switched_us: of each block, the trial with one part toggled.
    """

    parts: list[dict[str, Any]]
    whole_us: Floats
    timed_us: dict[str, float]
    switched_us: dict[str, Floats]

    def rows(self) -> list[dict[str, Any]]:
        """Return the parts of the plan, with the cost of each built part or the saving of each omitted one.

        None if a part is not measured separately: it is then included in gel and friction, or cannot be switched. The
        camera's time that its other parts do not explain is that of the dots. A figure within `noise_us` of zero means
        nothing; it is None for a figure that is timed. No part saves time by being built, so a difference below zero
        is noise.
        """
        rows = [dict(row) for row in self.parts]
        names = [row["part"] for row in rows]
        costs, saved, noise = dict(self.timed_us), dict[str, float](), dict[str, float]()
        for row in rows:
            part, shown = row["part"], saved if row["built"] is None else costs
            if part in self.switched_us:
                both = min(len(self.whole_us), len(self.switched_us[part]))
                more_us = self.whole_us[:both] - self.switched_us[part][:both]
                more_us = more_us if shown is costs else -more_us
                shown[part] = float(more_us.mean())
                error_us = float(more_us.std(ddof=1)) / math.sqrt(len(more_us)) if len(more_us) > 1 else shown[part]
                noise[part] = max(-shown[part], SURE * error_us)
        in_camera = [part for part in names[names.index(CAMERA.name) + 1 :] if part in costs]
        costs[DOTS.name] = costs[CAMERA.name] - sum(costs[part] for part in in_camera)
        noise[DOTS.name] = max(-costs[DOTS.name], math.hypot(*(noise.get(part, 0.0) for part in in_camera)))
        for row in rows:
            part = row["part"]
            row["time_us"], row["saves_us"], row["noise_us"] = costs.get(part), saved.get(part), noise.get(part)
        beside = {part: us for part, us in self.timed_us.items() if part not in names}
        beside["everything else"] = float(self.whole_us.mean()) - sum(self.timed_us.values())
        for part, us in beside.items():
            rows.append(dict.fromkeys(rows[0]) | {"part": part, "built": BESIDE_SCENE[part], "time_us": us})
        return rows


# Code that runs in a trial besides the parts of its scene.
BESIDE_SCENE = {
    "slip detector": "tracker, features, network",
    "everything else": "dot positions, ground truth, commands",
}


def dry_run(trials: Sequence[SomeTrial], play: Play[SomeTrial], progress: Progress = silent) -> Outcome:
    """Return what the first trial builds and leaves out, and the cost of each part on this machine."""
    costs = measure(trials[0], play, progress)
    files: dict[str, Any] = {"files": sum(len(trial.outputs) for trial in trials), "first_file": str(trials[0].output)}
    if notes := grid_notes(trials):
        files["gel_grid"] = notes[0]
    if costs is None:  # the trial ended before anything could be measured
        return Outcome(rows_of(trials[0].plan), True, files, made=False)
    rows, total_us = costs.rows(), float(costs.whole_us.mean())
    summary = {
        **files,
        "slices_measured": BLOCK * len(costs.whole_us),
        "time_us_a_slice": total_us,
        "times_real_time": 1000.0 / total_us,
        "left_out_saves_us": sum(row["saves_us"] or 0.0 for row in rows),
    }
    return Outcome(rows, True, summary, made=False)


def for_people(shown: Outcome) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the terminal output of a dry run: the built parts, then sentences on omitted parts and the time.

    For one with devices (session.plan_shown): what is opened and done, with only the first files of a long list.
    """
    rows, summary = shown.rows, shown.summary
    if "built" not in rows[0]:
        files = [row for row in rows if row["part"] == "file"]
        more = [{"part": "files", "what": f"{len(files):,} in all", "detail": "-v lists them"}]
        return (rows if len(files) <= MOST_FILES else [row for row in rows if row not in files[MOST_FILES:]] + more), []
    built = [
        {
            "part": row["part"],
            "built": textwrap.shorten(row["built"], SHOWN, placeholder=" ..."),
            "time_us": _in_words(row["time_us"], row["noise_us"]),
        }
        for row in rows
        if row["built"] is not None
    ]
    left_out = [row for row in rows if row["built"] is None]
    would_take = [
        f"{row['part']} {saved} us"
        for row in left_out
        if (saved := _in_words(row["saves_us"], row["noise_us"])) is not None
    ]
    sentences = ["-: measured within another part; camera includes dots, window, edge and noise."]
    if left_out:
        sentences += [f"{len(left_out)} parts are left out: scene and sensor do not name them (-v: in full)."]
    if would_take:
        sentences += [f"They would take: {', '.join(would_take)}."]
    if "time_us_a_slice" in summary:
        sentences += [
            f"A slice takes {summary['time_us_a_slice']:.0f} us here, which is {summary['times_real_time']:.2g} x real"
            f" time, measured on {summary['slices_measured']:,} slices."
        ]
    if "gel_grid" in summary:
        sentences += [f"{summary['gel_grid'].capitalize()}."]
    of_several = "" if summary["files"] == 1 else f"{summary['files']:,} files, the first "
    sentences += [f"Nothing was written. A run would make {of_several}{summary['first_file']}."]
    return built, sentences


def _in_words(us: float | None, noise_us: float | None) -> str | None:
    """Return the time of a part to three digits; "< x" for a difference within the machine's fluctuations."""
    if us is None:
        return None
    return f"< {noise_us:.2g}" if noise_us is not None and us <= noise_us else f"{us:.3g}"


class CallTimer:
    """Counts the seconds of this thread in the calls that represent parts, by part."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def __call__(self, part: str, call: Call) -> Call:
        """Wrap the call so that its seconds are counted; earlier counts stay."""
        self.seconds.setdefault(part, 0.0)

        def timed(*arguments: Any, **keywords: Any) -> Any:
            started = thread_time()
            result = call(*arguments, **keywords)
            self.seconds[part] += thread_time() - started
            return result

        return timed  # type: ignore[return-value]


def measure(trial: SomeTrial, play: Play[SomeTrial], progress: Progress = silent) -> PartCosts | None:
    """Run the first slices of a trial repeatedly: as it is, and with one part of it switched.

    As many slices and repeats as fit into BUDGET_S. None if the trial has no slices to measure.
    """
    runs: dict[str | None, SomeTrial] = {None: trial}
    runs |= {part: replace(trial, plan=plan) for part, plan in switched(trial.plan).items()}
    timer = CallTimer()
    for one in runs.values():
        _run(one, play, 2 * BLOCK, timer)  # compiles, or loads compiled code
    for _ in range(2):  # the first may compile what moves
        blocks = len(_run(trial, play, _moving_slices(trial.plan.scene), timer, BUDGET_S / (1 + len(runs))))
    if not blocks:
        return None
    fastest: dict[str | None, Floats] = {}
    started = thread_time()
    for done in range(REPEATS):
        if done and (thread_time() - started) * (done + 1) / done > BUDGET_S:
            break
        for number, (part, one) in enumerate(runs.items()):
            progress(done * len(runs) + number, REPEATS * len(runs))
            us = _run(one, play, BLOCK * blocks, timer)
            fastest[part] = np.minimum(fastest.get(part, us), us)
    in_calls = fastest[None].mean(axis=0)[1:].tolist()
    timed_us = {part: us for part, us in zip(timer.seconds, in_calls, strict=True) if us}
    switched_us = {part: us[:, 0] for part, us in fastest.items() if part is not None}
    return PartCosts(rows_of(trial.plan), fastest[None][:, 0], timed_us, switched_us)


def _moving_slices(scene: Scene) -> int:
    """Return how many slices of a trial to measure: until typical motion begins, and MOVING_S of it."""
    time, rub = scene.time, scene.rub
    still_s = time.rest_s + time.load_s + time.hold_s + time.touch_s + time.before_rise_s
    pauses_s = 0.0
    if rub is not None:
        still_s, pauses_s = still_s + rub.touch_s + rub.shear_s, 2 * rub.pause_s
    moves_s = max(still_s, time.tone_at_s) + pauses_s
    return round(SLICES_PER_S * (moves_s + MOVING_S))


class _Enough(Exception):
    """Enough slices were run."""


def _run(trial: SomeTrial, play: Play[SomeTrial], slices: int, timer: CallTimer, most_s: float = math.inf) -> Floats:
    """Return microseconds per slice of each block, (blocks, 1 + parts): in total, and in the calls of each part.

    The run ends before a block that would begin later than `most_s`.
    """
    blocks: list[list[float]] = []
    done = 0

    def append(events: Events, rows: dict[str, Any]) -> None:
        nonlocal done
        if done % BLOCK == 0:
            blocks.append([thread_time(), *timer.seconds.values()])
            if done >= slices or blocks[-1][0] > blocks[0][0] + most_s:
                raise _Enough
        done += 1

    with suppress(_Enough):
        play(trial, append, timer)
    return np.diff(np.reshape(blocks, (-1, 1 + len(timer.seconds))), axis=0) / BLOCK * 1e6
