"""Compare evetac's kernels with the straightforward method for the same task, in plain numpy or with a library.

All methods take turns on the same simulated input, each on one core, and the fastest run of each counts. Results are
compared only where both methods compute the same by definition: tests/scripts/speed/test_baselines.py.
"""

import math
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import torch

import evetac_cli
from evetac_cli.arrays import Floats
from evetac_cli.evaluate.cost.tracker import DOTS_PX
from evetac_cli.events import FRAME_PX, SLICE_US, Events, concatenate
from evetac_cli.jobs import Row
from evetac_cli.kernels.labelling import event_flow, flow
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.kernels.slip.detector import Detector
from evetac_cli.kernels.slip.networks import SlipNet, onnx_graph
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.store.recordings.trial_writer import TrialWriter

OURS = "ours"
REPEATS = 5
# Camera and tracker see dots on circles, at a speed that makes some 350 events per slice.
PERIOD, RADIUS_PX = 1000, 3.0
SLICES = 50  # slices of the motion in one call
FRAME_MS = 10  # ms of events per image for Lucas-Kanade and Farneback
BLOCK = 1000  # slices that are read at once


def fastest(calls: Mapping[str, Callable[[], int]]) -> dict[str, float]:
    """Return thread seconds per unit of work (slice or event) that a function reports, by the function's name."""
    for call in calls.values():
        call()  # compiles, loads, fills caches
    seconds = dict.fromkeys(calls, math.inf)
    for _ in range(REPEATS):
        for name, call in calls.items():
            started = time.thread_time()
            done = call()
            seconds[name] = min(seconds[name], (time.thread_time() - started) / done)
    return seconds


def compared(task: str, calls: Mapping[str, Callable[[], int]]) -> list[Row]:
    """Return a row for each method of a task; one call of a method does several slices."""
    seconds = fastest(calls)
    return [
        {
            "task": task,
            "by": name,
            "time_us": taken_s * 1e6,
            "times_real_time": SLICE_US / (taken_s * 1e6),
            "times_ours": taken_s / seconds[OURS],
        }
        for name, taken_s in seconds.items()
    ]


def circle(slice_: float) -> Floats:
    """Return the positions of the dots (dots, 2) at a time in slices."""
    angle = 2.0 * math.pi * slice_ / PERIOD
    return DOTS_PX + RADIUS_PX * np.array([math.sin(angle), 1.0 - math.cos(angle)])


def gel_camera(scans_per_ms: int = 5) -> camera.CameraState:
    """Return a noise-free camera looking at the dots; the naive camera copies its references and thresholds."""
    model = camera.CameraModel(scans_per_ms=scans_per_ms, noise_rate_hz=0.0, hot_pixels=0)
    return camera.start(model, circle(0), None, np.random.default_rng(0))


def seen(state: camera.CameraState, slice_: int) -> Events:
    """Return the events that evetac's camera makes in one slice of the motion; the dots move on a straight line."""
    still = np.zeros(2)
    ends = circle(slice_ % PERIOD), circle(slice_ % PERIOD + 1)
    return camera.step(state, SliceMotion(*ends, still, still, 0.0), SLICE_US * slice_, np.random.default_rng(0))


class DenseFrames:
    """The straightforward event camera simulator: renders the whole frame at every scan and compares all pixels."""

    def __init__(self, state: camera.CameraState) -> None:
        self._profile, self._readout_us = state.profile, state.readout_us
        self._reference, self._threshold = state.reference.copy(), state.threshold

    def slice(self, slice_: int) -> Events:
        """Return the events of one slice of the motion, sorted by time."""
        start, end = circle(slice_ % PERIOD), circle(slice_ % PERIOD + 1)
        parts = []
        for scan, readout_us in enumerate(self._readout_us):
            dots = start + scan / len(self._readout_us) * (end - start)
            level = optics.gel_level(FRAME_PX, dots, self._profile)
            change = level - self._reference
            fired = np.abs(change) >= self._threshold
            y, x = np.nonzero(fired)
            self._reference[fired] = level[fired]
            p = (change[fired] > 0).astype(np.uint8)
            parts.append(Events(SLICE_US * slice_ + readout_us[x], x.astype(np.uint16), y.astype(np.uint16), p))
        made = concatenate(parts)
        return Events(*(column[np.argsort(made.t, kind="stable")] for column in made))


class NumpyTracker:
    """The paper's gradient step in plain numpy, every event against every dot: preset `paper` without hot pixels."""

    def __init__(self, dot_xy_px: Floats) -> None:
        state = tracker.start(dot_xy_px, presets.PRESETS["paper"])
        self.dot_xy_px = dot_xy_px.copy()
        self._constants = presets.PRESETS["paper"]
        self._near, self._pairs = state.neighbours >= 0, state.neighbours
        self._rest_px2 = ((dot_xy_px[:, None] - dot_xy_px[self._pairs]) ** 2).sum(axis=2)

    def step(self, events: Events) -> None:
        """Move the dots by the events of one slice."""
        constants, dots = self._constants, self.dot_xy_px
        away = np.stack([events.x, events.y], axis=1).astype(np.float64)[:, None] - dots
        distance = np.sqrt((away**2).sum(axis=2))
        ring = (distance > constants.ring_inner_px) & (distance < constants.ring_outer_px)
        stretch = ring * (1.0 - constants.radius_px / np.maximum(distance, 1e-6))
        pull = -2.0 * (stretch[:, :, None] * away).sum(axis=0)
        apart = dots[:, None] - dots[self._pairs]
        strain = 4.0 * ((apart**2).sum(axis=2) - self._rest_px2) * self._near
        elastic = 8.0 / self._near.sum(axis=1, keepdims=True) * (strain[:, :, None] * apart).sum(axis=1)
        clipped = np.clip(pull, -constants.gradient_clip, constants.gradient_clip)
        shift = -constants.step_size * (clipped + constants.regulariser_weight * elastic)
        moves = ring.sum(axis=0) > constants.min_events
        self.dot_xy_px = dots + moves[:, None] * np.clip(shift, -constants.radius_px, constants.radius_px)


def cameras() -> list[Row]:
    """Compare the gel camera with full frames, on moving dots."""

    def ours() -> Callable[[], int]:
        state, turn = gel_camera(), iter(range(10**9))
        return lambda: sum(seen(state, next(turn)) is not None for _ in range(SLICES))

    def dense(scans_per_ms: int) -> Callable[[], int]:
        frames, turn = DenseFrames(gel_camera(scans_per_ms)), iter(range(10**9))
        return lambda: sum(frames.slice(next(turn)) is not None for _ in range(SLICES))

    calls = {OURS: ours(), "dense frames, 5 kHz: the same events": dense(5)}
    calls |= {"dense frames, 1 kHz": dense(1), "dense frames, 10 kHz": dense(10)}
    return compared("camera, 63 dots", calls)


def trackers() -> list[Row]:
    """Compare trackers on the events of moving dots."""
    state = gel_camera()
    slices = [seen(state, slice_) for slice_ in range(SLICES)]
    pictures = [concatenate(slices[max(0, k - FRAME_MS + 1) : k + 1]) for k in range(SLICES)]

    def ours(preset: str) -> Callable[[], int]:
        tracked = tracker.start(DOTS_PX, presets.PRESETS[preset])

        def call() -> int:
            for events in slices:
                tracker.step(tracked, events.x, events.y, events.p)
            return SLICES

        return call

    def in_numpy() -> int:
        tracked = NumpyTracker(DOTS_PX)
        for events in slices:
            tracked.step(events)
        return SLICES

    def lucas_kanade() -> int:
        points = DOTS_PX.astype(np.float32)[:, None]
        before = flow.event_picture(pictures[0], (0, 0, *FRAME_PX))
        for events in pictures[1:]:
            now = flow.event_picture(events, (0, 0, *FRAME_PX))
            points, _, _ = cv2.calcOpticalFlowPyrLK(before, now, points, None, winSize=(31, 31), maxLevel=2)
            before = now
        return SLICES - 1

    events_a_slice = sum(events.size for events in slices) / SLICES
    calls = {OURS: ours("stable"), "ours, preset paper": ours("paper"), "numpy, the paper's step": in_numpy}
    calls |= {f"OpenCV Lucas-Kanade on pictures of {FRAME_MS} ms": lucas_kanade}
    return compared(f"track, 63 dots, {events_a_slice:.0f} events", calls)


def labellers() -> list[Row]:
    """Compare the default label method with dense flow of the window alone at every slice, on a forced slip."""
    trial = evetac_cli.simulate("slip", 8)
    slices = list(trial)
    starts = np.cumsum([0, *(events.size for events in slices)])
    together = concatenate(slices)
    x0, y0, x1, y1 = trial.window_px
    window = x0 + 10, y0, x1, y1
    dots, radius_px = trial.dot_xy_px.reshape(-1, 2), trial.dot_radius_px

    def between(first: int, last: int) -> Events:
        return together.part(int(starts[first]), int(starts[last]))

    def ours() -> int:
        event_flow.label(between, len(slices), window, FRAME_PX, dots, radius_px, event_flow.EventFlowConstants())
        return len(slices)

    def farneback() -> int:
        for k in range(len(slices) - 100, len(slices) - 50):  # during slip
            pair = (flow.event_picture(between(first, first + FRAME_MS), window) for first in (k, k + FRAME_MS))
            flow.region_flow(*pair)
        return 50

    calls = {OURS: ours, f"OpenCV Farneback of the window, pictures of {FRAME_MS} ms": farneback}
    return compared("label, a forced slip", calls) + storage(slices)


def networks() -> list[Row]:
    """Compare one prediction of hist10 in onnxruntime and in torch."""
    architecture = ARCHITECTURES["hist10"]
    net = SlipNet(architecture).eval()
    detector = Detector(onnx_graph(net), architecture)
    window = np.random.default_rng(0).normal(0, 1, (1, 56, 20)).astype(np.float32)

    def ours() -> int:
        for _ in range(SLICES):
            detector.probability(window)
        return SLICES

    def eager() -> int:
        with torch.inference_mode():
            for _ in range(SLICES):
                torch.sigmoid(net(torch.from_numpy(window))).numpy()
        return SLICES

    return compared("predict, hist10", {OURS: ours, "torch eager": eager})


def storage(slices: list[Events]) -> list[Row]:
    """Compare writing and reading events: evetac's recordings, checked in both directions, and plain h5py."""
    events = concatenate(slices)
    static = {"sensor/frame_px": np.array(FRAME_PX, np.int32), "sensor/name": "evetac", "t_offset": np.int64(0)}
    with tempfile.TemporaryDirectory(prefix="evetac-bench-") as folder:
        paths = {name: Path(folder) / f"{number}.recording.h5" for number, name in enumerate((OURS, *PLAIN))}

        def write_ours() -> int:
            with TrialWriter(paths[OURS], static) as writer:
                for part in slices:
                    writer.append(part, {})
                writer.finish(Recipe("recording", 1, {}, seed=0, simulated_source=True))
            return events.size

        def read_ours() -> int:
            with open_recording(paths[OURS]) as recording:
                for _ in recording.blocks(BLOCK):
                    pass
            return events.size

        def write_plain(name: str) -> int:
            with h5py.File(paths[name], "w") as file:
                for column in Events._fields:
                    file.create_dataset(f"events/{column}", data=getattr(events, column), **PLAIN[name])
            return events.size

        def read_plain(name: str) -> int:
            step = max(1, events.size * BLOCK // len(slices))
            with h5py.File(paths[name]) as file:
                for first in range(0, events.size, step):
                    for column in Events._fields:
                        file[f"events/{column}"][first : first + step]
            return events.size

        rows = []
        for task, ours, plain in (("write", write_ours, write_plain), ("read", read_ours, read_plain)):
            seconds = fastest({OURS: ours} | {name: lambda name=name, plain=plain: plain(name) for name in PLAIN})
            rows += [
                {
                    "task": f"{task} {events.size / 1e6:.2f} million events",
                    "by": name,
                    "million_events_per_s": 1e-6 / taken_s,
                    "bytes_per_event": paths[name].stat().st_size / events.size,
                    "times_ours": taken_s / seconds[OURS],
                }
                for name, taken_s in seconds.items()
            ]
    return rows


PLAIN: dict[str, dict[str, Any]] = {"plain h5py": {}, "plain h5py, gzip": {"compression": "gzip"}}


def rows() -> list[Row]:
    """Return all comparisons, on one core."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    return [*cameras(), *trackers(), *networks(), *labellers()]
