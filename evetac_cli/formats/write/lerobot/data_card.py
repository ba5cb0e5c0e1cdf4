"""Write the data card of a data set of episodes: it states first what is simulated, and names no license.

The publisher of the data chooses the license.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from evetac_cli.events import SLICES_PER_S
from evetac_cli.formats.write.hub_card import NO_LICENSE, card_fields, card_text, inline, table
from evetac_cli.formats.write.lerobot.contents import FrameContents
from evetac_cli.formats.write.lerobot.episodes import EpisodeOutline
from evetac_cli.formats.write.lerobot.meta_files import Feature
from evetac_cli.store.layout.provenance import time_host_versions

LONGEST_CELL = 80  # characters of a text that comes from a file


def data_card(
    outlines: Sequence[EpisodeOutline], contents: FrameContents, info: Mapping[str, Any], left_out: Sequence[str]
) -> str:
    """Return the card; info is the content of meta/info.json."""
    simulated = sum(one.facts["simulated"] for one in outlines)
    fps = info["fps"]
    fields = {
        **card_fields(simulated > 0, None, "LeRobot"),
        "task_categories": ["robotics"],
        "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
    }
    page = [
        "# Tactile data of an event camera behind a dotted gel" + (", simulated" if simulated == len(outlines) else ""),
        _origin(simulated, len(outlines)),
        f"{len(outlines)} episodes, {info['total_frames']} frames at {fps} frames per second, as a LeRobotDataset"
        f" {info['codebase_version']}. Written by evetac {time_host_versions()['evetac']}; meta/evetac.json has the"
        " provenance of each episode's files: parameters, seeds, ids.",
        "## Contents of a frame",
        table(_frame(contents.features)),
        f"The sensor has {SLICES_PER_S} slices per second. Frame i has the slices from i * {SLICES_PER_S} / {fps} ms "
        f"up to the start of the next frame, and its timestamp is i / {fps} s. A value that is unknown keeps its last"
        " known value, and is 0 before the first. Names end with the unit. meta/info.json lists the names of all"
        " values.",
        "## Episodes",
        table(_episodes(outlines, info["splits"])),
        "meta/stats.json has the statistics of all frames of the training episodes, without those of the split `test`.",
        "Tasks: " + "; ".join(dict.fromkeys(inline(one.task) for one in outlines)) + ".",
        *([f"Left out: {inline('; '.join(left_out), 2000)}."] if left_out else []),
        "## Limitations",
        "\n".join(_limitations(contents, simulated > 0)),
        "## License",
        NO_LICENSE,
    ]
    return card_text(fields, page)


def _frame(features: Mapping[str, Feature]) -> list[dict[str, str]]:
    """Return a row per described feature; consecutive features with the same description share a row."""
    rows = []
    described = [(name, feature) for name, feature in features.items() if feature.what]
    for what, alike in groupby(described, key=lambda pair: pair[1].what):
        names = [(name, feature.size) for name, feature in alike]
        shown = [name for name, _ in (names if len(names) == 1 else (names[0], names[-1]))]
        name = " ... ".join(f"`{name}`" for name in shown)
        rows.append({"name": name, "values": names[0][1], "meaning": what})
    return rows


def _limitations(contents: FrameContents, simulated: bool) -> list[str]:
    """Return the limitations that a user of the data set needs to know, as list items."""
    lines = ["Videos are H.264, which is lossy: their values are close, not exact. The table is exact."]
    if simulated:
        lines.append("The simulated data has not been compared with a real sensor.")
    lines.append(
        "Splits are only labels: lerobot trains on all episodes unless `--dataset.episodes` selects some of them."
    )
    lines.append("Contact forces are estimated from dot motion, not measured.")
    if contents.stacks is not None:
        lines.append(
            f"More than {contents.stacks.full_scale} events of one sign per pixel and frame are clipped to this number."
        )
    return [f"- {one}" for one in lines]


def _origin(simulated: int, episodes: int) -> str:
    if not simulated:
        return "Recorded with devices or by other programs; no episode is simulated."
    share = "All episodes are" if simulated == episodes else f"{simulated} of {episodes} episodes are"
    return (
        f"**Simulated.** {share} from evetac's simulator of gel, gripper and event camera, not from a real sensor. A"
        " policy that is trained on them has not seen real tactile data."
    )


def _episodes(outlines: Sequence[EpisodeOutline], splits: Mapping[str, str]) -> list[dict[str, str]]:
    """Return a row per object, sensor, outcome and split, with its number of episodes."""
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
