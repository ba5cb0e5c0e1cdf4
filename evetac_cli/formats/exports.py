"""A recording -> a file that other programs read: one function, and one table of the formats that are written.

Of a recording, the formats of events hold the events and, in a note (formats/note.py), where it begins and ends, its
frame and whether it was simulated; so it comes back from them event for event and slice for slice. Gripper, truth,
control and dots are left out, and that is said.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.errors import InputError
from evetac_cli.formats.write import write_aedat4, write_calibration, write_dsec, write_text
from evetac_cli.jobs import Progress, require_possible_name, silent
from evetac_cli.store.disk import taking_the_place_of
from evetac_cli.store.files import stem
from evetac_cli.store.read import Recording


class Format(NamedTuple):
    """A row of the table: endings of its files, the usual one first; who writes them; whether they hold events."""

    suffixes: tuple[str, ...]
    write: Callable[[Recording, Path, Progress], None]
    events: bool = True


FORMATS = {
    "aedat4": Format((".aedat4",), write_aedat4.write),
    "dsec": Format((".dsec.h5", ".h5", ".hdf5"), write_dsec.write),
    "text": Format((".txt",), write_text.write),
    "calibration": Format((".calibration.json", ".json", ".pkl"), write_calibration.write, events=False),
}
# Groups and datasets of a recording that a file of events cannot hold.
LEFT_OUT = ("gripper", "truth", "control", "capture", "streams", "sensor/dot_xy_px", "sensor/window_px")


def target_path(source: Path, format_: str, out: Path | None) -> Path:
    """`<name><ending>` beside the recording or in the folder `out`, or the file `out` if it ends so."""
    suffixes = FORMATS[format_].suffixes
    if out is None:
        return source.with_name(stem(source) + suffixes[0])
    if out.is_dir() or not out.suffix:
        return out / (stem(source) + suffixes[0])
    if out.suffix.lower() not in {Path("x" + suffix).suffix for suffix in suffixes}:
        raise InputError(
            "wrong kind of output",
            where=str(out),
            expected=f"a name that ends in {' or '.join(suffixes)}, or a folder",
            found=out.suffix,
        )
    return out


def export(
    source: Path, format_: str, target: Path, *, force: bool = False, progress: Progress = silent
) -> dict[str, Any]:
    """Write a recording in another format, all or nothing; returns what was written and what was left out.

    InputError if the target exists, unless `force`, or if the recording has not got what the format holds.
    """
    require_possible_name(target)
    if target.is_dir():
        raise InputError("the output is a folder", where=str(target))
    if os.path.lexists(target) and not force:
        raise InputError("the output exists", where=str(target), hint="--force replaces it, -o NAME writes elsewhere")
    row = FORMATS[format_]
    with Recording(source) as recording:
        if target.exists() and target.samefile(source):
            raise InputError("the output would replace the recording", where=str(target))
        with taking_the_place_of(target, target.suffix) as temporary:
            row.write(recording, temporary, progress)
            size = temporary.stat().st_size
        left_out = [name for name in LEFT_OUT if recording.has(name)] if row.events else []
        return {
            "recording": str(source),
            "output": str(target),
            "format": format_,
            "events": recording.event_count if row.events else None,
            "slices": len(recording) if row.events else None,
            "size_bytes": size,
            "left_out": " ".join(left_out) or None,
            "simulated": bool(recording.header["simulated"]),
        }
