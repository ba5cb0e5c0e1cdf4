"""An object as a file: what is accepted, how what is wrong is said, and that record, grasp and TouchSensor take it."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import evetac_cli as evetac
from evetac_cli.commands.record import Record
from evetac_cli.errors import InputError
from evetac_cli.resources import PACKAGE, schemas
from evetac_cli.sim import gripper
from evetac_cli.sim.setup import object_file
from evetac_cli.sim.setup.plan import named_objects
from evetac_cli.sim.setup.tables import as_table
from evetac_cli.store.files import StageFile
from evetac_cli.text_files import as_toml
from evetac_cli.trials import record

CAN = {"shape": "cylinder", "mass_g": 350, "width_mm": 66, "height_mm": 115, "static_friction": 0.8}
COARSE = {"node_pitch_mm": 1.667}


def written(folder: Path, stem: str = "can", /, **keys: Any) -> Path:
    """A file of an object: the can with other keys; those that are None are left out."""
    path = folder / f"{stem}.toml"
    path.write_text(as_toml({key: value for key, value in {**CAN, **keys}.items() if value is not None}))
    return path


def test_objects_are_the_papers() -> None:
    """Assert that the table has 20 objects with the paper's masses."""
    masses = [object_file.of_number(number).mass_g for number in range(1, 21)]
    assert masses == [341, 325, 70, 102, 236, 273, 100, 114, 119, 72, 108, 38, 116, 166, 56, 74, 248, 550, 96, 374]


def test_a_row_is_like_one_of_the_table(tmp_path: Path) -> None:
    """Assert that a file gives the row that objects.toml would have, with numbers as floats, under its name."""
    name, can = object_file.read(written(tmp_path, name="cola-can", material="tin", tilt_deg=2, lever_mm=-3))
    assert name == "cola-can"
    assert as_table(can) == {**CAN, "material": "tin", "tilt_deg": [2.0, 2.0], "lever_mm": -3.0}
    assert all(isinstance(value, float) for value in (can.mass_g, can.width_mm, can.height_mm))
    assert object_file.read(written(tmp_path))[0] == "own-object"


def test_objects_are_listed_together(tmp_path: Path) -> None:
    """Assert that files and numbers may be mixed, that a name comes once, and that what is no list says so."""
    can, box = written(tmp_path), written(tmp_path, "box", name="box", shape="flat")
    assert list(named_objects(f"8,{can},{box},1-2")) == [8, "own-object", "box", 1, 2]
    with pytest.raises(InputError, match="two objects have the same name(.|\n)*different `name`"):
        named_objects(f"{can},{can}")
    for text in ("can", "own-object", "can.tom", ""):
        with pytest.raises(InputError, match=r"not a list of objects(.|\n)*can\.toml"):
            named_objects(text)


def test_record_takes_it(tmp_path: Path, short_scene: Path) -> None:
    """Assert name of the file, object and row in the header, a label, and that another mass is another recipe."""
    recordings = []
    for mass_g in (350, 351):
        params = Record(scene=str(short_scene), objects=str(written(tmp_path, name="tin", mass_g=mass_g)), seed=3)
        (job,) = record.jobs([], params, tmp_path / f"{mass_g}")
        assert job.output.name == "short-tin-s3-000.recording.h5"
        record.run(job, params)
        with StageFile(job.output, "recording") as file:
            recordings.append(file.header)
            assert 0 < file.length("ms_to_idx") - 1 < 4000
    parameters = [header["parameters"] for header in recordings]
    assert [each["object"] for each in parameters] == ["tin", "tin"]
    assert [each["object_row"]["mass_g"] for each in parameters] == [350.0, 351.0]
    assert recordings[0]["id"] != recordings[1]["id"]


def test_the_name_of_the_file_does_not_count(tmp_path: Path, short_scene: Path) -> None:
    """Assert that two files of the same content are one recipe, wherever they lie, and that `name` makes another."""
    (tmp_path / "other").mkdir()
    files = [written(tmp_path), written(tmp_path / "other", "tin"), written(tmp_path, "named", name="tin")]
    ids = []
    for path in files:
        params = Record(scene=str(short_scene), objects=str(path))
        (job,) = record.jobs([], params, tmp_path / "out")
        ids.append(record.simulated.make_recipe(job).id)
    assert ids[0] == ids[1] != ids[2]


def test_kinetic_share_of_the_object_holds(tmp_path: Path, short_scene: Path) -> None:
    """Assert that a kinetic share in the file takes the place of the scene's, and that a sensor's own comes first."""
    sensor_file = tmp_path / "mine.sensor.toml"
    sensor_file.write_text(as_toml({"like": "evetac", "friction": {"kinetic_share": 0.7}}))
    for sensor, expected in (("evetac", 0.5), (str(sensor_file), 0.7)):
        params = Record(scene=str(short_scene), objects=str(written(tmp_path, kinetic_share=0.5)), sensor=sensor)
        (job,) = record.jobs([], params, tmp_path / "out")
        devices, _ = record.simulated.play(job)
        sampled = json.loads(devices.sampled)
        assert sampled["kinetic_friction"] == pytest.approx(sampled["static_friction"] * expected)
        devices.close()


def test_a_touch_sensor_takes_the_same_keys() -> None:
    """Assert that a dictionary of all keys but the name is accepted, and is checked against the same schema."""
    properties = json.loads((schemas() / "object.v1.json").read_text())["properties"]
    whole: dict[str, Any] = {**CAN, "kinetic_share": 0.9, "tilt_deg": 1.0, "material": "tin", "lever_mm": 1.0}
    whole |= {"grasped_width_mm": 66, "depth_mm": 40, "name": "tin"}
    assert set(whole) == set(properties)
    for given in (whole, CAN, {key: np.float64(value) if key != "shape" else value for key, value in CAN.items()}):
        sensor = evetac.TouchSensor(object=given, rng=np.random.default_rng(0), solver=COARSE)
        assert len(sensor.step(0.002, normal_n=1.0).slices) == 2


def test_the_docs_list_every_key_with_its_range(tmp_path: Path) -> None:
    """Assert that the table of docs/simulator.md has each key of the schema with its limits; its file works."""
    page = (PACKAGE.parent / "docs" / "simulator.md").read_text()
    section = page.split("## Objects of your own\n")[1].split("\n## ")[0]
    rows = dict(re.findall(r"^\| `(\w+)`[^|]*\| ([^|]+) \|", section, re.MULTILINE))
    properties = json.loads((schemas() / "object.v1.json").read_text())["properties"]
    assert set(rows) | {"material"} == set(properties)
    for key, rules in properties.items():
        one = rules.get("anyOf", [rules])[0]
        if "minimum" in one:
            assert rows[key].startswith(f"{one['minimum']:,} to {one['maximum']:,}"), key
        if "enum" in rules:
            assert sorted(rows[key].split(", ")) == rules["enum"]
    assert f"{object_file.SLIPPERIEST:g}" in rows["static_friction"]
    assert rows["grasped_width_mm"].endswith(f"{object_file.WIDEST_MM:g}")
    (tmp_path / "can.toml").write_text(re.findall(r"```toml\n(.*?)```", section, re.DOTALL)[0])
    assert object_file.read(tmp_path / "can.toml")[0] == "can"


def test_the_widest_is_what_the_gripper_opens_to() -> None:
    """Assert that the limit is that of the simulated gripper, to a tenth of a millimetre."""
    gripper.ticks_at_gap(object_file.WIDEST_MM * 1e-3)
    with pytest.raises(ValueError, match="width_m"):
        gripper.ticks_at_gap((object_file.WIDEST_MM + 0.1) * 1e-3)
