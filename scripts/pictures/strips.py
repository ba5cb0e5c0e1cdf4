"""Draw a simulated recording as a PNG strip: event images of 5 ms, then events, forces and slip over time.

    python scripts/pictures/strips.py data/slip-obj08-s0-000.recording.h5 ... [--out docs]

`make strips` draws every scene. For this, --short-vibration writes a shortened scene `vibration`.
"""

import argparse
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from evetac_cli.evaluate.common import picture
from evetac_cli.events import SLICES_PER_S
from evetac_cli.kernels.event_representation import event_image
from evetac_cli.sim.setup.scene_file import changed
from evetac_cli.store.recordings.read import Recording, open_recording, true_onset

SHOWN_MS = 5  # the paper's images show 5 ms
IMAGES = 4
COOL, WARM = picture.COLOURS[0], picture.COLOURS[3]


def frame_times(recording: Recording) -> list[int]:
    """Return the slices to show: around the onset if slip is forced, otherwise the busiest of each quarter."""
    onset = true_onset(recording) if recording.has("truth") else None
    if onset is not None and recording.header["parameters"]["scene"]["kind"] == "ramp":
        return [max(onset + away, 0) for away in (-200, -20, 8, 40)]
    per_slice = np.convolve(np.diff(recording.starts), np.ones(SHOWN_MS), "valid")
    return [int(part[np.argmax(per_slice[part])]) for part in np.array_split(np.arange(len(per_slice)), IMAGES)]


def image(recording: Recording, start: int) -> np.ndarray:
    """Return the events of 5 ms in the paper's colours: white brighter, black darker, grey without events."""
    events = recording.between(start, min(start + SHOWN_MS, len(recording)))
    return event_image(events.x, events.y, events.p, recording.frame_px)


def strip(path: Path, out: Path) -> Path:
    """Draw one recording."""
    with open_recording(path) as recording:
        chosen = frame_times(recording)
        figure = Figure(figsize=(11, 5.6), layout="constrained")
        grid = figure.add_gridspec(3, IMAGES, height_ratios=(2.6, 1, 1))
        for place, start in enumerate(chosen):
            axes = figure.add_subplot(grid[0, place])
            axes.imshow(image(recording, start), cmap="gray", vmin=-1, vmax=1, interpolation="nearest")
            axes.set_title(f"{start / SLICES_PER_S:.3f} s", loc="center")
            axes.spines[:].set_visible(True)
            axes.set_xticks([])
            axes.set_yticks([])
        seconds = np.arange(len(recording)) / SLICES_PER_S
        rate = figure.add_subplot(grid[1, :])
        rate.fill_between(seconds, np.maximum(np.diff(recording.starts), 1), 1, color=COOL, linewidth=0, step="mid")
        rate.set_ylabel("events per ms")
        picture.log_axis(rate.yaxis)
        force = figure.add_subplot(grid[2, :], sharex=rate)
        if recording.has("truth"):
            force.plot(seconds, recording.read("truth/normal_force_n"), color="black", label="normal force")
            shear = np.linalg.norm(recording.read("truth/shear_force_n"), axis=1)
            force.plot(seconds, shear, color=WARM, label="shear force")
            slip = recording.read("truth/slip") > 0
            force.fill_between(seconds, 0, 1, where=slip, color=WARM, alpha=0.2, linewidth=0, label="gross slip",
                               transform=force.get_xaxis_transform())  # fmt: skip
        force.set(xlabel="time [s]", ylabel="force [N]")
        for axes in (rate, force):
            for start in chosen:
                axes.axvline(start / SLICES_PER_S, color="0.5", linewidth=0.8, linestyle=":")
        rate.set_xlim(0, seconds[-1])
        rate.tick_params(labelbottom=False)
        what = recording.header["parameters"]["scene"]
        object_number = recording.header["parameters"]["object"]
        name = what["name"] + (f", object {object_number}" if object_number else "")
        figure.suptitle(f"{name} (simulated): {what['summary']}")
        picture.legend(figure, [force])
        out.mkdir(parents=True, exist_ok=True)
        target = out / f"{what['name']}.png"
        figure.savefig(target, dpi=110)
    return target


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    parser.add_argument(
        "--short-vibration", type=Path, metavar="TOML", help="write the scene vibration with 3 s of tone"
    )
    chosen = parser.parse_args()
    if chosen.short_vibration:
        chosen.short_vibration.write_text(changed("vibration", {"time": {"tone_s": 3.0}}))
    with matplotlib.rc_context(picture.STYLE):
        for path in chosen.recordings:
            print(strip(path, chosen.out))


if __name__ == "__main__":
    main()
