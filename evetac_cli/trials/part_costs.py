"""The cost per slice of the parts of a simulated scene on this machine, measured on the first seconds of a trial.

Optional parts are measured with and without, alternately. Gel, gripper, camera and the slip detector of a grasp are
measured by a timer of their calls, which is passed to the trial. The trial is the same every time, so the fastest run
of each stretch counts, which leaves out other load on the machine. Only the time of this thread counts, without writing
the file. A difference counts as measured if it exceeds the machine's own fluctuations; otherwise that limit is
reported.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from time import thread_time
from typing import Any, TypeVar

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.events import SLICES_PER_S, Events
from evetac_cli.jobs import Outcome, Progress, silent
from evetac_cli.sim.parts import Call, Timer, rows_of, switched
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.trials import gel_grid
from evetac_cli.trials.trial import SimulatedTrial

REPEATS = 3  # most repeats in a dry run
BUDGET_S = 3.0  # total time of the runs in a dry run; a slow scene is measured on fewer slices
DRY_MOVING_S = 0.5  # measured duration of a trial once something moves, in a dry run
MOVING_S = 1.5  # the same, otherwise
BLOCK = 50  # slices that are timed together
MOST_FILES = 5  # most files that a plan with devices lists on a terminal
SURE = 2.0  # a difference below this many standard errors of its mean over the blocks is noise

Append = Callable[[Events, dict[str, Any]], None]
SomeTrial = TypeVar("SomeTrial", bound=SimulatedTrial)
Play = Callable[[SomeTrial, Append, Timer], Any]  # runs the trial and passes on every slice and its rows


@dataclass(frozen=True)
class PartCosts:
    """Microseconds per slice of a trial, for each block of slices, each from the fastest of its runs.

    parts: the parts of its plan; whole: the trial as it is; timed: time in the timed calls; switched: the trial with
    one part toggled.
    """

    parts: list[dict[str, Any]]
    whole: Floats
    timed: dict[str, Floats]
    switched: dict[str, Floats]

    @property
    def slices(self) -> int:
        """The number of measured slices."""
        return BLOCK * len(self.whole)

    def more_us(self, part: str) -> float:
        """Return the extra time per slice of a part that can be switched, in us."""
        left_out = any(row["part"] == part and row["left_out"] for row in self.parts)
        difference_us = float(self._differences_us(part).mean())
        return -difference_us if left_out else difference_us

    def noise_us(self, part: str) -> float:
        """Return the difference that the machine's fluctuations alone can make for a switched part, in us.

        Estimated from the variation between blocks. No part saves time by being built, so a cost below zero is entirely
        noise.
        """
        differences_us = self._differences_us(part)
        below_zero_us = max(0.0, -self.more_us(part))
        if len(differences_us) < 2:
            return abs(self.more_us(part))
        return max(below_zero_us, SURE * float(differences_us.std(ddof=1)) / math.sqrt(len(differences_us)))

    def _differences_us(self, part: str) -> Floats:
        other = self.switched[part]
        both = min(len(other), len(self.whole))
        return self.whole[:both] - other[:both]

    def rows(self) -> list[dict[str, Any]]:
        """Return the parts of the plan, with the cost of each built part or the saving of each omitted one.

        None if a part is not measured separately: it is then included in gel and friction, or cannot be switched. The
        camera's time that its other parts do not explain is that of the dots. noise_us: a figure within this of zero
        means nothing; None for a figure that is timed and not a difference.
        """
        rows = [dict(row) for row in self.parts]
        names = [row["part"] for row in rows]
        built = [row["part"] for row in rows if row["left_out"] is None]
        timed_us = {part: float(us.mean()) for part, us in self.timed.items()}
        costs = {part: self.more_us(part) for part in self.switched if part in built} | timed_us
        in_camera = names[names.index("camera") + 1 :]
        costs["dots"] = timed_us["camera"] - sum(costs.get(part, 0.0) for part in in_camera)
        noises = {part: self.noise_us(part) for part in self.switched}
        others_us = math.hypot(*(noises[part] for part in in_camera if part in noises and part in costs))
        noises["dots"] = max(others_us, -costs["dots"])
        for row in rows:
            left_out = row["part"] not in built and row["part"] in self.switched
            row["time_us"] = costs.get(row["part"])
            row["saves_us"] = self.more_us(row["part"]) if left_out else None
            row["noise_us"] = noises.get(row["part"])
        rest_us = float(self.whole.mean()) - sum(timed_us.values())
        beside = {part: us for part, us in timed_us.items() if part not in names} | {"everything else": rest_us}
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
    costs = measure(trials[0], play, REPEATS, moving_s=DRY_MOVING_S, budget_s=BUDGET_S, progress=progress)
    files: dict[str, Any] = {"files": sum(len(trial.outputs) for trial in trials), "first_file": str(trials[0].output)}
    if notes := gel_grid.notes(trials):
        files["gel_grid"] = notes[0]
    if not costs.slices:  # the trial ended before anything could be measured
        return Outcome(rows_of(trials[0].plan), True, files, made=False)
    rows, total_us = costs.rows(), float(costs.whole.mean())
    summary = {
        **files,
        "slices_measured": costs.slices,
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
    if "left_out" not in rows[0]:
        files = [row for row in rows if row["part"] == "file"]
        more = [{"part": "files", "what": f"{len(files):,} in all", "detail": "-v lists them"}]
        return (rows if len(files) <= MOST_FILES else [row for row in rows if row not in files[MOST_FILES:]] + more), []
    built = [
        {"part": row["part"], "built": row["built"], "time_us": _in_words(row, "time_us")}
        for row in rows
        if row["built"] is not None
    ]
    left_out = [row for row in rows if row["left_out"] is not None]
    would_take = [f"{row['part']} {saved} us" for row in left_out if (saved := _in_words(row, "saves_us")) is not None]
    sentences = ["-: measured within another part; camera includes dots, window, edge and noise."]
    if left_out:
        sentences += [f"{len(left_out)} parts are left out: scene and sensor do not name them (-v: reasons)."]
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


def _in_words(row: dict[str, Any], figure: str) -> str | None:
    """Return the time of a part to three digits; "< x" for a difference within the machine's fluctuations."""
    us, noise_us = row.get(figure), row.get("noise_us")
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


def measure(
    trial: SomeTrial,
    play: Play[SomeTrial],
    repeats: int,
    *,
    moving_s: float = MOVING_S,
    budget_s: float = math.inf,
    progress: Progress = silent,
) -> PartCosts:
    """Run the first slices of a trial repeatedly: as it is, and with one part of it switched.

    moving_s: measured duration once something moves. budget_s: total time of all runs; if they would take longer, fewer
    slices and repeats are run.
    """
    others = {part: replace(trial, plan=plan) for part, plan in switched(trial.plan).items()}
    timer = CallTimer()
    for one in (trial, *others.values()):
        _run(one, play, 2 * BLOCK, timer)  # compiles, or loads compiled code
    most_slices = _moving_slices(trial.plan.scene, moving_s)
    slices = _slices_within(trial, play, most_slices, budget_s / (2 + len(others)), timer)
    plain: list[Floats] = []
    with_other: dict[str, list[Floats]] = {part: [] for part in others}
    started = thread_time()
    for done in range(repeats):
        if done and (thread_time() - started) * (done + 1) / done > budget_s:
            break
        plain.append(_run(trial, play, slices, timer))
        for number, (part, other) in enumerate(others.items(), 1):
            progress(done * (1 + len(others)) + number, repeats * (1 + len(others)))
            with_other[part].append(_run(other, play, slices, timer))
    in_calls = np.min(plain, axis=0)[:, 1:].T
    return PartCosts(
        parts=rows_of(trial.plan),
        whole=np.min(plain, axis=0)[:, 0],
        timed={part: us for part, us in zip(timer.seconds, in_calls, strict=True) if us.any()},
        switched={part: np.min(runs, axis=0)[:, 0] for part, runs in with_other.items()},
    )


def _slices_within(trial: SomeTrial, play: Play[SomeTrial], slices: int, most_s: float, timer: CallTimer) -> int:
    """Return how many of the first slices of a trial run within `most_s`; at least a block."""
    if math.isinf(most_s):
        return slices
    for _ in range(2):  # the interrupted run may have been compiling
        ran = BLOCK * len(_run(trial, play, slices, timer, most_s))
        if ran >= slices:
            break
    return max(ran, BLOCK)


def _moving_slices(scene: Scene, moving_s: float) -> int:
    """Return how many slices of a trial to measure: until typical motion begins, and `moving_s` of it."""
    time, rub = scene.time, scene.rub
    still_s = time.rest_s + time.load_s + time.hold_s + time.touch_s + time.before_rise_s
    pauses_s = 0.0
    if rub is not None:
        still_s, pauses_s = still_s + rub.touch_s + rub.shear_s, 2 * rub.pause_s
    moves_s = max(still_s, time.tone_at_s) + pauses_s
    return round(SLICES_PER_S * (moves_s + moving_s)) // BLOCK * BLOCK


class _Enough(Exception):
    """Enough slices were run."""


def _run(trial: SomeTrial, play: Play[SomeTrial], slices: int, timer: CallTimer, most_s: float = math.inf) -> Floats:
    """Return microseconds per slice of each block, (blocks, 1 + parts): in total, and in the calls of each part.

    The run ends before a block that would begin later than `most_s`.
    """
    blocks: list[list[float]] = []
    last: list[float] = []
    done = 0
    latest = thread_time() + most_s

    def append(events: Events, rows: dict[str, Any]) -> None:
        nonlocal done, last
        if done % BLOCK == 0:
            now = [thread_time(), *timer.seconds.values()]
            if done:
                blocks.append([after - before for before, after in zip(last, now, strict=True)])
            last = now
        if done == slices or (done % BLOCK == 0 and last[0] > latest):
            raise _Enough
        done += 1

    with suppress(_Enough):
        play(trial, append, timer)
    return np.reshape(np.array(blocks), (-1, 1 + len(timer.seconds))) / BLOCK * 1e6
