"""The page of a live view in a real browser, headless Chromium."""

import os
import time
from pathlib import Path

import pytest

from tests.browser import Browser
from tests.trials.live_view.test_live_view import shown
from tests.trials.live_view.test_server import Served

WIDTHS = (420, 860, 1280, 1920, 2560)
PALEST_COLUMN = """(canvas) => {
  const {width, height} = canvas, {data} = canvas.getContext("2d").getImageData(0, 0, width, height);
  const counts = new Array(width).fill(0);
  data.forEach((value, at) => { if (at % 4 === 3 && value > 40 && value < 110) counts[(at >> 2) % width] += 1; });
  return Math.max(...counts); }"""  # how many pixels are half transparent in the column with most of them
PICTURES = os.environ.get("EVETAC_PICTURES")  # a folder: what was seen is kept there

pytestmark = pytest.mark.slow


def click(browser: Browser, name: str) -> None:
    """With the mouse, in the middle of the element of this id."""
    script = "(() => { const element = document.getElementById('NAME'); element.scrollIntoView();"
    script += " const b = element.getBoundingClientRect(); return [b.x + b.width / 2, b.y + b.height / 2]; })()"
    x, y = browser.run(script.replace("NAME", name))
    browser.mouse(x, y, "mousePressed", "mouseReleased")


def keep(browser: Browser, name: str) -> None:
    """A picture of what is seen, where it is asked for."""
    if PICTURES:
        browser.picture(Path(PICTURES) / f"{name}.png")


def use(browser: Browser, end_by: str) -> None:
    """See the page at all widths, use its keys and buttons, and let go."""
    browser.until("document.getElementById('state')?.textContent === 'live'")
    browser.until("document.querySelectorAll('.chart:not([hidden])').length >= 5")
    for width in WIDTHS:
        browser.resize(width)
        time.sleep(1.0)  # in which charts take their new size
        browser.until("document.documentElement.scrollWidth <= document.documentElement.clientWidth")
        keep(browser, f"live-{width}")
    browser.resize(1280)
    force = "[...document.querySelectorAll('.chart')].find((one) => one.textContent.startsWith('Force on the gel'))"
    browser.until(f"/normal [0-9.]+ . [0-9.]+ N/.test({force}.textContent)")  # with its standard deviation
    browser.until(f"({PALEST_COLUMN})({force}.querySelector('canvas')) > 15")  # the band, not the edges of lines
    hold = "document.getElementById('pause').getAttribute('aria-pressed')"
    browser.key(" ", text=" ")
    assert browser.run(hold) == "true"
    click(browser, "pause")
    assert browser.run(hold) == "false"
    browser.key("d", text="d")
    assert not browser.run("document.getElementById('dots').checked")
    browser.key("a", text="a")
    assert browser.run("document.getElementById('arrows').value") == "20"
    number = "Number(document.querySelector('#tiles dd').textContent.split(' ')[0])"
    before = browser.run(number)
    browser.until(f"{number} > {before}")
    if end_by == "mouse":
        click(browser, "let-go")
    else:
        browser.key("Escape")
    browser.until("document.getElementById('state').textContent.startsWith('ended')")
    assert "let go by the button" in browser.run("document.getElementById('state').textContent")
    keep(browser, "live-ended")


@pytest.mark.parametrize("end_by", ["mouse", "key"])
def test_the_page_works_in_a_browser(end_by: str, browser: Browser, tmp_path: Path) -> None:
    """Assert that nothing is complained of, nothing is wider than the window, and keys and mouse do what they say."""
    more = ["--gripper", "virtual", "--hold-s", "100", "--expected-event-rate", "1e5", "--watchdog-ms", "500"]
    with shown(tmp_path, "record", *more) as live:
        browser.visit(f"http://{live.address}")
        use(browser, end_by)
        said_by_browser = browser.complaints(f"http://{live.address.split('/')[0]}/")
        code, said = live.end()
    assert said_by_browser == []
    assert code == 130, said


def test_the_address_that_works_once_leads_to_the_page(browser: Browser) -> None:
    """Assert that a browser that is started with it comes to the view, and is shown pictures."""
    served = Served(bytes(640 * 480))
    try:
        browser.visit(served.server.url_once)
        browser.until(f"location.href === '{served.server.url}' && document.readyState === 'complete'")
        browser.until("document.getElementById('state') !== null")
    finally:
        served.close()
