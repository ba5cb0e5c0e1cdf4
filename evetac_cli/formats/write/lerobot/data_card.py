"""The data card of a data set of episodes; it says first what is simulated, and states no license.

The license is up to whoever publishes the data.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from evetac_cli.events import SLICES_PER_S
from evetac_cli.formats.write.hub_card import NO_LICENSE, card_fields, card_text, inline, table
from evetac_cli.formats.write.lerobot.contents import FrameContents
from evetac_cli.formats.write.lerobot.episodes import TRUTH, EpisodeOutline
from evetac_cli.formats.write.lerobot.features import Feature
from evetac_cli.store.layout.provenance import made

LONGEST_CELL = 80  # of what stands in a file


def data_card(
    outlines: Sequence[EpisodeOutline], contents: FrameContents, info: Mapping[str, Any], left_out: Sequence[str]
) -> str:
    """The card; info is what meta/info.json says."""
    simulated = sum(one.facts["simulated"] for one in outlines)
    fps = info["fps"]
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
        table(_frame(contents.features)),
        f"The sensor gives {SLICES_PER_S} slices a second. Frame i is made of those from i * {SLICES_PER_S} / {fps} ms "
        f"on, up to the start of the next, and its timestamp is i / {fps} s. What is not known holds its last value,"
        " and is 0 before the first. Units end the names. Names of all figures are in meta/info.json.",
        "## Episodes",
        table(_episodes(outlines, info["splits"])),
        "Tasks: " + "; ".join(dict.fromkeys(inline(one.task) for one in outlines)) + ".",
        *([f"Left out: {inline('; '.join(left_out), 2000)}."] if left_out else []),
        "## Limitations",
        "\n".join(_limitations(contents, simulated > 0)),
        "## License",
        NO_LICENSE,
    ]
    return card_text(fields, page)


def _frame(features: Mapping[str, Feature]) -> list[dict[str, str]]:
    """A row for each feature that is described, one for those that follow each other and are described alike."""
    rows = []
    described = [(name, feature) for name, feature in features.items() if feature.what]
    for what, alike in groupby(described, key=lambda pair: pair[1].what):
        names = [(name, feature.size) for name, feature in alike]
        shown = [name for name, _ in (names if len(names) == 1 else (names[0], names[-1]))]
        name = " ... ".join(f"`{name}`" for name in shown)
        rows.append({"name": name, "values": names[0][1], "what it is": what})
    return rows


def _limitations(contents: FrameContents, simulated: bool) -> list[str]:
    """What whoever trains on it has to know, as a list."""
    said = ["Videos are H.264: near their values, not exact. The table is exact."]
    if simulated:
        said.append("Nothing simulated here was compared with a real sensor.")
    said.append("Splits are only named: lerobot trains on all episodes unless `--dataset.episodes` says which.")
    if contents.points is not None:
        said.append(
            "Of points, dz is not measured: it is 0. Forces and the wrench are estimated from the dots' motion."
        )
    else:
        said.append("Forces of touch are estimated from the dots' motion; nothing measured them.")
    if contents.stacks is not None:
        said.append(
            f"More than {contents.stacks.full_scale} events of one sign per pixel and frame are shown as so many."
        )
    if TRUTH in contents.features:
        said.append(f"`{TRUTH}` is what no sensor tells: a policy that takes it in works in the simulator alone.")
    return [f"- {one}" for one in said]


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
