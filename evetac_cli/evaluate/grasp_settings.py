"""The settings of grasps, by which `evaluate grasp` groups them: controller, detector, and all non-default choices."""

import json
from collections.abc import Sequence
from typing import Any

from evetac_cli.evaluate.source import Source
from evetac_cli.jobs import Rows
from evetac_cli.kernels.grip.load_law import MARGIN
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.store.layout.provenance import Header

USUAL = {"gain": 1.0, "latency_ms": 0, "control_hz": 500.0}  # named in a setting only if they differ from these


def with_detectors(trials: Rows, headers: Sequence[Header]) -> Rows:
    """Return the trials with detector, tracker and threshold, which are None without a detector.

    Where grasps of a report differ in detector or threshold, these words are added to the setting.
    """
    sources: dict[str, dict[str, Any]] = {}
    rows: Rows = []
    for trial, header in zip(trials, headers, strict=True):
        planned = header["parameters"]
        key = json.dumps([header["parents"], planned.get("tracker")], sort_keys=True)
        if key not in sources:
            sources[key] = detector_columns(Source.of([header]))
        rows.append({**trial, **sources[key], "slip_threshold": planned.get("slip_threshold")})
    detectors = {row["slip_detector"] for row in rows} - {None}
    for row in rows:
        words = [f"detector {row['slip_detector']}"] if row["slip_detector"] and len(detectors) > 1 else []
        same = {one["slip_threshold"] for one in rows if one["slip_detector"] == row["slip_detector"]}
        words += [f"threshold {row['slip_threshold']:g}"] if len(same) > 1 else []
        row["setting"] = ", ".join([row["setting"], *words])
    return rows


def detector_columns(source: Source) -> dict[str, Any]:
    """Return the columns that name the detector of a grasp and the trackers of its dots and of the training data."""
    if not source.detectors:
        return {"slip_detector": None, "tracker": None}
    return {"slip_detector": source.detector, "tracker": " + ".join(source.trackers)}


def describe_setting(plan: Plan, planned: dict[str, Any]) -> str:
    """Return the words for a setting: its controller and all non-default choices, without object and trial."""
    words = [planned["controller"]]
    options = {name: planned.get(name, usual) for name, usual in USUAL.items()}
    if options["gain"] != 1.0:
        words.append(f"gain {options['gain']:g}")
    margin = planned.get("law", {}).get("margin", MARGIN) if planned["controller"] == "load-proportional" else MARGIN
    if margin != MARGIN:
        words.append(f"margin {margin:g}")
    if plan.scene.name != "lift":
        words.append(plan.scene.name)
    if plan.sensor_name != "evetac":
        words.append(plan.sensor_name)
    if plan.second is not None:
        words.append("two fingers" if plan.second.name == plan.sensor_name else f"two fingers, {plan.second.name}")
    if not plan.scene.gel.cut:
        words.append("closed gel")
    if options["latency_ms"]:
        words.append(f"{options['latency_ms']} ms late")
    if options["control_hz"] != USUAL["control_hz"]:
        words.append(f"{options['control_hz']:g} Hz")
    return ", ".join(words)


def without_gain(setting: str) -> str:
    """Return the name of a setting without its gain."""
    return ", ".join(word for word in setting.split(", ") if not word.startswith("gain "))
