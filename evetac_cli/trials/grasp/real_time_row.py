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
from evetac_cli.trials.session import MEDIAN, P99, figure


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
    late, commands = recorded.late_slices, len(recorded.step_late_us)
    too_slow = session.too_slow(datasets, recorded.slices, late, commands, recorded.behind_s)
    return outcome(
        trial,
        made=True,
        simulated=recipe.simulated,
        slices=recorded.slices,
        ended=recorded.ended,
        latency_us_median=figure(datasets, "latency_us", MEDIAN),
        latency_us_p99=figure(datasets, "latency_us", P99),
        step_late_us_p99=figure(datasets, "step_late_us", P99),
        command_us_median=figure(datasets, "command_us", MEDIAN),
        slices_per_s=figure(datasets, "slices_per_s"),
        commands_per_s=figure(datasets, "commands_per_s"),
        **_of_second(trial, recorded),
        commands=commands,
        command_misses=_whole(datasets.get("capture/command_misses")),
        command_misses_by_gripper=_whole(datasets.get("capture/command_misses_by_gripper")),
        latencies=len(recorded.latency_us),
        late_slices=late.count,
        recorder_behind_s=recorded.behind_s,
        too_slow=too_slow,
        detector_core_share=None if recorded.detector is None else recorded.detector.core_share,
        scheduling=datasets["capture/scheduling"],
        **session.lost_columns(datasets),
        **grasp_outcome,
    )


def _of_second(trial: DeviceGrasp, recorded: RecordedGrasp) -> dict[str, Any]:
    """Return the figures of the second finger, if it has a camera."""
    if recorded.second is None:
        return {}
    datasets, second = recorded.second_datasets(), recorded.second
    return {
        "second_output": str(trial.outputs[1]) if second.slices else None,
        "second_slices": second.slices,
        "second_slices_per_s": float(datasets.get("capture/slices_per_s", math.nan)),
        "second_slice_late_us_p99": figure(datasets, "slice_late_us", P99),
        "second_late_slices": second.late_slices.count,
        "second_detector_core_share": None if second.detector is None else second.detector.core_share,
        **{f"second_{name}": value for name, value in session.lost_columns(datasets).items()},
        "clock_offset_us": recorded.clock_offset_us,
    }


def _whole(value: Any) -> int | None:
    return None if value is None else int(value)
