"""A sensor as a file: what is accepted, how what is wrong is said, and that only the content counts."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.commands.record import Record
from evetac_cli.sim.camera.gel_camera import dot_grid
from evetac_cli.sim.setup.plan import named_sensor, one_sensor
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
