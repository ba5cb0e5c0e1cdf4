"""Make a short film of a catch from a simulated grasp: docs/catch.gif, for the README.

    python scripts/pictures/film.py catch.recording.h5 [--out docs/catch.gif]

`make film` grasps, tracks and draws. The tracks are next to the recording. In the film, the hand lifts the object and
the grip loosens until the object slips. The detector notices, the gripper closes, and the object is held. Around the
catch the film is in slow motion, and states its speed.
"""

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

from PIL import Image

from evetac_cli.errors import EvetacError
from evetac_cli.pages.view.trial_files import OpenTrial, open_trial
from scripts.pictures.film_picture import Picture, palette
from scripts.pictures.film_story import PICTURE_MS, Story, frame_times, read_story

LAST_MS = 1500  # how long the last picture stays
SHOWN_MS = 5  # the paper's images show 5 ms
SEE_THROUGH = 127  # the palette colour that means: unchanged from the previous picture


def pictures(trial: OpenTrial, story: Story) -> Iterator[Image.Image]:
    """Return all pictures of the film, in order, in RGB."""
    recording, tracks = trial.recording, trial.tracks
    assert recording is not None and tracks is not None
    picture = Picture(story)
    shown = -1
    for time_ms in frame_times(story.acts):
        at = int(time_ms)
        # All events since the previous picture, so that no burst is missed, and at least 5 ms as in the paper's images.
        first = max(min(shown if shown >= 0 else at, at - SHOWN_MS) + 1, 0)
        yield picture.draw(
            at, at + 1 - first, recording.between(first, at + 1), tracks.read("dot_xy_px", at, at + 1)[0]
        )
        shown = at


def save(drawn: Iterable[Image.Image], out: Path) -> tuple[int, float]:
    """Write the GIF, with only the changes of each picture; return the number of pictures and the duration in s."""
    chosen = palette()
    small = [one.quantize(palette=chosen, dither=Image.Dither.NONE) for one in drawn]
    durations = [PICTURE_MS] * (len(small) - 1) + [LAST_MS]
    out.parent.mkdir(parents=True, exist_ok=True)
    # Only with `optimize` does Pillow leave out unchanged pixels, using the transparent colour.
    small[0].save(
        out,
        "GIF",
        save_all=True,
        append_images=small[1:],
        duration=durations,
        loop=0,
        optimize=True,
        transparency=SEE_THROUGH,
        disposal=1,
    )
    return len(small), sum(durations) / 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--out", type=Path, default=Path("docs/catch.gif"))
    chosen = parser.parse_args()
    try:
        with open_trial([chosen.recording]) as trial:
            count, seconds = save(pictures(trial, read_story(trial)), chosen.out)
    except EvetacError as error:
        parser.exit(error.exit_code, f"{error}\n")
    print(f"{chosen.out}: {count} pictures, {seconds:.1f} s, {chosen.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
