"""Make the files that are mutated: one small valid file of every kind that evetac reads, made by evetac's commands.

`make(folder)` takes about a minute and is done once. The same commands and seeds make the same files.
"""

import shutil
import struct
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evetac_cli.resources import SCENES
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.store.recordings.segments import RecordingWriter
from scripts.attack.fuzz import bags, event_files, tables, wire

COMMANDS = """
record --scene short.toml --seed 1 --out first.recording.h5
record --scene short.toml --seed 2 --out second.recording.h5
record --scene short.toml --seed 3 --out third.recording.h5
track first.recording.h5 second.recording.h5 third.recording.h5
label first.recording.h5 second.recording.h5 third.recording.h5 --after-ms 25
featurize first.recording.h5 second.recording.h5 third.recording.h5 --images
train first.features.h5 second.features.h5 --epochs 30 --max-steps 60 --preset adam --out m.model.h5
train-force first.tracks.h5 second.tracks.h5 --samples 10 --epochs 2 --out f.force-model.h5
train-force first.tracks.h5 --method touch --out own.force-model.h5
predict-touch first.tracks.h5 --out first.touch.h5
evaluate slip third.features.h5 --model m.model.h5 --out slip.report.h5
grasp --controller paper --model m.model.h5 --lift-s 1 --balance-s 0.2 --out grasp.recording.h5
record --camera virtual:prepared --gripper virtual --seconds 0.5 --out device.recording.h5
trim first.recording.h5 --to-ms 60 --out piece.recording.h5
export piece.recording.h5 --format dsec --out events.h5
export piece.recording.h5 --format text --out events.txt
export piece.recording.h5 --format aedat4 --out events.aedat4
export piece.recording.h5 --format raw --out evt3.raw
export piece.recording.h5 --format mcap --out trial.mcap
export piece.recording.h5 --format calibration --out grid.json
export piece.recording.h5 --format calibration --out grid.pkl
"""


class Kind(NamedTuple):
    """Files of one kind: the file that is mutated, its companions, and the commands that read it.

    In a command, {f} is the mutated file and {o} is the folder for outputs. Companions keep their names next to {f}.
    """

    name: str
    file: str
    mutation: str  # a key of mutations.FAMILIES
    commands: tuple[str, ...]
    companions: tuple[str, ...] = ()


_RECORDING = (
    "track {f} --out {o}/a.tracks.h5",
    "label {f} --out {o}/a.labels.h5",
    "label {f} --method truth --out {o}/a.labels.h5",
    "label {f} --method farneback --out {o}/a.labels.h5",
    "label {f} --method event-count --out {o}/a.labels.h5",
    "featurize {f} --out {o}/a.features.h5",
    "trim {f} --from-ms 10 --to-ms 60 --out {o}/a.recording.h5",
    "track {f} --rgb --out {o}/a.tracks.h5",
    "export {f} --format dsec --out {o}/a.h5",
    "export {f} --format text --out {o}/a.txt",
    "export {f} --format aedat4 --out {o}/a.aedat4",
    "export {f} --format calibration --out {o}/a.json",
    "evaluate vibration {f} --windows 0.1 --out {o}/a.report.h5",
    "evaluate data-rate {f} --out {o}/a.report.h5",
    "calibrate {f} --out {o}/a.json",
    "view {f} --images 5 --out {o}/a.html",
    "record --camera replay:{f} --out {o}/a.recording.h5",
)
_INSPECT = ("validate {f}", "info {f}")
_FRAMES = "record --from {f} --frames --sort --out {o}/a.recording.h5"
_IMPORT = ("record --from {f} --frame-size 640x480 --out {o}/a.recording.h5", "record --from {f} --sort --out {o}/")
_ATTACH = ("attach piece.recording.h5 --out {o}/a.recording.h5 --stream arm={f}",)
KINDS = (
    Kind(
        "recording",
        "first.recording.h5",
        "hdf5",
        _INSPECT + _RECORDING,
        ("first.tracks.h5", "first.labels.h5"),
    ),
    Kind(
        "grasp recording",
        "grasp.recording.h5",
        "hdf5",
        (*_INSPECT, "evaluate grasp {f} --out {o}/a.report.h5", _RECORDING[0], _RECORDING[-2]),
    ),
    Kind("device recording", "device.recording.h5", "hdf5", (*_INSPECT, *_RECORDING[:2], *_RECORDING[8:10])),
    Kind(
        "tracks",
        "first.tracks.h5",
        "hdf5",
        (
            *_INSPECT,
            "predict-touch {f} --out {o}/a.touch.h5",
            "evaluate tracking {f} --out {o}/a.report.h5",
            "evaluate force {f} --model f.force-model.h5 --samples 10 --out {o}/a.report.h5",
            "featurize first.recording.h5 --out {o}/a.features.h5",
            "train-force {f} {f} --samples 10 --epochs 1 --out {o}/a.force-model.h5",
        ),
        ("first.recording.h5", "first.labels.h5", "f.force-model.h5"),
    ),
    Kind(
        "labels",
        "first.labels.h5",
        "hdf5",
        (
            *_INSPECT,
            "evaluate labels {f} --out {o}/a.report.h5",
            "featurize first.recording.h5 --out {o}/a.features.h5",
            "view first.recording.h5 --images 5 --out {o}/a.html",
        ),
        ("first.recording.h5", "first.tracks.h5"),
    ),
    Kind(
        "features",
        "third.features.h5",
        "hdf5",
        (
            *_INSPECT,
            "evaluate slip {f} --model m.model.h5 --out {o}/a.report.h5",
            "train {f} {f} --epochs 1 --max-steps 2 --preset adam --out {o}/a.model.h5",
        ),
        ("m.model.h5",),
    ),
    Kind(
        "model",
        "m.model.h5",
        "hdf5",
        (
            *_INSPECT,
            "evaluate slip third.features.h5 --model {f} --out {o}/a.report.h5",
            "grasp --controller paper --model {f} --lift-s 1 --balance-s 0.1 --out {o}/a.recording.h5",
            "share {f} --out {o}/hub",
        ),
        ("third.features.h5",),
    ),
    Kind(
        "force model",
        "f.force-model.h5",
        "hdf5",
        (
            *_INSPECT,
            "evaluate force first.tracks.h5 --model {f} --samples 10 --out {o}/a.report.h5",
        ),
        ("first.tracks.h5", "first.recording.h5"),
    ),
    Kind(
        "own force model",
        "own.force-model.h5",
        "hdf5",
        (*_INSPECT, "predict-touch first.tracks.h5 --model {f} --out {o}/a.touch.h5"),
        ("first.tracks.h5",),
    ),
    Kind("touch", "first.touch.h5", "hdf5", (*_INSPECT, "view first.recording.h5 --images 5 --out {o}/a.html"),
         ("first.recording.h5",)),
    Kind("report", "slip.report.h5", "hdf5", (*_INSPECT, "evaluate cost model --model {f} --out {o}/a.report.h5")),
    Kind("segments", "broken.recording.part", "segments", ("repair {d}",)),
    Kind("dot grid", "grid.json", "text", (
        "track piece.recording.h5 --calibration {f} --out {o}/a.tracks.h5",
        "record --from events.txt --frame-size 640x480 --calibration {f} --out {o}/a.recording.h5",
        "calibrate --import {f} --out {o}/a.json",
        "calibrate piece.recording.h5 --refine {f} --out {o}/a.json",
    ), ("piece.recording.h5", "events.txt")),
    Kind("dot grid pickle", "grid.pkl", "bytes", ("calibrate --import {f} --out {o}/a.json",)),
    Kind("DSEC", "events.h5", "hdf5", _IMPORT),
    Kind("text", "events.txt", "text", _IMPORT),
    Kind("AEDAT4", "events.aedat4", "bytes", _IMPORT),
    Kind("Prophesee RAW", "events.raw", "bytes", _IMPORT),
    Kind("Prophesee DAT", "events.dat", "bytes", _IMPORT),
    *(
        Kind(name, file, mutation, (*_IMPORT, *([_FRAMES] if file.endswith(".aedat4") else [])))
        for name, (file, mutation) in {**event_files.FILES, **bags.FILES}.items()
    ),
    Kind("EVT3", "evt3.raw", "bytes", _IMPORT),
    Kind("MCAP of a trial", "trial.mcap", "bytes", _IMPORT),
    Kind("camera words", "words.bin", "bytes", ("wire words {f}",)),
    Kind("servo answers", "answers.bin", "bytes", ("wire answers {f}",)),
    Kind(
        "recording with streams",
        "attached.recording.h5",
        "hdf5",
        (
            *_INSPECT,
            "trim {f} --from-ms 10 --to-ms 60 --out {o}/a.recording.h5",
            "view {f} --images 5 --out {o}/a.html",
            "attach {f} --stream again=pose.csv --out {o}/a.recording.h5",
            "export {f} --format text --out {o}/a.txt",
        ),
        ("pose.csv",),
    ),
    Kind("CSV of a stream", "pose.csv", "text", _ATTACH, ("piece.recording.h5",)),
    Kind("Parquet of a stream", "pose.parquet", "bytes", _ATTACH, ("piece.recording.h5",)),
    Kind("Parquet, written anew", "pose.parquet", "parquet", _ATTACH, ("piece.recording.h5",)),
    Kind("sensor", "own.sensor.toml", "text", (
        "record --scene short.toml --sensor {f} --dry-run",
        "record --scene short.toml --sensor {f} --out {o}/a.recording.h5",
        "record --sensor {f} --scene press --dry-run",
    ), ("short.toml",)),
    Kind("bag of streams", "trial.bag", "bytes", (
        *(f"{_ATTACH[0].replace('{f}', '{f}:')}{topic}" for topic in ("/pose", "/image", "/packed")),
    ), ("piece.recording.h5",)),
    Kind("scene", "short.toml", "text", (
        "record --scene {f} --dry-run", "grasp --scene {f} --dry-run", "record --scene {f} --out {o}/a.recording.h5"
    )),
    Kind("parameters", "parameters.toml", "text", (
        "track piece.recording.h5 --config {f} --out {o}/a.tracks.h5",
        "label piece.recording.h5 --config {f} --out {o}/a.labels.h5",
        "record --config {f} --dry-run",
    ), ("piece.recording.h5",)),
)  # fmt: skip


def make(folder: Path) -> None:
    """Make the corpus in a folder, unless it exists."""
    if (folder / "complete").exists() and all((folder / kind.file).exists() for kind in KINDS):
        return
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "short.toml").write_text(_short_scene())
    for line in COMMANDS.strip().splitlines():
        command = [sys.executable, "-P", "-m", "evetac_cli", *line.split(), "--quiet", "--force"]
        subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    _break_off(folder / "piece.recording.h5", folder / "broken.recording.h5")
    with open_recording(folder / "piece.recording.h5") as recording:
        events = recording.between(0, 60)
    wire.write_words(folder / "words.bin", events.part(0, 20_000))
    wire.write_answers(folder / "answers.bin")
    _write_raw(folder / "events.raw", events.t[:20_000])
    _write_dat(folder / "events.dat", *(column[:20_000] for column in events))
    event_files.write(folder, events.part(0, event_files.EVENTS))
    bags.write(folder, events.part(0, bags.EVENTS))
    _write_streams(folder)
    tables.write(folder)
    attach = ("attach", "piece.recording.h5", "--stream", "arm=pose.csv", "--stream", "wrist=trial.bag:/image")
    command = [sys.executable, "-P", "-m", "evetac_cli", *attach, "--out", "attached.recording.h5", "--quiet"]
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    (folder / "parameters.toml").write_text(
        '[track]\npreset = "paper"\nstep_size = 0.01\n'
        '[label]\nmethod = "event-flow"\n[record]\nscene = "slip"\nseed = 3\n'
    )
    (folder / "complete").touch()


def copy(kind: Kind, corpus: Path, folder: Path) -> Path:
    """Copy the file of a kind and its companions into an empty folder; return the path of the copy to mutate."""
    target = folder / kind.file
    if (corpus / kind.file).is_dir():
        shutil.copytree(corpus / kind.file, target)
    else:
        shutil.copy(corpus / kind.file, target)
    for name in kind.companions:
        (folder / name).symlink_to(corpus / name)
    return target


def _short_scene() -> str:
    """Return the slip scene, shortened so that it slips within a second, with a coarse gel."""
    changes = {
        "name": '"short"',
        "rest_s": "0.05",
        "load_s": "0.05",
        "hold_s": "0.05",
        "after_lost_s": "0.02",
        "longest_s": "4.0",
        "start_factor": "[1.2, 1.25]",
        "friction_factor": "[0.1, 0.12]",
    }
    lines = []
    for line in (SCENES / "slip.toml").read_text().splitlines():
        key = line.split("=")[0].strip()
        lines.append(f"{key} = {changes.pop(key)}" if "=" in line and key in changes else line)
    if changes:
        raise SystemExit(f"the slip scene has no {', '.join(changes)}")
    return "\n".join([*lines, "", "[solver]", "node_pitch_mm = 1.667"]) + "\n"


def _write_streams(folder: Path) -> None:
    """Write an arm's pose and a camera's images over 60 ms: CSV, Parquet, and a ROS 1 bag."""
    import cv2
    import pandas
    from rosbags import rosbag1
    from rosbags.typesys import Stores, get_typestore

    t_ms = np.arange(0, 60, 5)
    frame = pandas.DataFrame({"t_ms": t_ms, "x_m": np.sin(t_ms / 10), "fz [N]": t_ms / 7, "frame": "base"})
    frame.to_csv(folder / "pose.csv", index=False)
    frame.to_parquet(folder / "pose.parquet")
    store = get_typestore(Stores.ROS1_NOETIC)
    types = {name.rpartition("/")[2]: type_ for name, type_ in store.types.items()}
    image = np.random.default_rng(5).integers(0, 256, (12, 16, 3), np.uint8)
    png = cv2.imencode(".png", image)[1].reshape(-1)
    with rosbag1.Writer(folder / "trial.bag") as bag:
        for at in t_ms.tolist():
            stamp = store.types["builtin_interfaces/msg/Time"](0, at * 10**6 + 1000)
            header = types["Header"](0, stamp, "base")
            pose = types["Pose"](types["Point"](at / 60, 0.0, 0.1), types["Quaternion"](0.0, 0.0, 0.0, 1.0))
            messages = {
                "/pose": types["PoseStamped"](header, pose),
                "/image": store.types["sensor_msgs/msg/Image"](header, 12, 16, "rgb8", 0, 48, image.reshape(-1)),
                "/packed": types["CompressedImage"](header, "png", png),
            }
            for topic, message in messages.items():
                known = {one.topic: one for one in bag.connections}
                connection = known.get(topic) or bag.add_connection(topic, message.__msgtype__, typestore=store)
                bag.write(connection, at * 10**6, store.serialize_ros1(message, message.__msgtype__))


def _break_off(source: Path, target: Path) -> None:
    """Write the segments of a recording whose process was killed: three segments of 20 slices."""
    recipe = Recipe("recording", 1, {"setup": {"camera": "replay"}}, parents=())
    with open_recording(source) as recording:
        static = {**recording.sensor_datasets(), "t_offset": np.int64(0)}
        writer = RecordingWriter(target, static, recipe=recipe)
        for number, events in enumerate(recording):
            writer.append(events)
            if number % 20 == 19:
                writer.close_segment()
        writer.leave()


def _write_raw(path: Path, t_us: np.ndarray) -> None:
    """Write Prophesee RAW, EVT 2.0: time-high words, and for each time an ON event at column 5, row 7."""
    words = []
    high = -1
    for t in t_us.tolist():
        if t >> 6 != high:
            high = t >> 6
            words.append(0x8 << 28 | high & 0xFFFFFFF)
        words.append(1 << 28 | (t & 63) << 22 | 5 << 11 | 7)
    path.write_bytes(b"% evt 2.0\n% geometry 640x480\n% end\n" + np.array(words, "<u4").tobytes())


def _write_dat(path: Path, t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> None:
    """Write Prophesee DAT, version 2, CD events."""
    rows = np.zeros(len(t), [("t", "<u4"), ("word", "<u4")])
    rows["t"] = t
    rows["word"] = x.astype(np.uint32) | y.astype(np.uint32) << 14 | p.astype(np.uint32) << 28
    head = b"% Data file containing CD events.\n% Version 2\n% Width 640\n% Height 480\n"
    path.write_bytes(head + struct.pack("BB", 12, 8) + rows.tobytes())
