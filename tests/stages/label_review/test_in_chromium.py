"""The page of a review in a real browser, headless Chromium."""

from pathlib import Path

import pytest

from evetac_cli.store.files import StageFile
from tests.browser import Browser
from tests.stages.label_review.test_server import Reviewed

pytestmark = pytest.mark.slow


def test_an_onset_is_dragged_and_kept(browser: Browser, tmp_path: Path) -> None:
    """Assert that mouse and keys move the onset, Enter keeps it, and nothing is complained of at any width."""
    reviewed = Reviewed(tmp_path)
    try:
        browser.visit(reviewed.server.url)
        at = "document.getElementById('at')?.textContent"
        browser.until(f"{at}?.endsWith(' ms')")
        for width in (420, 860, 1400, 2200):
            browser.resize(width)
            browser.until("document.documentElement.scrollWidth <= document.documentElement.clientWidth")
        browser.resize(1400)
        x, y = browser.run(
            "(() => { const b = document.querySelector('canvas[data-series=counts]').getBoundingClientRect();"
            " return [b.x + 44 + (b.width - 52) * 0.25, b.y + b.height / 2]; })()"
        )
        browser.mouse(x, y, "mousePressed", "mouseReleased")
        first, stop = reviewed.ask("trial?n=0")[1]["span"]
        dragged = int(browser.run(at).split()[0])
        assert abs(dragged - (first + 0.25 * (stop - first))) <= 1
        browser.key("[", text="[")
        browser.key("ArrowRight")
        assert browser.run(at) == f"{dragged + 1} ms"
        browser.key("Enter")
        browser.until("document.getElementById('answer').textContent.startsWith('Kept')")
        with StageFile(reviewed.labels[0], "labels") as file:
            slices = [int(file.read(name)) for name in ("onset_slice", "earliest_slice", "latest_slice")]
        assert slices == [dragged + 1, dragged, dragged + 1]
        browser.run("document.getElementById('next').click()")
        browser.until("document.getElementById('which').textContent === '2 of 2'")
        browser.run("document.getElementById('done').click()")
        browser.until("document.body.textContent.includes('1 labels were kept')")
        assert browser.complaints(f"http://127.0.0.1:{reviewed.server.port}/") == []
    finally:
        reviewed.close()
