"""info: the figures of stage files, and their provenance."""

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.console import first_rows, format_value, print_table, print_text
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.events import SLICES_PER_S
from evetac_cli.inspect import folder
from evetac_cli.jobs import LookCall, Outcome
from evetac_cli.kernels.calibration.grid import in_words
from evetac_cli.kernels.slip.covariates import SlipCovariates, unknown_covariates
from evetac_cli.pages.shared import KNOWN, inner, stiffness
from evetac_cli.stages.model_files import TRUE_SLIP_SHARE, labelled_by, learned_true_slip_share, read_curve
from evetac_cli.stages.related_files import check_made_from
from evetac_cli.store.files import StageFile, output_path
from evetac_cli.store.recordings import slip_grid, streams
from evetac_cli.store.recordings.onset import abstains, covariates_of_labels, covariates_of_truth, labelled_onset
from evetac_cli.store.recordings.read import Recording
from evetac_cli.text_files import parse_json

RGB_BYTES_S = 540 * 480 * 3 * 25  # the paper's RGB sensor
EVENT_BYTES = 5
LOST = "capture/lost/"
HIDDEN = ("history", "parameters", "parents", "made", "file")  # in --json, but not in the text
NUMBERS = {"version": "schema version", "method": "method version"}  # labels in the text
VALIDATED = ("validation/detected_share", "validation/slip_share")  # of a model
MOST_PARENTS = 10  # lines; a model may have hundreds of parents
OPTIONAL_GROUPS = ("gripper", "truth", "control", "capture", "marks", "streams")  # of a recording


def look(call: LookCall) -> Outcome:
    """Describe files, or list those of a folder; errors of single files hide no others."""
    paths, conditions = call.paths, call.params.where or ()
    if len(paths) == 1 and paths[0].is_dir():
        return folder.answer(paths[0], conditions, call.progress)
    if conditions:
        found = ", ".join(map(str, paths))
        raise InputError("searches the files of a folder", where="--where", expected="one folder", found=found)
    return run(call.files(), call.errors)


def run(files: list[Path], errors: list[EvetacError] | None = None) -> Outcome:
    """Return a row for every file, with its figures and its history; with `errors`, those of files go there."""
    rows = []
    for path in files:
        try:
            rows.append(_describe(path))
        except EvetacError as error:
            if errors is None:
                raise
            errors.append(error)
    return Outcome(rows, any(row["simulated"] for row in rows), {"files": len(rows)})


def show(result: Outcome, *, verbose: bool = False) -> None:
    """Print a block for each file: figures first, then its provenance. Of a folder, a table of its files or counts."""
    if "folder" in result.summary:
        rows = folder.for_people(result.rows)
        shown = rows if verbose else first_rows(rows)
        print_table("info", shown, result.summary, simulated=result.simulated, verbose=verbose)
        return
    for row in result.rows:
        figures = {name: value for name, value in row.items() if name not in HIDDEN}
        print_text(f"{row['file']}" + ("  (simulated)" if row["simulated"] else ""))
        for name, value in figures.items():
            print_text(f"  {NUMBERS.get(name, name):<24} {format_value(value)}")
        print_text(f"  {'made':<24} {row['made'].get('at', '?')} by evetac {row['made'].get('evetac', '?')}")
        for line in _ancestry(row):
            print_text(f"  {line}")
    if len(result.rows) > 1:
        common = [{"file": row["file"], "kind": row["kind"], "id": row["id"][:12]} for row in result.rows]
        print_table("info", common, result.summary, simulated=result.simulated)


def _ancestry(row: dict[str, Any]) -> Iterator[str]:
    """Yield lines that name the parents of a file and count its other ancestors; --json has all of them."""
    parents = [ancestor for ancestor in row["history"] if ancestor["id"] in row["parents"]]
    for parent in parents[:MOST_PARENTS]:
        yield f"from {parent['kind']:<19} {parent['id'][:12]}  method version {parent['method']}"
    more = parents[MOST_PARENTS:]
    deeper = [ancestor for ancestor in row["history"] if ancestor["id"] not in row["parents"]]
    for name, ancestors in (("and from", more), ("behind these", deeper)):
        if ancestors:
            kinds = Counter(str(ancestor["kind"]) for ancestor in ancestors)
            yield f"{name:<24} {', '.join(f'{count} {kind}' for kind, count in kinds.items())} (all: --json)"


@contextmanager
def _contents_in_words(path: Path) -> Iterator[None]:
    """Turn errors while computing figures into InputError.

    A file may have the right datasets but impossible values, for example an epoch that does not exist: `info` also
    shows files that other commands refuse.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError) as error:
        raise InputError(
            "the file's contents are inconsistent",
            where=str(path),
            found=f"{type(error).__name__}: {error}",
            hint=f"evetac validate {path}",
        ) from error


def _describe(path: Path) -> dict[str, Any]:
    with _opened(path) as file, _contents_in_words(path):
        file.check()  # all of it, because the figures describe the whole file
        header = file.header
        common: dict[str, Any] = {
            "file": str(path),
            "kind": file.kind,
            "version": header["version"],
            "id": header["id"],
            "method": header["method"],
            "seed": header["seed"],
            "simulated": header["simulated"],
        }
        row = common | _FIGURES[file.kind](file) | common  # a report's own figures never replace these
        row["size_bytes"] = path.stat().st_size
        row["parameters"] = header["parameters"]
        row["made"] = dict(header.get("made", {}))
        row["parents"] = header["parents"]
        ancestors = header["ancestors"] if "ancestors" in header else header["history"]
        row["history"] = [
            {"id": id_, "kind": str(ancestor["kind"])}
            | {key: ancestor[key] for key in ("method", "parameters", "seed", "parents") if key in ancestor}
            for id_, ancestor in ancestors.items()
        ]
    return row


def _opened(path: Path) -> StageFile:
    """Open a file, as a recording if name and contents agree, so that it is opened only once."""
    if path.name.endswith(".recording.h5"):
        with suppress(InputError):  # opened below as any other file, with the same messages
            return Recording(path)
    return StageFile(path)


def _recording(file: StageFile) -> dict[str, Any]:
    with nullcontext(file) if isinstance(file, Recording) else Recording(file.path) as recording:
        per_slice = np.diff(recording.starts)
        seconds = len(recording) / SLICES_PER_S
        bytes_s = EVENT_BYTES * recording.event_count / seconds if seconds else 0.0
        width, height = recording.frame_px
        grid = recording.dot_xy_px
        return {
            "duration_s": seconds,
            "slices": len(recording),
            "slices_empty": int(np.sum(per_slice == 0)),
            "events": recording.event_count,
            "events_a_slice_mean": float(per_slice.mean()) if len(per_slice) else 0.0,
            "events_a_slice_most": int(per_slice.max(initial=0)),
            "data_rate_bytes_s": bytes_s,
            "data_rate_to_rgb": bytes_s / RGB_BYTES_S,
            "frame_px": f"{width} x {height}",
            "sensor": recording.read("sensor/name"),
            "dots": "none" if grid is None else in_words(*grid.shape[:2]),
            "window_px": "none" if recording.window_px is None else "{} {} {} {}".format(*recording.window_px),
            "groups": " ".join(filter(recording.has, OPTIONAL_GROUPS)) or "none",
            **_slip(recording),
            **_slip_grid(recording),
            **({"marks": streams.marks_in_words(recording.marks)} if recording.has("marks") else {}),
            **_streams(recording),
            **(_capture(file) if recording.has("capture") else {}),
            **_import(file.header["parameters"]),
        }


def _slip_of(recording: Recording) -> tuple[str, SlipCovariates | None]:
    """Return the source of a recording's slip, `truth` or `labels`, and its covariates; None if it is unknown."""
    if recording.has("truth/slip"):
        return "truth", covariates_of_truth(recording)
    path = output_path(recording.path, "labels", None)
    if path.exists():
        with suppress(EvetacError), StageFile(path, "labels") as labels:  # `validate` reports faults of the labels
            check_made_from(labels, recording)
            return "labels", covariates_of_labels(recording, labels)
    return "", None


def _slip(recording: Recording) -> dict[str, Any]:
    """Return the covariates of a recording's slip, their source, and the unknown ones; {} without slip."""
    source, slip = _slip_of(recording)
    if slip is None:
        return {}
    missing = unknown_covariates([slip])
    return {
        "slip_onset_ms": slip.onset_ms,
        "slip_source": source,
        **slip.figures(),
        **({"slip_unknown": ", ".join(missing)} if missing else {}),
    }


def _slip_grid(recording: Recording) -> dict[str, Any]:
    """Return, for a simulated recording with unstable slip, the nodes that resolve it, and a warning if too few."""
    nodes = slip_grid.nodes_of(recording)
    if nodes is None:
        return {}
    if not slip_grid.is_unresolved(nodes):
        return {slip_grid.COLUMN: nodes}
    from evetac_cli.sim.setup.plan import read_plan  # imported here because few files need it

    pitch_mm = None  # the header of a trimmed or imported recording does not state it
    with suppress(InputError):
        pitch_mm = read_plan(recording.header["parameters"], str(recording.path)).scene.solver.node_pitch_mm
    return {slip_grid.COLUMN: nodes, "warning": slip_grid.unresolved(nodes, pitch_mm)}


def _streams(recording: Recording) -> dict[str, str]:
    """Return a text for each other stream: its content, number of samples, rate, and time span."""
    shapes = recording.contents()
    figures = {}
    for name in streams.names(shapes):
        group = f"{streams.GROUP}/{name}"
        samples = recording.length(f"{group}/t_us")
        parts = [str(parse_json(recording.read(f"{group}/about")).get("what") or "") or "numbers"]
        columns = [path for path in shapes if path.startswith(f"{group}/") and path.count("/") == 2]
        if f"{group}/frames" in shapes:
            _, height, width, _ = shapes[f"{group}/frames"][1]
            parts.append(f"{samples} frames of {width} x {height} px")
        else:
            count = len(columns) - 2  # without t_us and about
            parts.append(f"{samples} samples of {count} column{'s' * (count != 1)}")
        if samples:
            first_s, last_s = (int(recording.read(f"{group}/t_us", at, at + 1)[0]) / 1e6 for at in (0, samples - 1))
            if last_s > first_s:
                parts.append(f"{(samples - 1) / (last_s - first_s):.4g} Hz")
            parts.append(f"{first_s:.3f} to {last_s:.3f} s")
        figures[f"stream_{name}"] = ", ".join(parts)
    return figures


def _capture(file: StageFile) -> dict[str, Any]:
    """Return how a recording from devices ended, its losses, and the rates and delays that were recorded."""
    from evetac_cli.devices import losses  # imported here because most recordings are not from devices

    contents = file.contents()
    counted = {name.removeprefix(LOST): int(file.read(name)) for name in contents if name.startswith(LOST)}
    gaps = file.read("capture/lost_slices") if "capture/lost_slices" in contents else np.zeros((0, 2))

    def figure(name: str) -> Any:
        return file.read(f"capture/{name}").item() if f"capture/{name}" in contents else None

    def late_us(name: str) -> float | None:
        return float(file.read(f"capture/{name}")[1]) if f"capture/{name}" in contents else None

    figures = {
        "ended": file.read("capture/ended"),
        "lost": losses.events_lost(counted) or "nothing",
        "lost_why": losses.reasons(counted),
        "slices_lost": int(np.sum(gaps[:, 1] - gaps[:, 0])),
        "slices_per_s": figure("slices_per_s"),
        "slice_late_us_p99": late_us("slice_late_us"),
        "commands_per_s": figure("commands_per_s"),
        "command_misses": figure("command_misses"),
        "command_misses_by_gripper": figure("command_misses_by_gripper"),
        "latency_us_p99": late_us("latency_us"),
    }
    return {name: value for name, value in figures.items() if value is not None}


def _import(parameters: dict[str, Any]) -> dict[str, Any]:
    """Return the source of an imported recording, and the notes of its reader."""
    if "notes" not in parameters or "format" not in parameters:
        return {}
    return {
        "source": f"{parameters['source']} ({parameters['format']})",
        "events_dropped": sum(parameters.get("dropped", {}).values()),
        "notes": "; ".join(parameters["notes"]) or "none",
    }


def _labels(file: StageFile) -> dict[str, Any]:
    label = file.read("label")
    return {
        "slices": len(label),
        **labelled_onset(file).row(),
        "slices_slip": int(np.sum(label == 1)),
        "slices_not_examined": int(np.sum(label < 0)),
        "flow_pairs_computed": int(file.read("flow_pairs_computed")),
    }


def _tracks(file: StageFile) -> dict[str, Any]:
    dots = file.read("dot_xy_px")
    moved = np.linalg.norm(dots - file.read("sensor/dot_xy_px").reshape(1, -1, 2), axis=2)
    return {
        "slices": len(dots),
        "dots": dots.shape[1],
        "preset": file.header["parameters"]["preset"],
        "moved_px_most": float(np.fmax.reduce(moved, axis=None)) if moved.size else 0.0,  # NaN if all dots are lost
        "dots_lost_at_end": int(file.read("lost")[-1].sum()) if len(dots) else 0,
    }


def _features(file: StageFile) -> dict[str, Any]:
    rows, columns = file.read("dot_shape").tolist()
    onset = int(file.read("onset_slice")) if file.has("onset_slice") else -1
    return {
        "slices": file.length("events_total"),
        "dots": in_words(rows, columns),
        "labelled": file.has("label"),
        "abstained": abstains(file),
        "true_slip_share": file.has(TRUE_SLIP_SHARE),
        "onset_ms": None if onset < 0 else onset,
    }


def _model(file: StageFile) -> dict[str, Any]:
    return {
        "architecture": file.read("architecture"),
        "preset": file.header["parameters"].get("preset"),
        "labels": labelled_by(file.header) or None,
        "learned_true_slip_share": learned_true_slip_share(file.header),
        "history_ms": int(file.read("history")),
        "parameters_trained": sum(
            int(np.prod(shape)) for name, (_, shape) in file.contents().items() if name.endswith((".weight", ".bias"))
        ),
        "threshold": float(file.read("threshold")),
        **_warnings(file),
        **{name.replace("/", "_"): float(file.read(name)) for name in VALIDATED if file.has(name)},
        "steps": int(file.read("curve/step")[-1]),
        "loss": float(file.read("curve/loss")[-1]),
    }


def _warnings(file: StageFile) -> dict[str, Any]:
    """Return the false alarms of a model at its threshold, and the data that calibrated its probabilities."""
    figures: dict[str, Any] = {}
    if (curve := read_curve(file)) is not None:
        false, warned = curve.at(float(file.read("threshold")))
        figures |= {
            "false_alarms_per_min": false if curve.minutes else None,
            "minutes_without_slip": curve.minutes,
            "warned_10_ms_ahead": warned,
            "slips_validated_on": curve.slips,
        }
    on = (
        f"{file.read('calibration/slices')} slices of {file.read('calibration/on')}"
        if file.has("calibration")
        else None
    )
    return figures | {"calibrated_on": on}


def _force_model(file: StageFile) -> dict[str, Any]:
    if file.has("adapted"):
        modulus = float(file.read("adapted/shear")[:, 0].mean()) * 1e6
        return {
            "sensor": file.read("sensor"),
            "sensor_name": file.read("sensor_name"),
            "dots": "any grid",
            "adapted_shear_modulus_pa": modulus,
        }
    rows, columns = file.read("dot_shape").tolist()
    epoch = int(file.read("curve/chosen"))
    return {
        "sensor": file.read("sensor"),
        "sensor_name": file.read("sensor_name"),
        "dots": in_words(rows, columns),
        "epoch": epoch + 1,
        "held_out_n_rms": float(file.read("curve/held_out_n")[epoch]),
    }


def _touch(file: StageFile) -> dict[str, Any]:
    """Return contacts, largest forces, smallest sticking share, standard deviations, touch maps, and stiffness."""
    touches, is_known = file.read("touches"), file.read("known")
    begun = np.flatnonzero(np.diff(touches, prepend=np.uint8(0)) == 1)
    shear_sd_n = file.read("shear_sd_n").max(axis=1)  # of the less certain axis, as in the output of predict-touch
    most = {
        "shear_n": (np.linalg.norm(file.read("shear_n"), axis=1), shear_sd_n),
        "normal_n": (file.read("normal_n"), file.read("normal_sd_n")),
        "torsion_n_mm": (np.abs(file.read("torsion_n_mm")), file.read("torsion_sd_n_mm")),
        "area_mm2": (file.read("area_mm2"), file.read("area_sd_mm2")),
    }
    return {
        "slices": len(is_known),
        "slices_unknown": int(np.sum(is_known == 0)),
        "contacts": len(begun),
        "contact_s": float(touches.sum() / SLICES_PER_S),
        "first_contact_ms": int(begun[0]) if len(begun) else None,
        **{
            f"{name}_most{which}": value
            for name, (values, sd) in most.items()
            for which, value in _extreme(np.where(touches, values, np.nan), sd)
        },
        **{
            f"sticking_share_least{which}": value
            for which, value in _extreme(file.read("sticking_share"), file.read("sticking_share_sd"), lowest=True)
        },
        "maps": _touch_maps(file),
        "stiffness": _stiffness(file.header),
    }


def _stiffness(header: Mapping[str, Any]) -> str:
    """Return how well the stiffness is known, with the modulus and its relative error if the header has them."""
    which, parameters = stiffness(header), header["parameters"]
    if which != KNOWN:
        return which
    modulus_pa, error = inner(parameters, "known", "shear_modulus_pa"), parameters.get("stiffness_error")
    within = f" within {100 * error:.3g} %" if isinstance(error, float) else ""
    return f"known, {modulus_pa / 1e3:.4g} kPa{within}"


def _extreme(values: Floats, sd: Floats, *, lowest: bool = False) -> Iterator[tuple[str, float | None]]:
    """Yield the highest or lowest value and its standard deviation; None if no slice has one."""
    finite = np.flatnonzero(np.isfinite(values))
    at = None if not len(finite) else finite[(np.argmin if lowest else np.argmax)(values[finite])]
    yield "", None if at is None else float(values[at])
    yield "_sd", None if at is None or not np.isfinite(sd[at]) else float(sd[at])


def _touch_maps(file: StageFile) -> str:
    """Return a text on the number of maps, their cells, and their interval."""
    if not file.has("map/slice"):
        return "none"
    x_mm, y_mm, count = file.read("map/x_mm"), file.read("map/y_mm"), file.length("map/slice")
    pitch_mm = f" of {np.median(np.diff(x_mm)):.3g} mm" if len(x_mm) > 1 else ""
    every_ms = np.median(np.diff(file.read("map/slice"))) if count > 1 else np.nan
    often = f", every {every_ms:g} ms" if np.isfinite(every_ms) else ""
    return f"{count} of {len(x_mm)} x {len(y_mm)} cells{pitch_mm}{often}"


def _report(file: StageFile) -> dict[str, Any]:
    summary = parse_json(file.read("summary"))
    if not isinstance(summary, dict):
        raise ValueError("the summary is not a table")
    return {"command": file.read("command"), **summary}


_FIGURES = {
    "recording": _recording,
    "labels": _labels,
    "tracks": _tracks,
    "features": _features,
    "model": _model,
    "force-model": _force_model,
    "touch": _touch,
    "report": _report,
}
