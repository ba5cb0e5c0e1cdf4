"""Measure the cost of commands over data sets of real files; a part of growth.py.

The stages make the files of one recorded trial. Copies of these files pretend to be recorded with other seeds: the
arrays are the same, the recipe ids differ. Small or empty files would open in a fraction of the time.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py

from evetac_cli.jobs import Row
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.netcdf import header_in_words
from evetac_cli.store.layout.provenance import Header, folded, recompute_id

TRIALS = (30, 100, 300, 1_000, 3_000, 10_000)  # trials per data set
OF_TRIAL = ("recording", "labels", "tracks", "features")  # files per trial
SEED = 10_000  # object of the repeated trial, which the pretrained detector was not trained on


def cpu_of(*words: str, cwd: Path) -> tuple[float, float]:
    """Return a command's processor time in s and its largest resident set in MB; SystemExit if it fails."""
    command = [sys.executable, "-P", "-m", "evetac_cli", *words]
    process = subprocess.Popen(command, cwd=cwd, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(words)} ended with {process.returncode}")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1e3


def files(most_trials: int) -> list[Row]:
    """Return a row for each size of a data set of real files: first index, one file more, nothing to do."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        cpu_of("record", "--object", "2", "--seed", str(SEED), "-o", "trial.recording.h5", cwd=place)
        for stage in ("label", "track", "featurize"):
            cpu_of(stage, "trial.recording.h5", cwd=place)
        for count in (trials for trials in TRIALS if trials <= most_trials):
            many = place / str(count)
            many.mkdir()
            for number in range(count + 1):
                copy_trial(place, many, number)
            later = [path.rename(place / path.name) for path in many.glob(f"{count}.*.h5")]
            size_gb = sum(path.stat().st_size for path in many.iterdir()) / 1e9
            row: Row = {"trials": count, "files": count * len(OF_TRIAL), "size_gb": size_gb}
            for what, words in (
                ("index", ("index", str(many), "--jobs", str(os.cpu_count()))),
                ("again", ("index", str(many))),
                ("nothing_to_do", ("label", str(many))),
            ):
                row[f"{what}_cpu_s"], _ = cpu_of(*words, cwd=place)
            later[0].rename(many / later[0].name)
            row["one_more_cpu_s"], _ = cpu_of("index", str(many), cwd=place)
            rows.append(row)
            print(rows[-1], file=sys.stderr)
            shutil.rmtree(many)
    return rows


def copy_trial(place: Path, folder: Path, number: int) -> None:
    """Copy the files of a trial as if it had been recorded with another seed, with new recipe ids."""
    ids: dict[str, str] = {}
    for kind in OF_TRIAL:
        path = Path(shutil.copyfile(place / f"trial.{kind}.h5", folder / f"{number}.{kind}.h5"))
        with StageFile(path) as file:
            header = file.header
        ancestors = [as_of(ancestor, number, ids) for ancestor in header["history"].values()]
        header = {**as_of(header, number, ids), "history": {ancestor["id"]: ancestor for ancestor in ancestors}}
        with h5py.File(path, "r+") as h5:
            h5.attrs["header"] = json.dumps(folded(header), sort_keys=True)
            for name, value in header_in_words(header).items():
                h5.attrs[name] = value


def as_of(header: Header, number: int, ids: dict[str, str]) -> Header:
    """Return a header for the trial of this number; `ids` maps ids of the recorded trial to those of this one."""
    changed = {**header, "parents": [ids[parent] for parent in header["parents"]]}
    if header["kind"] == "recording":
        changed["seed"] = SEED + number
    changed["id"] = ids[header["id"]] = recompute_id(changed)
    return changed
