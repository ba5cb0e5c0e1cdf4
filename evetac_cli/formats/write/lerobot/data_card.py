"""The data card of a data set of episodes; it says first what is simulated, and states no license.

The license is up to whoever publishes the data.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from evetac_cli.events import SLICES_PER_S
from evetac_cli.formats.write.hub_card import NO_LICENSE, card_fields, card_text, inline, table
from evetac_cli.formats.write.lerobot.episodes import EpisodeOutline, Vectors
from evetac_cli.store.layout.provenance import made

RULES = {
    "mean": "the mean of the frame's slices",
    "last": "the last slice of the frame",
    "stacked": "the last {stacked} slices of the frame, one after the other, the oldest first",
}
LONGEST_CELL = 80  # of what stands in a file


def data_card(
    outlines: Sequence[EpisodeOutline],
    vectors: Vectors,
    info: Mapping[str, Any],
    per_frame: str,
    tactile_key: str,
    left_out: Sequence[str],
) -> str:
    """The card; info is what meta/info.json says."""
    simulated = sum(one.facts["simulated"] for one in outlines)
    fps = info["fps"]
    rule = RULES[per_frame].format(stacked=SLICES_PER_S // fps)
    pixels = info["features"]["observation.images.tactile"]["shape"]
    frame = {
        "observation.state": (len(vectors.state), f"{', '.join(vectors.state)}: the last measured"),
        tactile_key: (
            info["features"][tactile_key]["shape"][0],
            f"{len(vectors.tactile)} figures of touch, {rule}",
        ),
        "observation.images.tactile": (
            f"{pixels[1]} x {pixels[0]} px",
            "all events of the frame: white brighter, black darker, grey none",
        ),
        "action": (len(vectors.action), f"{', '.join(vectors.action)}: the goal that stands one frame later"),
    }
    fields = {
        **card_fields(simulated > 0, None, "LeRobot"),
        "task_categories": ["robotics"],
        "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
    }
    page = [
        "# Touch of an event camera behind a dotted gel" + (", simulated" if simulated == len(outlines) else ""),
        _origin(simulated, len(outlines)),
        f"{len(outlines)} episodes, {info['total_frames']} frames at {fps} frames a second, as a LeRobotDataset"
        f" {info['codebase_version']}. Written by evetac {made()['evetac']}; meta/evetac.json has the recipe of every"
        " file that an episode comes from: parameters, seeds, ids.",
        "## What a frame holds",
        table(
            [{"name": f"`{name}`", "values": str(values), "what it is": what} for name, (values, what) in frame.items()]
        ),
        f"The sensor gives {SLICES_PER_S} slices a second. Frame i is made of those from i * {SLICES_PER_S} / {fps} ms "
        f"on, up to the start of the next, and its timestamp is i / {fps} s. What is not known holds its last value,"
        " and is 0 before the first. Units end the names. Names of all figures are in meta/info.json.",
        "## Episodes",
        table(_episodes(outlines, info["splits"])),
        "Tasks: " + "; ".join(dict.fromkeys(inline(one.task) for one in outlines)) + ".",
        *([f"Left out: {inline('; '.join(left_out), 2000)}."] if left_out else []),
        "## License",
        NO_LICENSE,
    ]
    return card_text(fields, page)


def _origin(simulated: int, episodes: int) -> str:
    if not simulated:
        return "Recorded with devices or by other programs; no episode is simulated."
    share = "All episodes are" if simulated == episodes else f"{simulated} of {episodes} episodes are"
    return (
        f"**Simulated.** {share} from evetac's simulator of gel, gripper and event camera, not from a real sensor. A"
        " policy that is trained on them has seen no real touch."
    )


def _episodes(outlines: Sequence[EpisodeOutline], splits: Mapping[str, str]) -> list[dict[str, str]]:
    """A row for every object, sensor, outcome and split, with how many episodes it has."""
    counted: Counter[tuple[str, ...]] = Counter()
    facts = ("object", "sensor", "outcome")
    for number, one in enumerate(outlines):
        (split,) = [name for name, part in splits.items() if number in range(*map(int, part.split(":")))]
        values = (one.facts[fact] for fact in facts)
        cells = (inline("unknown" if value is None else str(value), LONGEST_CELL) for value in values)
        counted[(*cells, split)] += 1
    return [
        {**dict(zip((*facts, "split"), row, strict=True)), "episodes": str(count)} for row, count in counted.items()
    ]
