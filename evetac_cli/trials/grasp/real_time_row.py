"""The row of a real-time grasp: its outcome, how well time was kept, and what the computer was too slow for."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from evetac_cli.errors import DeviceError
from evetac_cli.jobs import Outcome, outcome
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.trials import session
from evetac_cli.trials.grasp.recorded_grasp import RecordedGrasp
from evetac_cli.trials.grasp.settings import DeviceGrasp


def result_of(
    trial: DeviceGrasp,
    recipe: Recipe,
    recorded: RecordedGrasp,
    datasets: Mapping[str, Any],
    grasp_outcome: Mapping[str, Any],
    saved: Path | None,
    say: Callable[[str], None],
    *,
    interrupted: bool,
) -> Outcome:
    """Return the row of a grasp; an error or Ctrl-C is raised again here with the saved files."""
    result = None
    if recorded.has_steps:
        result = _row(trial, recipe, recorded, datasets, grasp_outcome)
        if result.rows[0]["too_slow"] is not None:
            say(result.rows[0]["too_slow"])
    words = f"{recorded.slices:,} slices in {session.place(saved)}" if saved else "nothing was recorded"
    session.raise_end(recorded.error, recorded.ended, words, result, recorded.torque, interrupted=interrupted)
    if result is None and recorded.ended == session.STOPPED:
        return Outcome([], recipe.simulated, made=False)
    if result is None:
        raise DeviceError("the grasp ended before its first step", found=recorded.ended)
    return result


def _row(
    trial: DeviceGrasp,
    recipe: Recipe,
    recorded: RecordedGrasp,
    datasets: Mapping[str, Any],
    grasp_outcome: Mapping[str, Any],
) -> Outcome:
    """Return the figures of a grasp that has a file."""
    timing: dict[str, float | None] = {}
    for name, path, index in (
        ("latency_us_median", "latency_us", 0),
        ("latency_us_p99", "latency_us", 1),
        ("step_late_us_p99", "step_late_us", 1),
        ("command_us_median", "command_us", 0),
    ):
        values = datasets.get(f"capture/{path}")
        timing[name] = None if values is None else float(values[index])
    for name in ("slices_per_s", "commands_per_s"):
        timing[name] = float(datasets[f"capture/{name}"]) if f"capture/{name}" in datasets else None
    late, commands = recorded.late_slices, len(recorded.step_late_us)
    load = None if recorded.detector is None else recorded.detector.load
    used = "; ".join(words for words in (recorded.cores_used, "" if load is None else load.words()) if words)
    too_slow = session.too_slow(datasets, recorded.slices, late, commands, recorded.behind_s, used)
    return outcome(
        trial,
        made=True,
        simulated=recipe.simulated,
        slices=recorded.slices,
        ended=recorded.ended,
        **timing,
        **_of_second(trial, recorded),
        commands=commands,
        command_misses=_whole(datasets.get("capture/command_misses")),
        command_misses_by_gripper=_whole(datasets.get("capture/command_misses_by_gripper")),
        latencies=len(recorded.latency_us),
        late_slices=late.count,
        recorder_behind_s=recorded.behind_s,
        too_slow=too_slow,
        detector_core_share=None if load is None else load.core_share,
        events_per_s=None if load is None else load.events_per_s,
        bearable_events_per_s=None if load is None else load.bearable_events_per_s,
        scheduling=datasets["capture/scheduling"],
        **session.lost_columns(datasets),
        **grasp_outcome,
    )


def _of_second(trial: DeviceGrasp, recorded: RecordedGrasp) -> dict[str, Any]:
    """Return the figures of the second finger, if it has a camera."""
    if recorded.second is None:
        return {}
    datasets, second = recorded.second_datasets(), recorded.second
    load = None if second.detector is None else second.detector.load
    late_us = datasets.get("capture/slice_late_us")
    return {
        "second_output": str(trial.outputs[1]) if second.slices else None,
        "second_slices": second.slices,
        "second_slices_per_s": float(datasets.get("capture/slices_per_s", math.nan)),
        "second_slice_late_us_p99": None if late_us is None else float(late_us[1]),
        "second_late_slices": second.late_slices.count,
        "second_detector_core_share": None if load is None else load.core_share,
        **{f"second_{name}": value for name, value in session.lost_columns(datasets).items()},
        "clock_offset_us": recorded.clock_offset_us,
    }


def _whole(value: Any) -> int | None:
    return None if value is None else int(value)
