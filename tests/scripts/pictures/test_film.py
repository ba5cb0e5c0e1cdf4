"""scripts/pictures/film.py: the film of a catch tells what the arrays say. Source: the README's picture of a grasp."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from evetac_cli import events
from scripts.pictures import film, film_picture, film_story
from scripts.pictures.film_story import Catch

SLICES = 3000
ONSET, STUCK = 2000, 2040


@pytest.fixture(scope="module")
def story() -> film_story.Story:
    """An object that hangs from 200 ms on, slides by 1 mm at 2 s, and is kept."""
    at = np.arange(SLICES)
    down = np.interp(at, (ONSET, STUCK), (0.0, 1 / 0.03)).astype(np.float32)
    columns, rows = np.meshgrid(np.arange(8) * 60.0 + 60.0, np.arange(7) * 60.0 + 60.0)
    return film_story.Story(
        title="Catching a made-up object",
        catch=Catch(ONSET, STUCK, 1.0),
        acts=film_story.acts(Catch(ONSET, STUCK, 1.0), 200, SLICES),
        object_mm=(50.0, 100.0),
        mm_per_px=0.03,
        window_px=(540, 0, 640, 480),
        frame_px=(640, 480),
        rest_xy_px=np.stack((columns, rows), axis=-1).reshape(-1, 2),
        columns=8,
        height_mm=(np.clip((at - 200) * 0.1, 0.0, 100.0) - 0.03 * down).astype(np.float32),
        down_px=down,
        force_n=np.full(SLICES, 2.0, np.float32),
        probability=np.full(SLICES, np.nan, np.float32),
        noticed_ms=ONSET + 4,
        position_ticks=np.full(SLICES, 400, np.int32),
        goal_ticks=np.full(SLICES, 401, np.int32),
    )


def test_the_farthest_slide_that_was_kept_is_the_catch() -> None:
    """Assert that a slide on the table, a shorter one and one that ends in a fall are passed over."""
    slip, down, height = np.zeros(5000, np.uint8), np.zeros(5000), np.full(5000, 50.0)
    height[:500] = 0.0
    for start, far in ((100, 9.0), (1000, 1.0), (2000, 3.0), (4000, 20.0)):
        slip[start : start + 50] = 1
        down[start + 50 :] += far
    height[4050:] = 0.0
    assert film_story.farthest_catch(slip, down, height) == Catch(2000, 2050, 3.0)
    assert film_story.farthest_catch(np.zeros(5000, np.uint8), down, height) is None
    assert film_story.farthest_catch(slip[:2100], down[:2100], height[:2100]) == Catch(1000, 1050, 1.0)


def test_the_film_is_the_same_every_time(story: film_story.Story, tmp_path: Path) -> None:
    """Assert that the same pictures make the same file, which holds them all, in the palette's colours, and loops."""
    picture = film_picture.Picture(story)

    def some() -> list[Image.Image]:
        return [picture.draw(at, 5, events.empty(), story.rest_xy_px) for at in (1000, ONSET + 10, STUCK + 10, 2500)]

    first, again = tmp_path / "first.gif", tmp_path / "again.gif"
    count, seconds = film.save(some(), first)
    film.save(some(), again)
    assert first.read_bytes() == again.read_bytes()
    assert (count, seconds) == (4, (3 * film.PICTURE_MS + film.LAST_MS) / 1000)
    with Image.open(first) as written:
        assert written.info["loop"] == 0
        assert written.size == (film_picture.WIDE, film_picture.TALL)
        written_frames = [
            np.asarray(frame.convert("RGB")).astype(np.int16) for frame in ImageSequence.Iterator(written)
        ]
    assert len(written_frames) == 4
    for frame, drawn in zip(written_frames, some(), strict=True):
        in_palette = drawn.quantize(palette=film_picture.palette(), dither=Image.Dither.NONE).convert("RGB")
        assert np.array_equal(frame, np.asarray(in_palette))
        flat = np.abs(frame - np.asarray(drawn, np.int16)).max(axis=2) == 0
        assert flat.mean() > 0.9, "all but the edges of letters and curves should be in the palette"
