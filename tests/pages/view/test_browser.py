"""The page in a headless Chromium, where one is installed."""

import json
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.commands.view import View
from evetac_cli.pages import view
from evetac_cli.store.recordings.read import open_recording
from tests.browser import Browser
from tests.pages.view.trials import (
    NASTY,
    ONSET,
    SLICES,
    moving,
    write_labels,
    write_recording,
    write_touch,
    write_tracks,
)

DRAWN = "document.getElementById('viewer').hidden || document.getElementById('image').dataset.index"
INDEX = "Number(document.getElementById('image').dataset.index)"
PIXELS = "document.getElementById('image').toDataURL()"
COLOURS = """(() => { const c = document.getElementById('image');
  const d = new Uint32Array(c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer);
  return new Set(d).size; })()"""

YELLOW_PIXELS = """(() => { const c = document.getElementById('touch');
  const d = new Uint32Array(c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer);
  return d.filter((pixel) => pixel === 0xff25e7fd).length; })()"""


@pytest.mark.slow
def test_page_in_a_browser(browser: Browser, page: Path) -> None:
    """Assert that the page draws without a complaint, and that slider, keys, pointer, click and play move the image."""
    browser.open(page, DRAWN)
    assert browser.run("document.querySelectorAll('.chart').length") == 8
    assert browser.run("Bokeh.documents[0].roots().length") == 8
    assert browser.run(COLOURS) > 3
    assert browser.run(INDEX) == ONSET  # it opens on the first onset
    before = browser.run(PIXELS)
    browser.run(
        "(() => { const s = document.getElementById('scrub'); s.value = 3; s.dispatchEvent(new Event('input')); })()"
    )
    browser.until(f"{INDEX} === 3")
    assert browser.run(PIXELS) != before
    for key, more, index in (
        ("ArrowRight", {}, 4),
        ("ArrowRight", {"modifiers": 8}, 14),
        ("ArrowLeft", {}, 13),
        ("End", {}, SLICES - 5),
        ("Home", {}, 0),
    ):
        browser.key(key, **more)
        browser.until(f"{INDEX} === {index}")
    assert browser.run("document.getElementById('time').textContent") == "0.000 s"
    left, width, top = browser.run(
        "(({left, width, top}) => [left, width, top])"
        "(document.querySelector('.chart .bk-Figure').getBoundingClientRect())"
    )
    at = left + 58 + (width - 58 - 14) / 2, top + 50
    browser.mouse(*at, "mouseMoved")
    browser.until(f"Math.abs({INDEX} - {SLICES // 2}) <= 8")  # it follows the pointer
    browser.run("document.getElementById('follow').click()")
    browser.key("Home")
    browser.until(f"{INDEX} === 0")
    browser.mouse(*at, "mouseMoved", "mousePressed", "mouseReleased")
    browser.until(f"Math.abs({INDEX} - {SLICES // 2}) <= 8")
    cursors = browser.run("Bokeh.documents[0].roots().map((f) => f.center.find((p) => p.name === 'cursor').location)")
    assert cursors == [browser.run(f"{INDEX} / 1000")] * 8
    browser.run("document.querySelectorAll('.jump')[1].click()")
    browser.until(f"{INDEX} === {ONSET + 3}")
    dotted = browser.run(PIXELS)
    browser.run("document.getElementById('dots').click()")
    browser.until(f"{PIXELS} !== {json.dumps(dotted)}")
    browser.run("document.activeElement.blur()")
    browser.key(" ")
    browser.until(f"{INDEX} > {ONSET + 5}")
    browser.key(" ")
    assert browser.run("document.getElementById('play').textContent") == "Play"
    assert browser.complaints() == []


@pytest.mark.slow
def test_a_page_fits_its_window(browser: Browser, trial: Path) -> None:
    """Assert that on a wide screen image and charts share the page, that on a phone nothing is cut off, that readouts
    have deviations, and that a flow beyond its axis is no number.
    """
    with open_recording(trial) as recording:
        header = recording.header
    flow = np.where(np.arange(SLICES) < ONSET + 20, 0.5, 12_428.0)
    labels = trial.with_name("a.labels.h5")
    write_labels(labels, header, ONSET, ONSET + 20, relative_flow_px=flow, method="event-flow", slip_distance_px=0.3)
    force = np.full((SLICES, 2), 1.5, np.float32)
    force[60:80] = np.nan
    normal = {"normal_n": force[:, 0], "normal_sd_n": force[:, 0] / 2}
    write_touch(trial, {"shear_n": force, "shear_sd_n": force / 3, **normal})
    view.run([trial], View(), None)
    readouts = "[...document.querySelectorAll('output[data-series]')].map((out) => out.textContent).join(' | ')"
    for width, columns in ((420, 1), (1280, 2), (1920, 2)):
        browser.resize(width)
        browser.open(trial.with_name("a.html"), DRAWN)
        assert browser.run("document.documentElement.scrollWidth <= innerWidth"), width
        across = browser.run(
            "new Set([...document.querySelectorAll('.chart')].map((c) => c.getBoundingClientRect().left)).size"
        )
        image, page, left, right = browser.run(
            "[document.getElementById('image').getBoundingClientRect().width, innerWidth,"
            " document.getElementById('viewer').offsetHeight, document.getElementById('series').offsetHeight]"
        )
        assert across == columns
        assert image > (0.8 if width == 420 else 0.39) * page
        if width > 420:
            assert 0.6 < left / right < 1.6
        assert browser.run("Bokeh.documents[0].roots().every((f) => f.below[0].visible)")
        assert "1.5 \u00b1 0.75" in browser.run(readouts)
        assert browser.run("document.getElementById('most-pressure').textContent") == "100 \u00b1 2 kPa"
        assert browser.run("document.getElementById('sticks').textContent") == "75 %"
        assert browser.run(YELLOW_PIXELS) > 1000
        browser.key("End")
        browser.until(f"{readouts}.includes('over 10')")
        assert "12,428" not in browser.run(readouts)
        assert browser.complaints() == []
    browser.resize(1300)


@pytest.mark.slow
def test_hostile_pages_in_a_browser(browser: Browser, tmp_path: Path) -> None:
    """Assert that an empty recording, one slice, markup in names, tracks alone and that end early make no complaint."""
    for name, slices in (("empty", 0), ("one", 1), ("a\"'<b>&ü", 30)):
        header = write_recording(tmp_path / f"{name}.recording.h5", slices, scene=NASTY)
        write_tracks(tmp_path / f"{name}.tracks.h5", header, moving(slices)[: slices - slices // 2])
        view.run([tmp_path / f"{name}.recording.h5"], View(), None)
        browser.open(tmp_path / f"{name}.html", DRAWN)
        assert browser.run("document.querySelector('h1').textContent") == f"{name}.recording.h5"
        assert browser.run("document.title") == f"{name}.recording.h5 - evetac view"
        assert browser.run("document.querySelectorAll('.chart').length > 0") == (slices > 0)
        assert browser.run("document.getElementById('viewer').hidden") == (slices == 0)
        assert browser.complaints() == []
    (tmp_path / "one.recording.h5").unlink()
    view.run([tmp_path / "one.tracks.h5"], View(), tmp_path / "tracks.html")
    browser.open(tmp_path / "tracks.html", DRAWN)
    assert browser.run("document.getElementById('count').textContent") == "no event images"
    assert browser.complaints() == []


@pytest.mark.slow
def test_grasp_page_in_a_browser(browser: Browser, tmp_path: Path) -> None:
    """Assert that a grasp opens on an image with events and shows it from the side, on a phone as on a wide screen."""
    write_recording(tmp_path / "g.recording.h5", grasp=True)
    view.run([tmp_path / "g.recording.h5"], View(), None)
    for width in (420, 1300, 2560):
        browser.resize(width)
        browser.open(tmp_path / "g.html", DRAWN)
        assert browser.run("document.getElementById('beside').hidden") is False
        assert browser.run("document.getElementById('height').textContent") != "-"
        assert browser.run("parseInt(document.getElementById('count').textContent)") > 0
        assert browser.run("document.documentElement.scrollWidth <= innerWidth"), width
        assert browser.complaints() == []
    browser.resize(1300)
