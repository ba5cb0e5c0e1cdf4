"""Run times of the kernels on one core, as ratios in one run: times faster than real time, and against each other.

Times depend on the machine and on what else it does; the ratios of one run are what to compare. Simulated input.
"""

import time
from collections.abc import Callable

import numpy as np

from evetac_cli.console import print_table
from evetac_cli.kernels import features, flow, slip, tracker
from evetac_cli.sim import scene
from evetac_cli.sim.world import World

SLICE_US = 1000.0


def timed(what: Callable[[], object], repeat: int) -> np.ndarray:
    """Seconds of each repetition, the first (compilation, caches) left out."""
    what()
    times = []
    for _ in range(repeat):
        started = time.perf_counter()
        what()
        times.append(time.perf_counter() - started)
    return np.array(times)


def simulation(number: int) -> list[dict[str, object]]:
    """A whole slip trajectory and the start of a lift, mean over all slices, camera included."""
    rows = []
    for name, kind, slices in (("slip", "ramp", 10_000), ("lift", "lift", 6_000)):
        plan = scene.plan(name, str(number), "evetac", (kind,))[0]
        for trial in range(2):  # the first compiles
            world = World(plan, *(np.random.default_rng([trial, part]) for part in range(2)))
            held_ma, started = world.command[1], time.perf_counter()
            while not world.finished and world.slices < slices:
                if kind == "ramp" and world.slices >= 900 and world.slices % 2 == 0:
                    world.command = ("current", round(held_ma - 0.01375 * (world.slices - 900) / 2))
                elif kind == "lift":
                    world.command = ("position", world.finger.position_ticks + 2)
                world.step()
            seconds = time.perf_counter() - started
        rows.append(row(f"simulate {name}, object {number}", np.array([seconds / world.slices])))
    return rows


def row(what: str, seconds: np.ndarray, slices: float = 1.0) -> dict[str, object]:
    median_us = float(np.median(seconds)) * 1e6 / slices
    return {
        "what": what,
        "time_us_median": median_us,
        "time_us_p99": float(np.percentile(seconds, 99)) * 1e6 / slices if len(seconds) > 1 else None,
        "times_real_time": SLICE_US / median_us,
    }


def touch() -> list[dict[str, object]]:
    """Tracker and features at several loads, events on the edges of 63 dots."""
    rng = np.random.default_rng(0)
    dots = np.stack(np.meshgrid(61 + 62.3 * np.arange(9), 41 + 62.4 * np.arange(7)), axis=-1).reshape(-1, 2)
    rows = []
    for count in (0, 200, 1000, 5000, 20000):
        which, angle = rng.integers(0, 63, count), rng.uniform(0, 2 * np.pi, count)
        edge = dots[which] + 15 * np.stack([np.cos(angle), np.sin(angle)], axis=-1) + rng.normal(0, 1, (count, 2))
        x, y = np.clip(edge, 0, (639, 479)).astype(np.uint16).T.copy()
        for preset in ("paper", "carry"):
            state = tracker.start(dots, tracker.PRESETS[preset])
            seconds = timed(lambda s=state, a=x, b=y: tracker.step(s, a, b), 500)
            rows.append(row(f"track {preset}, {count} events", seconds))
    history = features.start(dots, 10)
    moved, counted = dots + rng.normal(0, 1, dots.shape), rng.integers(0, 50, 63).astype(np.int32)
    rows.append(row("features, hist10", timed(lambda: features.step(history, moved, counted), 2000)))
    return rows


def labels() -> list[dict[str, object]]:
    """One pair of pictures in each region, per pair."""
    rng = np.random.default_rng(0)
    rows = []
    for name, region in (("window", (540, 0, 640, 480)), ("gel", (0, 0, 540, 480))):
        shape = (region[3] - region[1], region[2] - region[0])
        pair = [rng.choice(np.array([1, 128, 255], np.uint8), shape, p=[0.005, 0.99, 0.005]) for _ in range(2)]
        rows.append(row(f"flow of the {name}, a pair", timed(lambda p=pair: flow.region_flow(*p), 20)))
    return rows


def network() -> list[dict[str, object]]:
    """One prediction of hist10 with onnxruntime."""
    from evetac_cli.kernels.detector import Detector
    from evetac_cli.kernels.networks import SlipNet, onnx_graph

    architecture = slip.ARCHITECTURES["hist10"]
    detector = Detector(onnx_graph(SlipNet(architecture)), architecture)
    window = np.random.default_rng(0).normal(0, 1, (1, 56, 20)).astype(np.float32)
    return [row("predict hist10", timed(lambda: detector.probability(window), 3000))]


def main() -> None:
    print_table(
        "bench, one core", [*simulation(8), *simulation(18), *touch(), *labels(), *network()], {}, simulated=True
    )


if __name__ == "__main__":
    main()
