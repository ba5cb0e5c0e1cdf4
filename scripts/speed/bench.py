"""Run times of the kernels on one core, as ratios within one run: to real time, to other methods, to another commit.

    python scripts/speed/bench.py                                  # all rows, those of baselines.py last
    python scripts/speed/bench.py --only touch baselines
    python scripts/speed/bench.py --only commands --against HEAD~20 --rounds 5  # CPU of whole commands (commands.py)
    python scripts/speed/bench.py --against HEAD~20                # or another checkout's folder: `make bench BASE=...`

Times depend on the machine and on its load. Compare only the ratios within one run. The input is simulated. With
--against, this script runs in separate processes with each package in turn; a group of rows that fails with one of them
is left out.
"""

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from evetac_cli.commands.grasp import Grasp
from evetac_cli.console import show
from evetac_cli.devices import Rig
from evetac_cli.devices.plugin_devices import slice_fault
from evetac_cli.devices.simulated import rig
from evetac_cli.evaluate.cost.tracker import DOTS_PX, rim_events
from evetac_cli.events import FRAME_PX, SLICE_US, SLICES_PER_S, Events
from evetac_cli.kernels.grip import paper
from evetac_cli.kernels.labelling import flow
from evetac_cli.kernels.slip import features
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.resources import MODEL
from evetac_cli.sim.scenes.gripped import GraspSimulation
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.stages.model_files import chosen_threshold
from evetac_cli.store.files import StageFile
from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector

ROOT = Path(__file__).resolve().parents[2]
TOUCH_MS, LIFT_MS = 1500, 10_000
CHECKS = 100  # calls timed together: one takes about as long as reading the clock
OBJECTS = (8, 11, 17, 18)


def timed(call: Callable[[], object], repeat: int) -> np.ndarray:
    """Return the seconds of each repetition except the first, which compiles and fills caches."""
    call()
    times = []
    for _ in range(repeat):
        started = time.perf_counter()
        call()
        times.append(time.perf_counter() - started)
    return np.array(times)


def simulation(name: str, number: int) -> list[dict[str, object]]:
    """Simulate a whole trajectory of a scene; return the mean time over all slices, in total and by part.

    slip: the current falls by 6.9 mA/s, starting at 0.9 s. lift: the paper's control law with the true slip signal.
    """
    kind = "lift" if name == "lift" else "ramp"
    plan = first_plan(name, str(number))
    for slices in (100, 100_000):  # the first compiles
        simulated = GraspSimulation(plan, *(np.random.default_rng([1, part]) for part in range(2)))
        mechanics, camera = Stopwatch(simulated._move), Stopwatch(simulated.view.render)
        simulated._move, simulated.view.render = mechanics, camera  # type: ignore[method-assign]
        start_ma, law = simulated.finger.command[1], paper.start()
        started = time.thread_time()
        while not simulated.finished and simulated.slices < slices:
            if simulated.slices % 2 == 0:
                if kind == "lift":
                    phase = paper.GraspPhase((simulated.slices >= TOUCH_MS) + (simulated.slices >= TOUCH_MS + LIFT_MS))
                    slips = bool(simulated.view.slip.truth()["truth/slip"])
                    goal = paper.step(law, phase, slips, simulated.finger.state.position_ticks)
                    simulated.finger.command = ("position", goal)
                elif simulated.slices >= 900:
                    simulated.finger.command = ("current", round(start_ma - 0.01375 * (simulated.slices - 900) / 2))
            simulated.step()
        seconds = time.thread_time() - started
    what = f"simulate {name}, object {number}, {simulated.slices / SLICES_PER_S:.1f} s"
    parts = (("", seconds), (": mechanics", mechanics.seconds), (": camera", camera.seconds))
    return [row(what + part, np.array([part_s / simulated.slices])) for part, part_s in parts]


def edges() -> list[dict[str, object]]:
    """Time two trials of the scene edge, from the first slice to the last: a finger and a handle."""
    rows = []
    for trial in (0, 1):
        plan = first_plan("edge")
        for slices in (100, 100_000):  # the first compiles
            devices = rig(plan, np.random.SeedSequence([1, trial]))
            times = slice_times(devices, slices)
        what = json.loads(devices.sampled)["object_name"]
        rows.append(row(f"simulate edge, a {what}, {len(times) / SLICES_PER_S:.1f} s", np.array([times.mean()])))
    return rows


def stillness() -> list[dict[str, object]]:
    """Time slices without slip: an object before its weight is on the gripper, a held object, and a face at rest."""
    rows = []
    for name, what, first, end in (
        ("slip", "before its weight", 30, 200),
        ("slip", "held, swinging", 700, 900),
        ("shear", "at rest", 2300, 3000),
    ):
        plan = first_plan(name)
        times = slice_times(rig(plan, np.random.SeedSequence([1, 0])), end)
        rows.append(row(f"simulate {name}, {what}", times[first:]))
    return rows


def slice_times(devices: Rig, slices: int) -> np.ndarray:
    """Return this thread's seconds for each of the first slices of a scene."""
    times = []
    for _ in range(slices):
        started = time.thread_time()
        if devices.camera.read() is None:
            break
        times.append(time.thread_time() - started)
    return np.array(times)


class Stopwatch:
    """A function with a count of the thread seconds spent in it."""

    def __init__(self, call: Callable[..., object]) -> None:
        self._call = call
        self.seconds = 0.0

    def __call__(self, *arguments: object, **named: object) -> object:
        started = time.thread_time()
        result = self._call(*arguments, **named)
        self.seconds += time.thread_time() - started
        return result


def row(what: str, seconds: np.ndarray, slices: float = 1.0) -> dict[str, object]:
    median_us = float(np.median(seconds)) * 1e6 / slices
    return {
        "what": what,
        "time_us_median": median_us,
        "time_us_p99": float(np.percentile(seconds, 99)) * 1e6 / slices if len(seconds) > 1 else None,
        "times_real_time": SLICE_US / median_us,
    }


def touch() -> list[dict[str, object]]:
    """Time tracker and features at several loads, with events on the edges of 63 dots."""
    rng = np.random.default_rng(0)
    dots = DOTS_PX
    rows = []
    for count in (0, 200, 463, 1000, 5000, 20000):
        # Different slices, because repeating one slice would make its pixels hot, and hot pixels are ignored.
        slices = [rim_events(rng, count) for _ in range(min(400, 400_000 // max(count, 1)))]
        for preset in ("paper", "official", "stable"):
            state = tracker.start(dots, presets.PRESETS[preset])
            turn = itertools.cycle(slices)
            seconds = timed(lambda s=state, t=turn: tracker.step(s, *next(t)), 500)
            rows.append(row(f"track {preset}, {count} events", seconds))
    history = features.start(dots, 10)
    moved, counted = dots + rng.normal(0, 1, dots.shape), rng.integers(0, 50, 63).astype(np.int32)
    rows.append(row("features, hist10", timed(lambda: features.step(history, moved, counted), 2000)))
    return rows


def labels() -> list[dict[str, object]]:
    """Time one pair of images in each region."""
    rng = np.random.default_rng(0)
    rows = []
    for name, region in (("window", (540, 0, 640, 480)), ("gel", (0, 0, 540, 480))):
        shape = (region[3] - region[1], region[2] - region[0])
        pair = [rng.choice(np.array([1, 128, 255], np.uint8), shape, p=[0.005, 0.99, 0.005]) for _ in range(2)]
        rows.append(row(f"flow of the {name}, a pair", timed(lambda p=pair: flow.region_flow(*p), 20)))
    return rows


def network() -> list[dict[str, object]]:
    """Time one prediction of hist10."""
    from evetac_cli.kernels.slip.detector import Detector
    from evetac_cli.kernels.slip.networks import SlipNet, onnx_graph

    architecture = ARCHITECTURES["hist10"]
    detector = Detector(onnx_graph(SlipNet(architecture)), architecture)
    window = np.random.default_rng(0).normal(0, 1, (1, 56, 20)).astype(np.float32)
    return [row("predict hist10", timed(lambda: detector.probability(window), 3000))]


def online_step(count: int = 500) -> list[dict[str, object]]:
    """Time the pretrained detector's step from the events of a slice to slip probability and control signal."""
    with StageFile(MODEL, "model") as model:
        name, constants = model.read("architecture"), presets.PRESETS[Grasp().tracker]
        dots, threshold = DOTS_PX.reshape(7, 9, 2)[:, :8], chosen_threshold(model)
        detector = OnlineSlipDetector.start(model, dots, (540, 0, 640, 480), constants, threshold)
    rng = np.random.default_rng(0)
    turn = itertools.cycle([events_near(rng, count) for _ in range(200)])

    def step() -> object:
        detector.step(next(turn))
        return detector.signal

    for _ in range(100):  # fills the history of the network
        step()
    return [row(f"online step, {count} events, {name}", timed(step, 5000))]


def events_near(rng: np.random.Generator, count: int) -> Events:
    """Return a slice of events at the rims of the dots of a cut gel."""
    x, y, p = rim_events(rng, 2 * count)
    left = np.flatnonzero(x < 517)[:count]
    return Events(np.sort(rng.integers(0, 1000, len(left))), x[left], y[left], p[left])


def plugin_check() -> list[dict[str, object]]:
    """Time the check of a slice of a plug-in's camera; evetac's own cameras are not checked."""
    rng, rows = np.random.default_rng(0), []
    for count in (0, 100, 1000):
        x, y, p = rim_events(rng, count)
        events = Events(np.sort(rng.integers(0, SLICE_US, len(x))), x, y, p)
        calls = timed(lambda e=events: [slice_fault(e, 0, FRAME_PX) for _ in range(CHECKS)], 200)
        rows.append(row(f"check a plug-in's slice, {count} events", calls, CHECKS))
    return rows


def all_simulations(name: str) -> list[dict[str, object]]:
    return [entry for number in OBJECTS for entry in simulation(name, number)]


def baselines() -> list[dict[str, object]]:
    from scripts.speed import baselines as bench_baselines

    return bench_baselines.rows()


def commands() -> list[dict[str, object]]:
    from scripts.speed import commands as bench_commands

    return bench_commands.rows(ROOT)


GROUPS: dict[str, Callable[[], list[dict[str, object]]]] = {
    "slip": lambda: all_simulations("slip"),
    "lift": lambda: all_simulations("lift"),
    "edge": edges,
    "still": stillness,
    "touch": touch,
    "labels": labels,
    "network": network,
    "online": online_step,
    "baselines": baselines,
    "plug-in": plugin_check,
    "commands": commands,
}


@contextmanager
def checkout(base: str) -> Iterator[Path]:
    """Return the folder of another checkout: `base` itself, or a temporary work tree of that revision."""
    if Path(base).is_dir():
        yield Path(base).resolve()
        return
    with tempfile.TemporaryDirectory(prefix="evetac-bench-") as folder:
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", f"{folder}/base", base], check=True)
        try:
            yield Path(folder) / "base"
        finally:
            subprocess.run([*git, "remove", "--force", f"{folder}/base"], check=True)


def times_us(code: Path, group: str) -> dict[str, float]:
    """Return median times of a group's rows, run in a separate process with a folder's package; none if it fails."""
    run = [sys.executable, __file__, "--only", group, "--json"]
    environment = os.environ | {"PYTHONPATH": str(code)}
    done = subprocess.run(run, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        why = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        print(f"{group} failed with {code}: {why}", file=sys.stderr)
        return {}
    return {row["what"]: row["time_us_median"] for row in json.loads(done.stdout)["rows"]}


def against(base: Path, groups: Iterable[str], rounds: int) -> list[dict[str, object]]:
    """Return the rows that both checkouts have, each the fastest of its rounds; the checkouts take turns."""
    rows: list[dict[str, object]] = []
    for group in groups:
        if group == "commands":
            from scripts.speed import commands as bench_commands

            rows += bench_commands.against(ROOT, base, rounds)
            continue
        fastest: dict[Path, dict[str, float]] = {ROOT: {}, base: {}}
        for _ in range(rounds):
            for code, known in fastest.items():
                known |= {what: min(us, known.get(what, us)) for what, us in times_us(code, group).items()}
        rows += [
            {"what": what, "time_us": us, "time_us_base": fastest[base][what], "ratio": us / fastest[base][what]}
            for what, us in fastest[ROOT].items()
            if what in fastest[base]
        ]
    return rows


def main() -> None:
    """Run the rows here, or here and in another checkout, and print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=GROUPS, default=list(GROUPS), help="groups of rows")
    parser.add_argument("--against", metavar="BASE", help="a revision, or the folder of another checkout")
    parser.add_argument("--rounds", type=int, default=3, help="rounds of --against; the fastest counts")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    chosen = parser.parse_args()
    if chosen.against is None:
        rows = [entry for group in chosen.only for entry in GROUPS[group]()]
    else:
        with checkout(chosen.against) as base:
            rows = against(base, [group for group in chosen.only if group != "baselines"], chosen.rounds)
    show("bench, one core", rows, {}, simulated=True, as_json=chosen.json)


if __name__ == "__main__":
    main()
