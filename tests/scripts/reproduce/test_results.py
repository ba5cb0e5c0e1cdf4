"""scripts/reproduce/results.py: tables say how they were made."""

from dataclasses import fields

from evetac_cli.commands.train import Train
from evetac_cli.jobs import Row
from evetac_cli.kernels.slip.training import PRESETS
from scripts.reproduce import facts, results, table_text

DOCS = results.ROOT / "docs"
LEARNED_TRUTH = range(4, 7)  # versions of `train` whose preset adamw always learned it from simulated recordings


def test_a_training_that_learns_truth_says_so() -> None:
    """Assert that the flag's help says truth, that no preset does it, and that rows which learned it are named so."""
    (said,) = (item.metadata["help"] for item in fields(Train) if item.name == "learn_true_slip_share")
    assert "truth" in said
    assert not any(preset.share_weight for preset in PRESETS.values())


RESULT = {
    "name": "grip",
    "title": "Grip of object 3",
    "simulated": True,
    "made": "commit abc1234",
    "commit": "abc1234",
    "commands": ["evetac evaluate grasp *.recording.h5"],
    "methods": {},
    "sizes": {"recording_seeds": [7, 8, 9, 20], "training_seeds": []},
    "source": {"simulated": True, "scenes": ["edge"]},
    "columns": [
        {"heading": "who", "cell": "{who}"},
        {"heading": "kept (paper)", "cell": "{kept:.2f}", "paper": "{paper_consistent_share:.2f}"},
    ],
    "across": None,
    "notes": ["A note."],
    "rows": [
        {"who": "a", "kept": 0.5, "preset": "paper", "trajectories": 3, "paper_consistent_share": 0.8},
        {"who": "b", "kept": 1.0, "preset": "stable", "trajectories": 3, "paper_consistent_share": None},
    ],
}


def test_a_table_says_how_it_was_made() -> None:
    """Assert that title, commit, marks, notes, place of the commands and seeds stand around the rows."""
    assert table_text.text(RESULT) == (
        "Simulated. Grip of object 3 (commit abc1234):\n\n| who | kept (paper) |\n| --- | --- |\n"
        "| a | 0.50 (0.80, fitted) |\n| b | 1.00 |\n\nA note.\n\n"
        "Commands: `docs/results/grip.json`; seeds of recordings 7-9, 20.\n"
    )


def test_a_table_of_the_default_sensor_of_today_does_not_name_it() -> None:
    """Assert that only tables that were made with other values of `evetac` say so, with their commits."""
    today = {"default_sensor": facts.default_sensor(), "commit": "aaa"}
    assert facts.made_on([today]) == ""
    line = facts.made_on([today, {"commit": "ccc"}, {"commit": "bbb", "default_sensor": "another"}, {}])
    assert line == "Made at bbb, ccc on `small-dots`, then the values of `evetac`."


def test_dots_in_frames_have_a_method_of_their_own() -> None:
    """Assert that a model that learned from dots in frames does not lower the method of dots in events."""

    def report(method: int, seed: int | None) -> Row:
        tracks = {"kind": "tracks", "method": method, "seed": seed, "parameters": {}}
        trained = {"recording": 7, "tracks": method}
        model = {"kind": "force-model", "method": 1, "seed": 3, "parameters": {}, "methods": trained}
        return {"kind": "report", "method": 5, "parameters": {}, "history": {"a": tracks, "b": model}}

    found = facts.methods([report(7, None), report(2, 0)])
    assert found == {"record": 7, "track": 7, "train-force": 1, "track --rgb": 2}


def test_a_long_table_is_folded() -> None:
    """Assert that a table of more than ten rows opens on a click, with the same parts."""
    text = table_text.text(RESULT | {"title": "Grip of `a`", "rows": 6 * RESULT["rows"]})  # type: ignore[operator]
    assert text.startswith(
        '<details markdown="1">\n\n<summary>Simulated. Grip of <code>a</code> (commit abc1234), 12 rows</'
    )
    assert text.endswith("A note.\n\n" + table_text.how_made(RESULT) + "\n\n</details>\n")
