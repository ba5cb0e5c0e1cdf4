"""Write events as AEDAT4 with dv-processing, the extra `camera`, in a process of its own.

Why a process: where its disk is full, or the file has another ending, dv-processing 2.0.4 ends the whole program, from
a thread of its own.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.formats.read.read_aedat4 import is_whole
from evetac_cli.formats.write import write_aedat4_child
from evetac_cli.formats.write.pieces import Progress, note_of, pieces, t_offset_us
from evetac_cli.formats.write.write_aedat4_child import EVENT, NOT_INSTALLED
from evetac_cli.store.read import Recording


def write(recording: Recording, path: Path, progress: Progress) -> None:
    """One stream of events, t on the source's clock; InputError with the library's words where it does not work."""
    offset_us = t_offset_us(recording)
    width, height = recording.frame_px
    note = note_of(recording, offset_us).text()
    call = [sys.executable, "-P", write_aedat4_child.__file__, str(path), str(width), str(height), note]
    with (
        tempfile.TemporaryFile() as complaints,
        subprocess.Popen(call, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=complaints) as child,
    ):
        assert child.stdin is not None
        try:
            for events in pieces(recording, progress):
                rows = np.zeros(events.size, EVENT)
                rows["t"] = events.t + offset_us
                for name in "xyp":
                    rows[name] = getattr(events, name)
                child.stdin.write(len(rows).to_bytes(8, "little") + rows.tobytes())
            child.stdin.write((0).to_bytes(8, "little"))
            child.stdin.close()
        except BrokenPipeError:  # it says why
            pass
        except BaseException:
            child.kill()
            raise
        code = child.wait()
        complaints.seek(0)
        said = complaints.read().decode(errors="replace")
    if code == NOT_INSTALLED:
        hint = 'pip install "evetac[camera]"'
        raise InputError("AEDAT4 needs dv-processing", where=str(path.parent), found=_last(said), hint=hint)
    if code or not is_whole(path):
        found = said.partition("with error: '")[2].partition("'")[0] or _last(said) or f"exit code {code}"
        raise InputError("AEDAT4 cannot be written", where=str(path.parent), found=found, hint="is the disk full?")


def _last(text: str) -> str:
    return text.strip().split("\n")[-1][:200]
