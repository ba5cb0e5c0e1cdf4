"""The data card of a data set of episodes, README.md as the Hugging Face Hub shows it; it says first what is simulated.

The lines between `---` are YAML that the Hub reads. No licence is stated: that is up to whoever publishes the data.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from evetac_cli.formats.write.episodes import RATE_HZ, Outline, Vectors
from evetac_cli.store.provenance import made

RULES = {
    "mean": "the mean of the frame's slices",
    "last": "the last slice of the frame",
    "stacked": "the last {stacked} slices of the frame, one after the other, the oldest first",
}
LONGEST_TEXT = 80  # of what stands in a file, in a cell


def data_card(
    outlines: Sequence[Outline],
    vectors: Vectors,
    info: Mapping[str, Any],
    per_frame: str,
    tactile_key: str,
    left_out: Sequence[str],
) -> str:
    """The card; info is what meta/info.json says."""
    simulated = sum(one.facts["simulated"] for one in outlines)
    fps = info["fps"]
    rule = RULES[per_frame].format(stacked=RATE_HZ // fps)
    pixels = info["features"]["observation.images.tactile"]["shape"]
    tags = ["LeRobot", "tactile", "event-camera", "evetac", *(["simulated"] if simulated else [])]
    lines = [
        "---",
        "task_categories:",
        "- robotics",
        "tags:",
        *(f"- {tag}" for tag in tags),
        "configs:",
        "- config_name: default",
        "  data_files: data/*/*.parquet",
        "---",
        "",
        "# Touch of an event camera behind a dotted gel" + (", simulated" if simulated == len(outlines) else ""),
        "",
        _origin(simulated, len(outlines)),
        "",
        f"{len(outlines)} episodes, {info['total_frames']} frames at {fps} frames a second, as a LeRobotDataset"
        f" {info['codebase_version']}. Written by evetac {made()['evetac']}; meta/evetac.json has the recipe of every"
        " file that an episode comes from: parameters, seeds, ids.",
        "",
        "## What a frame holds",
        "",
        "| name | values | what it is |",
        "|---|---|---|",
        f"| `observation.state` | {len(vectors.state)} | {', '.join(vectors.state)}: the last measured |",
        f"| `{tactile_key}` | {info['features'][tactile_key]['shape'][0]} | {len(vectors.tactile)} figures of touch,"
        f" {rule} |",
        f"| `observation.images.tactile` | {pixels[1]} x {pixels[0]} px | all events of the frame: white brighter,"
        " black darker, grey none |",
        f"| `action` | {len(vectors.action)} | {', '.join(vectors.action)}: the goal that stands one frame later |",
        "",
        f"The sensor gives {RATE_HZ} slices a second. Frame i is made of those from i * {RATE_HZ} / {fps} ms on, up to"
        f" the start of the next, and its timestamp is i / {fps} s. What is not known holds its last value, and is 0"
        " before the first. Units end the names. Names of all figures are in meta/info.json.",
        "",
        "## Episodes",
        "",
        "| object | sensor | outcome | split | episodes |",
        "|---|---|---|---|---|",
        *_episodes(outlines, info["splits"]),
        "",
        "Tasks: " + "; ".join(dict.fromkeys(_plain(one.task, 300) for one in outlines)) + ".",
        "",
        *([f"Left out: {_plain('; '.join(left_out), 2000)}.", ""] if left_out else []),
        "## Licence",
        "",
        "None is stated. Whoever publishes this data set chooses one.",
        "",
    ]
    return "\n".join(lines)


def _origin(simulated: int, episodes: int) -> str:
    if not simulated:
        return "Recorded with devices or by other programs; no episode is simulated."
    share = "All episodes are" if simulated == episodes else f"{simulated} of {episodes} episodes are"
    return (
        f"**Simulated.** {share} from evetac's simulator of gel, gripper and event camera, not from a real sensor. A"
        " policy that is trained on them has seen no real touch."
    )


def _episodes(outlines: Sequence[Outline], splits: Mapping[str, str]) -> list[str]:
    """A row for every object, sensor, outcome and split, with how many episodes it has."""
    counted: Counter[tuple[str, ...]] = Counter()
    for number, one in enumerate(outlines):
        (split,) = [name for name, part in splits.items() if number in range(*map(int, part.split(":")))]
        named = (_plain(one.facts[fact]) for fact in ("object", "sensor", "outcome"))
        counted[(*named, split)] += 1
    return [f"| {' | '.join(row)} | {count} |" for row, count in counted.items()]


def _plain(value: Any, longest: int = LONGEST_TEXT) -> str:
    """A value from a file as text that is no Markdown and no HTML."""
    text = "unknown" if value is None else str(value)
    return "".join(letter if letter.isprintable() and letter not in "|<>[]`*" else " " for letter in text)[:longest]
