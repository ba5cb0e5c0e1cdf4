"""Refuses options of recordings, grasps and force models that would have no effect: none is ignored silently."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import fields
from enum import StrEnum

from evetac_cli.devices.cameras import NamedCamera
from evetac_cli.devices.grippers import NamedGripper
from evetac_cli.errors import InputError
from evetac_cli.params.grasp import Grasp
from evetac_cli.params.learning import PredictForce, TrainForce
from evetac_cli.params.parameter import flag_of
from evetac_cli.params.recording import Record
from evetac_cli.params.trials import SOLVER_OPTIONS


class Source(StrEnum):
    """Parts of a run that options belong to: where its events come from, and what it commands."""

    IMPORT = "an import (--from)"
    SCENE = "a simulated scene (--camera sim or virtual)"
    STEPPED = "a simulated scene in its own time (--camera sim)"
    DEVICE = "a device (--camera virtual, dvxplorer, dv or replay:FILE)"
    RECORDED = "a recording from a device (--camera virtual, dvxplorer, dv or replay:FILE)"
    SENSOR = "a camera that can be set up (--camera virtual, dvxplorer or dv)"
    MOVED = "a gripper that is moved (--gripper virtual or PORT)"
    PREVIEW = "--preview"
    SHOWN = "what is shown (--live or --preview)"
    GRASPED = "a grasp with devices (--camera virtual, dvxplorer or dv)"


# Options that are not listed have an effect in every run, or their stage checks how they fit together.
RECORD: dict[str, tuple[Source, ...]] = {
    **dict.fromkeys(("scene", "objects", "sensor", "gel", "texture", "readout", *SOLVER_OPTIONS), (Source.SCENE,)),
    "tones": (Source.STEPPED,),
    **dict.fromkeys(("count", "seed", "live", "preview"), (Source.SCENE, Source.DEVICE)),
    "live_in": (Source.SHOWN,),
    **dict.fromkeys(
        ("frame_size", "sort", "drop_late", "from_restart", "stream", "columns", "time_unit", "frames"),
        (Source.IMPORT,),
    ),
    "calibration": (Source.IMPORT, Source.RECORDED, Source.PREVIEW),
    "gripper": (Source.SCENE, Source.DEVICE),
    "seconds": (Source.DEVICE, Source.PREVIEW),
    **dict.fromkeys(
        ("closing_ma", "holding_ma", "hold_s", "lowest_ma", "current_of", "watchdog_ms", "arm"), (Source.MOVED,)
    ),
    **dict.fromkeys(("threshold_on", "threshold_off", "readout_rate"), (Source.SENSOR,)),
    **dict.fromkeys(("expected_event_rate", "resume"), (Source.RECORDED,)),
}
GRASP: dict[str, tuple[Source, ...]] = {
    "live": (Source.SCENE, Source.GRASPED),
    "live_in": (Source.SHOWN,),
    **dict.fromkeys(("objects", "sensor", "gel", "texture", "readout", *SOLVER_OPTIONS), (Source.SCENE,)),
    **dict.fromkeys(("calibration", "arm", "max_current_ma", "max_seconds", "watchdog_ms"), (Source.GRASPED,)),
}


class Training(StrEnum):
    """Ways to a force model that options belong to."""

    PAPER = "a training by the paper's method (--method paper)"
    GEL = "a training for any sensor (--method gel)"
    ADAPTATION = "an adaptation (--adapt)"
    SENSOR = "an adaptation to a sensor of which something is known (--adapt with --sensor)"


TRAIN_FORCE: dict[str, tuple[Training, ...]] = {
    "method": (Training.PAPER, Training.GEL),
    "sensor": (Training.ADAPTATION,),
    "stiffness_error": (Training.SENSOR,),
    "contacts": (Training.GEL,),
    "samples": (Training.PAPER,),
    "noise_n": (Training.PAPER, Training.ADAPTATION),
    "epochs": (Training.PAPER, Training.GEL),
}


class Prediction(StrEnum):
    """What options of a prediction of forces belong to."""

    SENSOR = "a sensor of which something is known (--sensor)"


PREDICT_FORCE: dict[str, tuple[Prediction, ...]] = {"stiffness_error": (Prediction.SENSOR,)}


def refuse_unused_of_record(params: Record, cameras: Sequence[NamedCamera], gripper: NamedGripper) -> None:
    """InputError for an option of record that is not at its default and belongs to nothing that this run has."""
    _refuse(params, RECORD, _record_sources(params, cameras, gripper), _source_flags(params))


def refuse_unused_of_grasp(params: Grasp, camera: NamedCamera) -> None:
    """InputError for an option of grasp that is not at its default and belongs to nothing that this run has."""
    sources = {Source.SCENE} if camera.simulates_scene else set()
    sources |= {Source.GRASPED} if camera.is_adjustable else set()
    _refuse(params, GRASP, sources | ({Source.SHOWN} if params.live else set()), _source_flags(params))


def refuse_unused_of_train_force(params: TrainForce) -> None:
    """InputError for an option of train-force that is not at its default and has no effect in this training."""
    if params.adapt:
        trainings, flags = {Training.ADAPTATION}, f"--adapt {params.adapt}"
        if params.sensor is not None:
            trainings.add(Training.SENSOR)
    else:
        trainings = {Training.GEL if params.method == "gel" else Training.PAPER}
        flags = f"--method {params.method}, no --adapt"
    _refuse(params, TRAIN_FORCE, trainings, flags)


def refuse_unused_of_predict_force(params: PredictForce) -> None:
    """InputError for an option of predict-force that is not at its default and has no effect."""
    _refuse(params, PREDICT_FORCE, set() if params.sensor is None else {Prediction.SENSOR}, "no --sensor")


def _record_sources(params: Record, cameras: Sequence[NamedCamera], gripper: NamedGripper) -> set[Source]:
    if params.source is not None:
        return {Source.IMPORT}
    shown = {Source.SHOWN} if params.live or params.preview else set()
    if cameras[0].is_stepped:
        return {Source.SCENE, Source.STEPPED} | shown | ({Source.PREVIEW} if params.preview else set())
    sources = {Source.DEVICE, Source.PREVIEW if params.preview else Source.RECORDED} | shown
    if any(camera.simulates_scene for camera in cameras):
        sources.add(Source.SCENE)
    if any(camera.is_adjustable for camera in cameras):
        sources.add(Source.SENSOR)
    if gripper.is_moved and not params.preview:
        sources.add(Source.MOVED)
    return sources


def _refuse(
    params: Record | Grasp | TrainForce | PredictForce,
    table: Mapping[str, tuple[StrEnum, ...]],
    parts: Set[StrEnum],
    flags: str,
) -> None:
    for item in fields(params):
        belongs = table.get(item.name)
        if belongs is None or getattr(params, item.name) == item.default or not parts.isdisjoint(belongs):
            continue
        raise InputError(
            f"has no effect in this run: it belongs to {' or '.join(belongs)}",
            where=flag_of(item),
            found=flags,
            hint=f"leave out {flag_of(item)}",
        )


def _source_flags(params: Record | Grasp) -> str:
    """The flags that say where events come from."""
    if isinstance(params, Record) and params.source is not None:
        return f"--from {params.source}"
    gripper = f", --gripper {params.gripper}" if params.gripper is not None else ""
    shown = ", --preview" if isinstance(params, Record) and params.preview else ", --live" if params.live else ""
    return f"--camera {params.camera}{gripper}{shown}"
