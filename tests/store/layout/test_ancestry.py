"""Tables of what trained files were made from: the same answers as from the headers of all ancestors."""

import json
from pathlib import Path
from typing import Any

import h5py
import pytest

from evetac_cli.errors import InputError
from evetac_cli.evaluate.common.marks import Source
from evetac_cli.evaluate.slip.models import Model
from evetac_cli.inspect import validate
from evetac_cli.resources import MODEL
from evetac_cli.stages.model_files import labelled_by, learned_true_slip_share
from evetac_cli.stages.related_files import check_disjoint, recording_ids
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout import ancestry
from evetac_cli.store.layout.ancestry import Header
from evetac_cli.store.layout.provenance import Recipe, canonical, folded, history_fault, unfolded
from tests.small_files import every_kind


def recording(seed: int, **parameters: Any) -> Header:
    return Recipe("recording", 1, parameters, seed=seed, simulated_source=True).header()


def features(of: Header, method: str | None = "truth") -> Header:
    tracks = Recipe("tracks", 2, {"preset": "stable"}, parents=(of,)).header()
    labels = () if method is None else (Recipe("labels", 3, {"method": method}, parents=(of,)).header(),)
    return Recipe("features", 4, {}, parents=(of, tracks, *labels)).header()


def model(*parents: Header, learned: int, **parameters: Any) -> Recipe:
    return Recipe("model", 9, {"trained_on": learned, **parameters}, parents=parents)


KNOWN = recording(1, object=3, sensor="evetac", scene={"name": "slip"}, sensor_row={"dot_radius_px": 15.0})
UNKNOWN = recording(2, source="a.aedat4")
CUT = Recipe("recording", 1, {"object": 5}, seed=3, parents=(recording(4, object=7),)).header()
FIRST = model(features(KNOWN), features(UNKNOWN, None), learned=1, learn_true_slip_share=True)


def test_a_row_for_each_recording() -> None:
    """Assert that role, labels and tracker are those of the file learned from, and what is unknown is None."""
    known, unknown = FIRST.header()["trajectories"]
    assert known == {
        "recording": KNOWN["id"], "role": "trained on", "scene": "slip", "imported": False, "object": 3,
        "sensor": "evetac", "sensor_values": known["sensor_values"],
        "seed": 1, "simulated": True, "labels": "truth", "tracker": "stable",
        "true_slip_share": True,
    }  # fmt: skip
    assert len(known["sensor_values"]) == 16
    assert unknown["role"] == "validated on" and unknown["imported"] and not unknown["true_slip_share"]
    assert {name for name, value in unknown.items() if value is None} == {
        "scene",
        "object",
        "sensor",
        "sensor_values",
        "labels",
    }


def test_what_is_behind_a_base_and_a_recording_is_kept() -> None:
    """Assert that an adapted model, and a recording cut from another, bring all recordings, and the truth learned."""
    adapted = model(features(CUT, "event-flow"), FIRST.header(), learned=1).header()
    rows = {row["recording"]: row["role"] for row in adapted["trajectories"]}
    earlier = {KNOWN["id"], UNKNOWN["id"], CUT["parents"][0]}
    assert rows == {CUT["id"]: "trained on", **dict.fromkeys(earlier, "earlier")}
    assert recording_ids(adapted) == {*rows} and learned_true_slip_share(adapted)
    assert labelled_by(adapted) == "event-flow"
    assert adapted["history"].keys() == {FIRST.id} and history_fault(adapted) == ""
    assert {KNOWN["id"], FIRST.id} <= adapted["ancestors"].keys()


@pytest.mark.parametrize("recipe", [FIRST, model(features(CUT), FIRST.header(), learned=1)], ids=["model", "adapted"])
def test_tables_come_back(recipe: Recipe) -> None:
    """Assert that the stored tables give the same header."""
    header = recipe.header()
    plain = {name: value for name, value in header.items() if name not in ancestry.TABLES}
    assert ancestry.with_tables(plain, *ancestry.stored_tables(header).values()) == header


def test_a_report_has_the_rows_and_not_the_files() -> None:
    """Assert that the header of a report has each model's rows once, and none of the files behind it."""
    judged = features(recording(9, object=9))
    other = model(*FIRST.parents, learned=1, seed=2).header()
    report = Recipe("report", 1, {}, parents=(FIRST.header(), other, judged))
    header = report.header()
    assert header["history"].keys() == {FIRST.id, other["id"], judged["id"], *judged["history"]}
    stored = json.loads(canonical(folded(header)))
    assert canonical(stored).count('"imported"') == 4  # two rows of each model, which differ in what they learned
    assert unfolded(stored, 10**5) == header
    source = Source.of([header])
    assert (source.training_recordings, source.scenes, source.labels) == (2, ("slip",), ("truth",))


@pytest.mark.parametrize("change", [{"object": 1.5}, {"role": None}, {"more": 1}, {"recording": "0" * 64}])
def test_damaged_tables_are_refused(tmp_path: Path, change: dict[str, Any]) -> None:
    """Assert that a row of other columns is refused when the file is opened, an unknown recording by `validate`."""
    path = every_kind(tmp_path)["model"]
    with h5py.File(path, "r+") as h5:
        rows = json.loads(h5[ancestry.TRAJECTORIES].asstr()[()])
        h5[ancestry.TRAJECTORIES][()] = json.dumps([rows[0] | change, *rows[1:]])
    if "recording" in change:
        assert "the history lacks 000000000000" in validate.run([path]).rows[0]["faults"]
    else:
        with pytest.raises(InputError, match="its history cannot be read"):
            StageFile(path)


def test_the_pretrained_detector(tmp_path: Path) -> None:
    """Assert that its header is small, and what it says of its training; one of its recordings is refused."""
    with h5py.File(MODEL) as h5:
        assert len(h5.attrs["header"]) <= 150_000
    found = Model.read(MODEL)
    made = json.loads(MODEL.with_name("slip-10ms.json").read_text())
    assert sorted(map(int, found.objects)) == made["objects_trained_and_validated_on"]
    assert (found.labels, found.learned_true_slip_share) == ("truth", True)
    assert "slip-varied" in found.scenes
    assert len(recording_ids(found.header)) == len(found.header["trajectories"]) > made["training"]["trained_on"]
    seen = found.header["trajectories"][0]["recording"]
    judged = {**KNOWN, "id": seen, "history": {}}
    with pytest.raises(InputError, match="both trained on and evaluated on"):
        check_disjoint([found.header], [judged], "evaluated on", [tmp_path])
    check_disjoint([found.header], [KNOWN], "evaluated on", [tmp_path])
