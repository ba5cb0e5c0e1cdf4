"""Origin of the rows of a report, according to its headers; it decides how the paper's figures compare."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from evetac_cli.store.layout.ancestry import scene_words, trajectories

Row = Mapping[str, Any]
LABELS, TRUTH = "labels", "truth of the simulation"  # by which onsets `evaluate slip` judges trials


@dataclass(frozen=True)
class Source:
    """Origin of the rows of a report, according to the headers of its files."""

    simulated: bool = False
    scenes: tuple[str, ...] = ()
    trackers: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()
    detectors: tuple[str, ...] = ()  # used in grasps
    grasp_s: tuple[float, ...] = ()  # durations of lifting and balancing with a detector
    training_recordings: int = 0
    networks: int = 1  # in the ensemble of a detector, which averages them; the paper has one

    @classmethod
    def of(cls, headers: Iterable[Row]) -> "Source":
        """Return the source of the headers of a report, or of the files it was made from."""
        every: dict[str, Row] = {}
        for header in headers:
            every |= {**header["history"], header["id"]: header}
        of_kind: dict[str, dict[str, Row]] = defaultdict(dict)
        for id_, one in every.items():
            of_kind[one["kind"]][id_] = one
        detectors, recordings = of_kind["model"], of_kind["recording"].values()
        grasps = [one for one in recordings if not detectors.keys().isdisjoint(one["parents"])]
        rows = trajectories(every.values())
        used = {id_ for one in grasps for id_ in one["parents"]} & detectors.keys()
        trackers = {one["parameters"].get("preset") for one in of_kind["tracks"].values()}
        trackers |= {row["tracker"] for row in rows}
        labels = [one["parameters"].get("method", "farneback") for one in of_kind["labels"].values()]
        durations = {tuple(float(one["parameters"].get(name, 0)) for name in ("lift_s", "balance_s")) for one in grasps}
        return cls(
            simulated=any(one.get("simulated", False) for one in every.values()),
            scenes=_texts([*(_scene(one["parameters"]) for one in recordings), *(row["scene"] for row in rows)]),
            trackers=_texts(
                [*trackers - {"rgb"}, *((one["parameters"].get("tracker") or {}).get("preset") for one in grasps)]
            ),
            labels=_texts([*labels, *(row["labels"] for row in rows)]),
            detectors=_texts(_detector(detectors[id_]["parameters"]) for id_ in used),
            grasp_s=tuple(second for pair in sorted(durations) for second in pair),
            training_recordings=len({row["recording"] for row in rows} - {None}),
            networks=max((one["parameters"].get("networks", 1) for one in detectors.values()), default=1),
        )

    @property
    def detector(self) -> str:
        """The detectors of grasps in words, with the number of networks if several are averaged."""
        return " + ".join(self.detectors) + (f", {self.networks} networks" if self.networks > 1 else "")

    @classmethod
    def from_json(cls, stored: Row) -> "Source":
        """Restore a source that was stored as JSON from dataclasses.asdict."""
        entries: dict[str, Any] = {name: tuple(one) if isinstance(one, list) else one for name, one in stored.items()}
        return cls(**entries)


def _texts(values: Iterable[Any]) -> tuple[str, ...]:
    return tuple(sorted({str(one) for one in values if one is not None}))


def _scene(parameters: Row) -> str | None:
    scene = parameters.get("scene")
    return scene if isinstance(scene, str) else scene_words(parameters, "name")


def _detector(parameters: Row) -> str:
    horizon_ms = parameters.get("horizon_ms")
    predicting = f" {horizon_ms} ms ahead" if horizon_ms else ""
    return f"{parameters.get('model')}{predicting} by {parameters.get('preset')}"
