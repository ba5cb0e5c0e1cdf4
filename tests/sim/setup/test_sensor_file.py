"""A sensor as a file: what is accepted, how what is wrong is said, and that only the content counts."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.record import Record
from evetac_cli.kernels.calibration import grid
from evetac_cli.resources import table
from evetac_cli.sim.camera.gel_camera import Lens, dot_grid
from evetac_cli.sim.setup.plan import named_sensor, one_sensor
from evetac_cli.sim.setup.sensor_file import FOR_EACH_TRIAL, over, rows, whole
from evetac_cli.sim.setup.tables import as_table
from evetac_cli.text_files import as_toml
from evetac_cli.trials import record
from evetac_cli.trials.record import simulated


def written(folder: Path, stem: str = "mine", /, **keys: Any) -> str:
    path = folder / f"{stem}.sensor.toml"
    path.write_text(as_toml({"like": "evetac", **keys}))
    return str(path)


def test_what_a_file_leaves_out_is_as_in_the_sensor_it_is_like(tmp_path: Path) -> None:
    """Assert that named keys replace those of the sensor, tables key by key, and that all others stay."""
    _, sensor = named_sensor(written(tmp_path, noise_hz=1, gripper={"mass_kg": 3}))
    assert as_table(sensor) == {**as_table(one_sensor("evetac")), "noise_hz": 1.0, "gripper": {"mass_kg": 3.0}}
    assert isinstance(sensor.noise_hz, float)
    _, other = named_sensor(written(tmp_path, like="randomized:2", gripper={"mass_kg": 3.0}))
    assert other.gripper == replace(one_sensor("randomized:2").gripper, mass_kg=3.0)


def test_places_of_all_dots(tmp_path: Path) -> None:
    """Assert that a sensor shows its dots exactly where its file has them, a cut gel those beside its window."""
    dots = dot_grid(one_sensor("randomized:4"), cut=False) + 0.25
    _, sensor = named_sensor(written(tmp_path, dot_xy_px=dots.tolist()))
    np.testing.assert_array_equal(dot_grid(sensor, cut=False), dots)
    np.testing.assert_array_equal(dot_grid(sensor, cut=True), dots[:, :8])
    assert not {"dot_columns_px", "dot_rows_px", "dot_jitter_px", "turned_deg"} & as_table(sensor).keys()


def test_dots_in_a_list_without_rows(tmp_path: Path) -> None:
    """Assert that a list of dots in any order is put into the rows of its grid, or is one row where it has none."""
    dots = dot_grid(one_sensor("evetac"), cut=False)
    shuffled = np.random.default_rng(0).permutation(dots.reshape(-1, 2))
    _, sensor = named_sensor(written(tmp_path, dot_xy_px=shuffled.tolist()))
    np.testing.assert_array_equal(dot_grid(sensor, cut=False), dots)
    _, sensor = named_sensor(written(tmp_path, dot_xy_px=shuffled[1:].tolist()))
    np.testing.assert_array_equal(dot_grid(sensor, cut=False), shuffled[None, 1:])
    beside = dot_grid(sensor, cut=True)
    assert beside.shape == (1, 56 - (shuffled[0, 0] < 525), 2)
    assert beside[..., 0].max() + sensor.dot_radius_px < sensor.window_px[0]


def test_the_recipe_hangs_on_the_content(tmp_path: Path) -> None:
    """Assert that another file of the same content, or like another sensor of the same row, is the same recipe."""

    def recipe_id(sensor: str) -> str:
        (job, *_) = record.jobs([], Record(scene="press", sensor=sensor), tmp_path)
        return simulated.make_recipe(job).id

    first = recipe_id(written(tmp_path, "one", noise_hz=0.5, summary="mine"))
    assert recipe_id(written(tmp_path, "two", noise_hz=0.5, summary="mine")) == first
    assert recipe_id(written(tmp_path, "two", noise_hz=0.6, summary="mine")) != first
    whole = tmp_path / "whole.toml"
    whole.write_text(as_toml({**as_table(one_sensor("evetac")), "noise_hz": 0.5, "summary": "mine"}))
    assert recipe_id(str(whole)) == first


TABLE = {
    "plain": {"noise_hz": 1.0, "dot_columns_px": [1.0, 2.0], "gripper": {"mass_kg": 1.0, "friction_n": 2.0}},
    "other": {"like": "plain", "noise_hz": 2.0, "gripper": {"mass_kg": 3.0}, "creep": {"share": [0.1]}},
    "third": {"like": "other", "dot_xy_px": [[1.0, 1.0]], "creep": {"time_s": [1.0]}},
    "fourth": {"like": "third", "dot_columns_px": [5.0, 6.0]},
}


def limits(entry: Any) -> list[tuple[str, list[float], int]]:
    """The ranges within an entry, with their streams."""
    if isinstance(entry, dict) and "stream" in entry:
        (name,) = (name for name in entry if name != "stream")
        return [(name, entry[name], entry["stream"])]
    inner = entry.values() if isinstance(entry, dict) else entry if isinstance(entry, list) else ()
    return [each for item in inner for each in limits(item)]


def test_a_row_stands_above_that_which_it_is_like() -> None:
    """Assert that keys are taken from one row to the next, the gripper's one by one, and all other tables whole."""
    assert whole("other", TABLE) == {
        "noise_hz": 2.0,
        "dot_columns_px": [1.0, 2.0],
        "gripper": {"mass_kg": 3.0, "friction_n": 2.0},
        "creep": {"share": [0.1]},
    }
    assert whole("third", TABLE)["creep"] == {"time_s": [1.0]}
    assert TABLE["plain"]["gripper"] == {"mass_kg": 1.0, "friction_n": 2.0}


def test_places_of_dots_stand_for_a_grid_and_a_grid_for_places() -> None:
    """Assert that a row has its dots once, whichever of the two the row that it is like has."""
    assert "dot_columns_px" not in whole("third", TABLE)
    assert "dot_xy_px" not in whole("fourth", TABLE)
    assert over({"dot_xy_px": [[1.0, 1.0]]}, {"noise_hz": 1.0}) == {"dot_xy_px": [[1.0, 1.0]], "noise_hz": 1.0}


def test_no_row_says_twice_what_another_says() -> None:
    """Assert that a row names nothing that it would have anyway, so that each value stands in one place."""
    for name, row in table("sensors").items():
        if "like" in row:
            base = rows()[row["like"]]
            again = [key for key, value in row.items() if key in base and base[key] == value]
            assert not again, (name, again)


@pytest.mark.parametrize("name", FOR_EACH_TRIAL)
def test_each_range_has_a_stream_of_its_own(name: str) -> None:
    """Assert that every range of the package has one distribution, ends in order and a random stream of its own."""
    ranges = limits(rows()[name])
    assert len({stream for _, _, stream in ranges}) == len(ranges)
    assert all(type(stream) is int and stream >= 0 for _, _, stream in ranges)
    assert all((0.0 if kind == "log_uniform" else -math.inf) < low <= high for kind, (low, high), _ in ranges)


def test_which_rows_are_of_many_sensors() -> None:
    """Assert that the rows drawn anew for each trial are those that hold ranges."""
    assert {name for name, row in rows().items() if limits(row)} == set(FOR_EACH_TRIAL)


def test_the_wide_ranges_hold_the_narrow_ones_and_all_named_sensors() -> None:
    """Assert that `randomized` draws from the streams of `randomized-narrow`, and leaves no reading of the dots out.

    It draws one value more: by how much less a gear rubs in motion than at rest, which `randomized-narrow` leaves at 1.
    """
    wide, narrow = ({stream: (kind, ends) for kind, ends, stream in limits(rows()[name])} for name in FOR_EACH_TRIAL)
    (more,) = wide.keys() - narrow.keys()
    assert limits(rows()["randomized"]["gripper"]["kinetic_share"]) == [("uniform", [0.67, 1.0], more)]
    assert "kinetic_share" not in rows()["randomized-narrow"]["gripper"]
    for stream, (kind, (lowest, highest)) in narrow.items():
        other, (low, high) = wide[stream]
        assert kind == other
        assert low <= lowest <= highest <= high
    ranges = rows()["randomized"]
    for name in rows().keys() - set(FOR_EACH_TRIAL):
        sensor = one_sensor(name)
        for key in ("dot_radius_px", "noise_hz", "shear_modulus_pa", "normal_modulus_pa", "threshold", "log_contrast"):
            ((_, (low, high), _),) = limits(ranges[key])
            assert low <= getattr(sensor, key) <= high, (name, key)
        ((_, (low, high), _),) = limits(ranges["distortion"])
        assert low <= sensor.distortion[0] <= high, name
        ((_, (low, high), _),) = limits(ranges["edge_sigma_px"])
        assert low <= sensor.edge_sigma_px <= high, name


def test_the_grid_of_the_authors_calibration(outside_file: Callable[[str], Path]) -> None:
    """Assert that `official-dots`, but for its jitter, is within 1 px rms of the authors' file, and `evetac` is not."""
    known = grid.arrange(np.array(json.loads(outside_file("evetac_base_calibration.json").read_text())["dot_xy_px"]))
    off_px = []
    for name in ("official-dots", "evetac"):
        sensor = replace(one_sensor(name), dot_jitter_px=0.0)
        lens = Lens.of_sensor(sensor)
        dots = dot_grid(sensor, cut=False)
        seen = dots if lens is None else lens.seen(dots)
        off_px.append(float(np.sqrt(((seen - known) ** 2).sum(axis=2).mean())))
    assert off_px[0] < 1.0 < off_px[1]
