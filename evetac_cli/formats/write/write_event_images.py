"""Write the events of a recording as images for networks, in npz files.

Every file has `images` (n, ...) and `end_us` (n,), and under `evetac`, as JSON, the parameters of the images and the
recording's header. The images are bit for bit those of `Recording.frames` and the similar methods.
"""

import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.write.slice_columns import TrialFiles
from evetac_cli.formats.write.write_table import provenance
from evetac_cli.jobs import Progress
from evetac_cli.kernels.event_representation import Kind, Representation
from evetac_cli.store.recordings.read import RATE_HZ, Recording

if TYPE_CHECKING:  # compiled code, which other exports do not need
    from evetac_cli.kernels.event_drawing import ImageBlock

NPZ_LEVEL = 1  # images are mostly zeros: higher levels gain little and take several times as long


def writer(kind: Kind) -> Callable[..., list[str]]:
    """Return the function write(recording, path, progress, **options) for images of a kind; options of the command."""

    def write(
        recording: Recording,
        path: Path,
        progress: Progress,
        *,
        fps: float = RATE_HZ,
        size: tuple[int, int] | None = None,
        window_ms: int | None = None,
        **more: Any,
    ) -> list[str]:
        if size is not None and any(side > most for side, most in zip(size, recording.frame_px, strict=True)):
            expected, found = ("{} x {} px".format(*px) for px in (recording.frame_px, size))
            message = f"images would be larger than the sensor's frame in {recording.path.name}"
            raise InputError(message, where="--size", expected=f"at most {expected}", found=found)
        of = recording.representation(kind, fps, size, window_ms, **more)
        files = TrialFiles({"recording": recording})
        shows = {name: getattr(of, name) for name in of.used}
        description = json.dumps({"representation": shows, **provenance(files, files.facts())})
        count = of.images(len(recording))
        _npz(path, of, count, description, _shown(recording.images(of), count, progress))
        return [] if count else [f"all events: the recording ends before the first image would, at {of.end(0)} ms"]

    return write


def _shown(blocks: Iterator["ImageBlock"], count: int, progress: Progress) -> Iterator["ImageBlock"]:
    done = 0
    for block in blocks:
        progress(done, count, "images")
        yield block
        done += len(block.images)
    progress(count, count, "images")


def _npz(path: Path, of: Representation, count: int, description: str, blocks: Iterator["ImageBlock"]) -> None:
    """Write a file for numpy.load, block by block, because the images of a minute can be larger than memory."""
    ends: list[NDArray[np.int64]] = []
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=NPZ_LEVEL) as archive:
        with archive.open("images.npy", "w", force_zip64=True) as member:
            header = {"descr": np.dtype(of.dtype).str, "fortran_order": False, "shape": (count, *of.shape)}
            np.lib.format.write_array_header_2_0(cast(BinaryIO, member), header)
            for block in blocks:
                member.write(block.images.data)
                ends.append(block.end_us)
        for name, array in (
            ("end_us", np.concatenate([np.empty(0, np.int64), *ends])),
            ("evetac", np.array(description)),
        ):
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(cast(BinaryIO, member), array, allow_pickle=False)
