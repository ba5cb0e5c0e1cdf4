"""scripts/blind_identification.py: truths lie in their prior ranges, and the table counts as it says."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import blind_identification as blind

from evetac_cli.errors import InputError
from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.sim.setup.tables import as_table

NAMES = [parameter.name for parameter in blind.PARAMETERS]


def test_truths_lie_in_their_prior_ranges() -> None:
    """Assert that what is compared can be had of a sensor's row, that names come once, and that ranges hold them."""
    assert len(set(NAMES)) == len(NAMES)
    for number in range(9000, 9050):
        sensor = one_sensor(f"{blind.RANGES}:{number}")
        for parameter in blind.PARAMETERS:
            low, high = parameter.prior
            assert low <= parameter.truth(sensor) <= high, (number, parameter.name)


def test_priors_are_those_of_the_table() -> None:
    """Assert that ranges that follow from those of sensors are as they were when the table was made."""
    table = json.loads((blind.ROOT / "docs" / "results" / "blind-identification.json").read_text())
    assert [row["parameter"] for row in table["rows"]] == NAMES
    for row, parameter in zip(table["rows"], blind.PARAMETERS, strict=True):
        prior = pytest.approx((row["prior_low"], row["prior_high"]), rel=2e-3, abs=1e-12)
        assert parameter.prior == prior, parameter.name


@pytest.mark.parametrize("name", blind.SCENES)
def test_scenes_are_as_packaged_but_for_what_is_changed(name: str, tmp_path: Path) -> None:
    """Assert that the scenes are read, with what is changed and nothing else."""
    (tmp_path / "changed.toml").write_text(blind.changed(name, blind.SCENES[name]))
    packaged, made = (as_table(scene_file.load(file)) for file in (name, str(tmp_path / "changed.toml")))
    assert made != packaged
    assert made == scene_file.merged(packaged, blind.SCENES[name])


def result(low: float, high: float, *, truth: float = 0.05, name: str = "noise_hz") -> dict[str, Any]:
    """What is kept of a sensor of which one parameter is told."""
    row = {"parameter": name, "estimate": (low + high) / 2, "low": low, "high": high}
    return {"rows": [row], "truth": {name: truth}, "places_off_px": [0.1] * 10}


def test_widths_and_hits_are_counted() -> None:
    """Assert width over the prior range, hits, and that only a parameter told of all sensors, and narrow, is found."""
    narrow = [result(0.04, 0.06)] * 9 + [result(0.06, 0.07)]
    by_name = {row["parameter"]: row for row in blind.parameter_rows(narrow)}
    row = by_name["noise_hz"]
    assert row["told"] == 10 and row["held"] == 9 and row["found"]
    assert row["width_mean"] == pytest.approx((9 * 0.02 + 0.01) / 10 / 0.095)
    assert by_name["mismatch"]["told"] == 0 and not by_name["mismatch"]["found"]
    more_missed = blind.parameter_rows([result(0.04, 0.06)] * 8 + [result(0.06, 0.07)] * 2)
    wide = blind.parameter_rows([result(0.02, 0.09)] * 10)
    not_always = blind.parameter_rows([*narrow, {**result(0, 0), "rows": []}])
    for rows in (more_missed, wide, not_always):
        assert not next(row for row in rows if row["parameter"] == "noise_hz")["found"]


def test_places_are_one_parameter() -> None:
    """Assert that dots' places are held where nine of ten coordinates are within what the row says."""
    places = next(parameter for parameter in blind.PARAMETERS if parameter.name == blind.PLACES)
    one = result(0.0, 0.4, name=blind.PLACES)
    assert blind.interval(one, places) == (pytest.approx(0.4 / 12.0), True)
    assert blind.interval({**one, "places_off_px": [0.1] * 8 + [0.3] * 2}, places) == (pytest.approx(0.4 / 12.0), False)
    assert blind.interval({**one, "places_off_px": None}, places) is None


def test_twins_and_others() -> None:
    """Assert that a twin with the sensor's windows is like it, and that another sensor is told apart."""
    rng = np.random.default_rng(0)
    windows = {
        number: {name: rng.standard_normal((40, 26)) + 3.0 * number for name in ("first", "second", "twin")}
        for number in (1, 2)
    }
    rows = blind.area_rows(windows)
    assert all(row["auc_other"] > 0.95 and row["other_is_not"] for row in rows)
    assert all(0.2 < row["auc_twin"] < 0.8 for row in rows)


def keep(folder: Path, number: int, *, camera_only: bool) -> None:
    """What a whole run leaves of a sensor."""
    (folder / f"{number}.json").write_text(json.dumps({"number": number, "camera_only": camera_only}))
    np.savez(folder / f"{number}.npz", **{name: np.zeros((8, 26)) for name in ("first", "second", "twin")})


def test_a_sensor_that_was_cut_off_is_not_kept(tmp_path: Path) -> None:
    """Assert that a result of which a part is missing, or ends too early, counts as none, so that it is made again."""
    for number in range(1, 6):
        keep(tmp_path, number, camera_only=False)
    (tmp_path / "2.npz").unlink()
    for name in ("3.npz", "4.json"):
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(whole[: len(whole) // 2])
    (tmp_path / "5.npz").write_bytes(b"")
    assert [blind.kept(tmp_path, number) is not None for number in range(1, 7)] == [True, *[False] * 5]
    assert list(blind.all_kept(tmp_path, camera_only=False)) == [1]


def test_runs_with_and_without_a_gripper_are_not_mixed(tmp_path: Path) -> None:
    """Assert that a folder of whole runs is refused to a run without grips, and the other way round."""
    keep(tmp_path, 7, camera_only=True)
    assert list(blind.all_kept(tmp_path, camera_only=True)) == [7]
    with pytest.raises(InputError, match="without the gripper: 7"):
        blind.all_kept(tmp_path, camera_only=False)
    keep(tmp_path, 8, camera_only=False)
    with pytest.raises(InputError, match="with the gripper: 8"):
        blind.all_kept(tmp_path, camera_only=True)
