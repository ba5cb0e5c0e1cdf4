"""docs/slip-detector.md: its comparison of two sensors runs, and labels that abstain are counted wherever it shows."""

import re
from pathlib import Path

import pytest

from evetac_cli.store.files import StageFile
from scripts import first_hour
from tests.make import answer_of, evetac

PAGE = "docs/slip-detector.md"
SENSORS = ("soft", "stiff")


def abstains(labels: Path) -> bool:
    """Whether labels abstain."""
    with StageFile(labels, "labels") as file:
        return bool(file.read("abstained"))


@pytest.mark.slow  # 20 trials
def test_two_sensors_are_compared_as_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the page's figures come out, and that line, tables, JSON, report and comparison agree on n."""
    text = (first_hour.ROOT / PAGE).read_text()
    assert first_hour.follow_page(PAGE, text, tmp_path, first_hour.this_environment()) == []
    monkeypatch.chdir(tmp_path)
    abstained = [sum(map(abstains, Path(sensor).glob("*.labels.h5"))) for sensor in SENSORS]
    n = [10 - count for count in abstained]

    words = ("evaluate", "slip", *SENSORS, "--model", "shipped", "--by", "sensor")
    answer = answer_of(*words)
    rows = [row for row in answer["rows"] if {"sensor", "counted"} <= row.keys()]
    assert [(row["sensor"], row["counted"], row["abstained"]) for row in rows] == list(
        zip(SENSORS, n, abstained, strict=True)
    )
    assert (answer["summary"]["slips"], answer["summary"]["abstained"]) == (sum(n), sum(abstained))
    shown = evetac(*words)
    assert f"n = {sum(n)} of 20 trajectories, {sum(abstained)} abstained." in shown.output
    for sensor, number, left_out in zip(SENSORS, n, abstained, strict=True):
        assert re.search(rf"│ {sensor} +│[^│]+│ +10 │ +{number} │ +{left_out} │", shown.output)

    row = answer_of("report", "--compare", *SENSORS, "--force")["rows"][0]
    assert (row["pairs"], row["without_partner"], row["abstained"]) == (10, 0, sum(abstained))
    assert "10 by the same scene, object, seed and trial number" in row["pairing"]
    page = Path("soft-stiff.report.html").read_text()
    assert row["pairing"] in page
    for sensor, number, left_out in zip(SENSORS, n, abstained, strict=True):
        assert f"{number} of 10 trials that slip; labels abstain in {left_out}" in page
        cells = "</td><td[^>]*>".join(map(str, (sensor, 10, number, left_out)))
        assert re.search(f"<td[^>]*>{cells}</td>", page)
    answer_of("report", "soft")
    assert f"labels abstain in {abstained[0]}" in Path("soft/report.html").read_text()
