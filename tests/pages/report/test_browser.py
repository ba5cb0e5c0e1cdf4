"""The report over a large study in a headless Chromium, where one is installed."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from evetac_cli.commands.report import Report
from evetac_cli.pages import report, shared
from tests.browser import Browser
from tests.pages.report.studies import slip_rows, write_report, write_trials
from tests.pages.view.trials import ONSET

TRIALS = 300
SHOWN = "[...document.querySelectorAll('#all-trials tbody tr')].filter((row) => !row.hidden)"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report on 300 trajectories."""
    folder = tmp_path_factory.mktemp("many")
    features = write_trials(folder, [(7 * number) % 11 - 5 for number in range(TRIALS)], ONSET + 60)
    late_by = [None if number % 50 == 0 else (37 * number) % 120 - 80 for number in range(TRIALS)]
    write_report(folder / "s.slip.report.h5", "evaluate slip", slip_rows(features, late_by), {}, tuple(features))
    report.run([folder], Report(), None)
    return folder / "report.html"


@pytest.mark.slow
def test_report_in_a_browser(browser: Browser, page: Path, record_property: Callable[[str, object], None]) -> None:
    """Assert that the page is small, draws without complaint at any width, is sorted and searched by key or click.

    How long it takes to open is a property of the computer: it is kept with the test's record, not judged.
    """
    assert page.stat().st_size < shared.LARGEST_BYTES
    for width in (420, 1300, 2560):
        browser.resize(width)
        begin = time.monotonic()
        browser.open(page)
        record_property(f"opened_s_{width}", time.monotonic() - begin)
        assert browser.run("document.documentElement.scrollWidth <= innerWidth"), width
        assert browser.complaints() == []
    browser.resize(1300)
    assert browser.run(f"{SHOWN}.length") == TRIALS
    browser.key("/", text="/")
    assert browser.run("document.activeElement.id") == "find"
    for letter in "slip-007":
        browser.call("Input.dispatchKeyEvent", type="char", text=letter)
    browser.until(f"{SHOWN}.length === 1")
    browser.key("Escape")
    browser.until(f"{SHOWN}.length === {TRIALS}")
    browser.run("document.getElementById('outliers').click()")
    outliers = browser.run(f"{SHOWN}.length")
    assert 0 < outliers < TRIALS
    browser.run("document.getElementById('outliers').click()")
    head = "[...document.querySelectorAll('#all-trials th button')].find((one) => one.textContent === 't_m - t_c [ms]')"
    column = browser.run(f"{head}.closest('th').cellIndex")
    browser.run(f"{head}.focus()")
    browser.key("Enter", text="\r")
    values = f"{SHOWN}.map((row) => Number(row.cells[{column}].dataset.v))"
    sorted_up = browser.until(f"{head}.closest('th').ariaSort === 'ascending' && {values}")
    assert sorted_up == sorted(sorted_up)
    browser.run(f"{head}.click()")
    assert browser.run(values) == sorted(sorted_up, reverse=True)
    choice = "document.querySelector('select[data-by=object]')"
    browser.run(f"(() => {{ {choice}.value = '3'; {choice}.dispatchEvent(new Event('input')); }})()")
    assert browser.run(f"{SHOWN}.every((row) => row.dataset.object === '3')")
    assert browser.complaints() == []


@pytest.mark.slow
def test_a_wide_table_is_within_reach(browser: Browser, page: Path) -> None:
    """Assert that on 1,280 px the bar which scrolls the table is in the window; names and headings stay."""
    browser.resize(1280)
    browser.open(page)
    browser.run("document.getElementById('all-trials').style.width = '2000px'")
    box = "document.getElementById('all-trials').parentNode"
    browser.run(f"{box}.scrollIntoView({{block: 'end'}})")
    browser.run(f"{box}.scrollTo(500, 900)")
    of_box, name, head = browser.run(
        f"[{box}, {SHOWN}[40].cells[0], document.querySelector('#all-trials th')]"
        ".map((one) => one.getBoundingClientRect().toJSON())"
    )
    assert 0 <= of_box["top"] < of_box["bottom"] < browser.run("innerHeight") + 1  # scrolling is by whole pixels
    assert name["left"] == head["left"] == of_box["left"]
    assert head["top"] == of_box["top"]
    assert browser.run(f"{SHOWN}[40].cells[0].textContent").startswith("slip-")


@pytest.mark.slow
def test_a_point_shows_its_trial(browser: Browser, page: Path) -> None:
    """Assert that a click on a point of a chart marks the trial of that point, also if the filters hid it."""
    browser.open(page)
    browser.run("document.getElementById('outliers').click()")
    x, y = browser.run(
        "(() => { const row = (one) => document.querySelector(one.href.baseVal);"
        " const point = [...document.querySelectorAll('svg a')].find((one) => row(one).hidden);"
        " point.scrollIntoView({block: 'center'}); const box = point.getBoundingClientRect();"
        " return [box.left + box.width / 2, box.top + box.height / 2]; })()"
    )
    under = browser.run(f"document.elementFromPoint({x}, {y}).closest('a').href.baseVal.slice(1)")
    browser.mouse(x, y, "mouseMoved", "mousePressed", "mouseReleased")
    browser.until("document.querySelector('tr:target') !== null")
    assert browser.run("document.querySelector('tr:target').id") == under
    box = browser.run(f"document.getElementById('{under}').getBoundingClientRect().toJSON()")
    assert 0 < box["top"] < box["bottom"] < browser.run("innerHeight")
    assert browser.complaints() == []
