"""Does the noise of sliding converge? Objects slide at constant speeds, on the default grid and on finer ones.

    python scripts/studies/likeness/sliding.py [--out docs/results/likeness/sliding.json]

An object is held with its initial grip while its speed is prescribed. A row has the events per ms and the spectrum of
the dots' velocities, as powers in three bands, once the object slides. This takes a minute. `make results` writes the
table into docs/evidence/simulation.md.
"""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from evetac_cli.evaluate.data_rate import COLUMNS
from evetac_cli.jobs import Row
from evetac_cli.sim.scenes.gripped import GraspSimulation
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.trials.record import simulated
from scripts.reproduce.facts import commit_in_words
from scripts.reproduce.table_text import as_table
from scripts.studies.likeness.trials import FOLDER, arguments, kept, made_by, write

NAME = "sliding"
COMMAND = "python scripts/studies/likeness/sliding.py"
OBJECTS, SPEEDS_MM_S, PITCHES_MM = (3, 11, 16), (5, 33, 100), (0.83, 0.5, 0.33)
SEED, REST_MS, SETTLE_MS, SLICES = 1, 50, 150, 662  # 512 ms are measured
BANDS_HZ = ((0.0, 30.0), (30.0, 100.0), (100.0, 501.0))


def slid(number: int, speed_mm_s: float, pitch_mm: float, *, rough: bool = True) -> Row:
    """Return events per ms and the powers of the dots' velocities, mm^2/s^2, of an object that slides at a speed."""
    plan = first_plan("slip", str(number))
    scene, solver = plan.scene, plan.scene.solver
    pitch = solver.node_pitch_mm if pitch_mm == PITCHES_MM[0] else pitch_mm
    scene = replace(scene, solver=replace(solver, node_pitch_mm=pitch), roughness=scene.roughness if rough else None)
    trial = GraspSimulation(replace(plan, scene=scene), *(np.random.default_rng([SEED, part]) for part in (1, 2)))
    pads, finger = trial.pads, trial.finger.state
    events, dots_px = [], []
    for ms in range(SLICES):
        speed_m_s = speed_mm_s * 1e-3 if ms >= REST_MS else 0.0
        pads.press(finger)
        done = pads.advance((finger.force_n, finger.force_n), pads.friction, 0.0, speed_m_s)
        trial.view.follow_forces(pads.shares, done.friction_n[:2], finger.force_n)
        seen = trial.view.look(ms, finger.indentation_m, 0.0, still=False)
        events.append(int(np.count_nonzero(seen.x < COLUMNS)))
        dots_px.append(np.asarray(trial.truth()["truth/dot_xy_px"], float))
    velocity = np.diff(np.array(dots_px[SETTLE_MS - 1 :]), axis=0) * plan.sensor.mm_per_px * 1e3
    power = (np.abs(np.fft.rfft(velocity, axis=0)) ** 2).sum(axis=(1, 2)) / len(velocity) ** 2
    hz = np.fft.rfftfreq(len(velocity), 1e-3)
    powers = [float(f"{power[(hz > low) & (hz <= high)].sum():.4g}") for low, high in BANDS_HZ]
    return {"events_ms": round(float(np.mean(events[SETTLE_MS:])), 2), "powers": powers}


def as_page(results: Path) -> str:
    """Return the table of docs/evidence/simulation.md."""
    rows = kept(results / FOLDER.name / f"{NAME}.json")
    lines = []
    for number, speed in product(OBJECTS, SPEEDS_MM_S):
        smooth, *by_pitch = (row for row in rows if (row["object"], row["speed_mm_s"]) == (number, speed))
        finest = by_pitch[-1]["powers"]
        apart = [f"{one / most:.2f}" for one, most in zip(by_pitch[0]["powers"], finest, strict=True)]
        events = [f"{row['events_ms']:.0f}" for row in by_pitch]
        lines.append([str(number), str(speed), f"{smooth['events_ms']:.0f}", *events, *apart])
    pitches = [f"at {pitch:g} mm" for pitch in PITCHES_MM]
    bands = [f"{low:g} to {high:.0f} Hz" for low, high in BANDS_HZ]
    heads = ["object", "speed [mm/s]", "smooth: events per ms", *pitches, *bands]
    said = (
        "Simulated; events per ms, of 540 columns, of an object that slides at a constant speed, smooth and rough, the"
        " latter at three pitches of the nodes; then the power of the dots' velocities at the default pitch over that"
        " at the finest:"
    )
    return "\n\n".join([said, as_table(heads, lines), made_by(rows, COMMAND)]) + "\n"


def main() -> None:
    """Measure and write the rows."""
    path, made, rows = arguments(__doc__, NAME).out, commit_in_words(), []
    for number, speed in product(OBJECTS, SPEEDS_MM_S):
        for pitch, rough in ((PITCHES_MM[0], False), *((pitch, True) for pitch in PITCHES_MM)):
            named = {"object": number, "speed_mm_s": speed, "pitch_mm": pitch, "rough": rough, "seed": SEED}
            found = slid(number, speed, pitch, rough=rough)
            rows.append({**named, **found, "record_method": simulated.METHOD, "commit": made})
    write(path, rows, COMMAND)


if __name__ == "__main__":
    main()
