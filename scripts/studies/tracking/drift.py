"""How far does the tracker `stable` drift from the true dots: at rest, held for a minute, in slow load and in slip?

    python scripts/studies/tracking/drift.py --as NAME [--out docs/results/likeness/drift.json]

Recordings are made in --recordings first, unless they are there. A row has the errors of one recording, without the
motion that all dots share: rms over the dots and over WINDOW_MS, in px per axis. Rows of other names are kept: those of
`before` were made by this file at the commit that they name. `make results` writes the table into
docs/evidence/simulation.md.
"""

import argparse
import itertools
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.jobs import Row, silent
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.presets import PRESETS
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.stages.track import METHOD
from evetac_cli.store.recordings.read import Recording, open_recording
from evetac_cli.trials import grasp, record
from evetac_cli.trials.grasp.settings import SimulatedGrasp
from evetac_cli.trials.trial import SimulatedTrial
from scripts.reproduce.facts import commit_in_words
from scripts.reproduce.table_text import as_table
from scripts.studies import motions
from scripts.studies.likeness.trials import FOLDER, kept, made_by, write
from scripts.studies.motions import EVETAC, Planned
from scripts.studies.slip.recordings import trial_of
from scripts.studies.slip.trials import planned_on

COMMAND = "python scripts/studies/tracking/drift.py"
SEED, RANDOM = 75_500, 6  # of the first trial; number of random sensors for each kind
WINDOW_MS = 100  # over which an error is averaged
KINDS = ("rest", "held", "slip")  # of trials
HELD_S = (1, 10, 60)  # after the hand has stopped, or after the start of a recording at rest
BEFORE_SLIP_MS, IN_SLIP_MS = 60, 30
LEAST_ONSET_MS = 10 * WINDOW_MS  # the load before slip is measured over this time
LAGS_MS = range(16)
FIGURES = (*(f"after_{s}_s" for s in HELD_S), "slow_load", "before_slip", "in_slip", "lag_ms")


def planned(kind: str, place: int) -> Planned:
    """Return a trial at rest for a minute, of an object that is lifted and held, or of one that is unloaded."""
    sensor = EVETAC if place < RANDOM else f"randomized:{SEED + place}"
    number = motions.JUDGED[place % len(motions.JUDGED)]
    if kind == "rest":
        plan = first_plan("rest", "", sensor)
        return Planned(replace(plan, scene=replace(plan.scene, time=replace(plan.scene.time, rest_s=HELD_S[-1] + 0.5))))
    if kind == "held":
        return planned_on(sensor, "lifting", number, SEED + place)._replace(balance_s=HELD_S[-1] + 0.5)
    return planned_on(sensor, "slip", number, SEED + place)


def recorded(kind: str, place: int, folder: Path) -> Path:
    """Return the recording of a trial, which is made first if it is missing."""
    output = folder / f"{kind}-{place:02d}.recording.h5"
    trial = trial_of(planned(kind, place), SEED + place, output)
    if isinstance(trial, SimulatedGrasp):
        grasp.simulated.run(trial, force=False, progress=silent)
    elif isinstance(trial, SimulatedTrial):
        record.simulated.run(trial, force=False, progress=silent)
    return output


def errors_px(recording: Recording) -> tuple[Floats, Floats]:
    """Return the errors of the tracked dots without their mean, and the true dots, (slices, dots, 2)."""
    assert recording.dot_xy_px is not None and recording.dot_radius_px is not None
    rest_px = recording.dot_xy_px.reshape(-1, 2)
    constants = PRESETS["stable"].for_dots(recording.dot_radius_px, recording.sensitivity.contrast_over_threshold)
    state = tracker.start(rest_px, constants, frame_px=recording.frame_px)
    columns = (recording.read(f"events/{name}") for name in "xyp")
    seen_px = tracker.fold(state, *columns, recording.starts).dot_xy_px.astype(float)
    true_px = recording.read("truth/dot_xy_px").reshape(seen_px.shape).astype(float)
    return _apart(seen_px - true_px), true_px


def _apart(px: Floats) -> Floats:
    apart: Floats = px - np.nanmean(px, axis=1, keepdims=True)
    return apart


def _rms(px: Floats) -> float:
    return round(float(np.sqrt(np.nanmean(px**2))), 4)


def measured(kind: str, path: Path) -> Row:
    """Return the errors of one recording."""
    with open_recording(path) as recording:
        own_px, true_px = errors_px(recording)
        slips = recording.read("truth/slip").astype(bool) & (recording.read("truth/normal_force_n") > 0)
    onset = int(np.argmax(slips)) if slips.any() else len(slips)
    if kind != "slip":
        start = len(own_px) - round(1000 * (HELD_S[-1] + 0.5)) if kind == "held" else 0
        ends = {s: start + 1000 * s for s in HELD_S}
        return {f"after_{s}_s": _rms(own_px[end - WINDOW_MS : end]) for s, end in ends.items() if end <= onset}
    if onset < LEAST_ONSET_MS or not slips.any():
        return {}
    before = own_px[onset - BEFORE_SLIP_MS : onset]
    return {
        "slow_load": _rms(own_px[onset - LEAST_ONSET_MS : onset - BEFORE_SLIP_MS]),
        "before_slip": _rms(before),
        "in_slip": _rms(own_px[onset : onset + IN_SLIP_MS]),
        "lag_ms": _lag_ms(own_px, true_px, onset),
    }


def _lag_ms(own_px: Floats, true_px: Floats, onset: int) -> int:
    """Return by how many ms the tracked dots are late around the onset of slip: the lag with the least error."""
    part = slice(onset - BEFORE_SLIP_MS, onset + IN_SLIP_MS)
    seen = own_px + _apart(true_px)

    def off(lag: int) -> float:
        late = _apart(true_px)[part.start - lag : part.stop - lag]
        apart = seen[part] - late
        return float(np.nanmean((apart - apart.mean(axis=0)) ** 2))

    return min(LAGS_MS, key=off)


def as_page(results: Path) -> str:
    """Return the table of docs/evidence/simulation.md."""
    rows = kept(results / FOLDER.name / "drift.json")
    lines, names = [], sorted({row["as"] for row in rows}, reverse=True)
    for sensors, name, kind in itertools.product(("evetac", "random"), names, KINDS):
        of = [row for row in rows if (row["sensors"], row["as"], row["kind"]) == (sensors, name, kind)]
        known = [[row[figure] for row in of if figure in row] for figure in FIGURES]
        n = max(map(len, known))  # a trial without slip, or whose object is lost while it is held, has no figures
        cells = [f"{np.median(values):.3f} ({max(values):.2f})" if values else "" for values in known]
        lines.append([sensors, name, kind, f"{n} of {len(of)}", *cells])
    heads = ["sensors", "tracker", "trials", "counted", *(f"{figure.replace('_', ' ')}" for figure in FIGURES)]
    said = (
        "Simulated; error of the tracked dots in px rms per axis, without the motion that all share: median of the"
        " trials that count, and the largest; a trial does not count if its object is lost while held, or never slips."
        " `after`: seconds at rest or held. `slow load`: the second before slip, `before"
        f" slip`: its last {BEFORE_SLIP_MS} ms, `in slip`: the {IN_SLIP_MS} ms after its onset:"
    )
    return "\n\n".join([said, as_table(heads, lines), made_by(rows, COMMAND)]) + "\n"


def rows_of(folder: Path, name: str) -> Iterator[Row]:
    """Yield the row of every recording."""
    for kind in KINDS:
        for place in range(2 * RANDOM):
            found = measured(kind, recorded(kind, place, folder))
            sensors = "evetac" if place < RANDOM else "random"
            named = {"as": name, "kind": kind, "seed": SEED + place, "sensors": sensors}
            yield {**named, **found, "track_method": METHOD, "record_method": record.simulated.METHOD}


def main() -> None:
    """Measure, and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--as", dest="name", required=True, help="name of the tracker in the table: before, after")
    parser.add_argument("--out", type=Path, default=FOLDER / "drift.json")
    parser.add_argument("--recordings", type=Path, help="folder of the recordings; default: a temporary one")
    chosen = parser.parse_args()
    others = [row for row in (kept(chosen.out) if chosen.out.exists() else []) if row["as"] != chosen.name]
    with tempfile.TemporaryDirectory() as temporary:
        made = commit_in_words()
        rows = [row | {"commit": made} for row in rows_of(chosen.recordings or Path(temporary), chosen.name)]
    write(chosen.out, others + rows, COMMAND)


if __name__ == "__main__":
    main()
