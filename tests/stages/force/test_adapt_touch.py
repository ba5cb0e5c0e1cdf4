"""train-force --method touch: known forces find a gel's stiffness; hostile readings; evaluate force of touch maps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.errors import InputError
from evetac_cli.evaluate.force import SUBJECT, EvaluateForce
from evetac_cli.evaluate.force import measure as evaluate_force
from evetac_cli.inspect import info
from evetac_cli.stages.force import adapt_touch, train_force
from evetac_cli.stages.touch import predict_touch
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.make import run_valid
from tests.stages.touch.contacts import MODULUS_PA, SHEARED, TOUCHED, contact, own_sensor, write_contact

TOUCH = TrainForce(method="touch")
# Of the smaller shapes, whose friction is soon solved for.
CONTACTS = [*(("edge", seed) for seed in range(6000, 6004)), *(("two points", seed) for seed in range(6000, 6004))]
CONTACTS += [("ball", 6000), ("ball", 6001)]


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Tracks of ten contacts of three shapes with their truth."""
    folder = tmp_path_factory.mktemp("own")
    return [write_contact(folder, number, contact(*one)) for number, one in enumerate(CONTACTS)]


@pytest.mark.slow
def test_adaptation_finds_the_gel(own: list[Path], tmp_path: Path) -> None:
    """Assert that ten contacts correct a modulus that is told 30 % too high, from truth as from a table, and forces."""
    told = replace(TOUCH, sensor=own_sensor(tmp_path, stiffer=1.3), stiffness_error=0.3)
    model, outcome = run_valid(train_force, own, told, tmp_path)
    assert model.name == "own.force-model.h5"
    row = outcome.rows[0]
    assert (row["contacts"], row["without_readings"]) == (10, None)
    assert row["shear_modulus_kpa_before"] == pytest.approx(1.3e-3 * MODULUS_PA)
    assert row["shear_modulus_kpa"] == pytest.approx(1e-3 * MODULUS_PA, rel=0.03)
    assert 0.01 < row["shear_modulus_sd_kpa"] / row["shear_modulus_kpa"] < 0.06
    assert 0.9 < row["normal_factor"] < 1.12  # beside it a part of the deviation, which all of these contacts have
    assert info.run([model]).rows[0]["adapted_shear_modulus_pa"] == pytest.approx(1e3 * row["shear_modulus_kpa"])

    path = write_contact(tmp_path, 20, contact("ball", 6002))
    output, made = run_valid(predict_touch, [path], PredictTouch(model=model), tmp_path)
    assert made.rows[0]["shear_modulus"] == "adapted"
    with StageFile(output) as file:
        shear_n, normal_n, normal_sd_n = (file.read(name)[-1] for name in ("shear_n", "normal_n", "normal_sd_n"))
        cells = file.read("map/shear_pa")[-1].sum(axis=(1, 2)) * 1e-6
        reference = int(file.read("reference_slice")[-1])
    true = contact("ball", 6002)
    assert shear_n == pytest.approx(true.net_shear_n, abs=0.06 * np.hypot(*true.net_shear_n) + 0.03)
    assert abs(normal_n - true.normal_n) < 2 * normal_sd_n < 0.4 * true.normal_n
    assert cells == pytest.approx(shear_n, abs=0.05)  # but for an offset of the readings
    assert 0 < reference < SHEARED

    few = own[-3:]
    for one in few:
        with StageFile(one.with_name(one.name.replace("tracks", "recording"))) as file:
            (x, y), normal = file.read("truth/shear_force_n")[-1], file.read("truth/normal_force_n")[-1]
        table = one.with_name(one.name.replace("tracks.h5", "force.csv"))
        table.write_text(f"t_s,shear_x_n,shear_y_n,normal_n\n0.3,{x},{y},{normal}\n")
    _, from_tables = run_valid(train_force, few, told, tmp_path / "tables.force-model.h5")
    for one in few:
        one.with_name(one.name.replace("tracks.h5", "force.csv")).unlink()
    assert from_tables.rows[0]["readings"] == 3
    assert from_tables.rows[0]["shear_modulus_kpa"] == pytest.approx(1e-3 * MODULUS_PA, rel=0.1)

    for files, chosen, message in (
        ([write_contact(tmp_path, 21, contact(), name="second")], PredictTouch(model=model), "not the sensor"),
        ([path], PredictTouch(model=model, sensor="evetac"), "stiffness of its sensor"),
        ([path], PredictTouch(model=model, height_mm=3.0), "--height-mm: has no effect"),
    ):
        with pytest.raises(InputError, match=message):
            run_valid(predict_touch, files, chosen, tmp_path / "refused.h5")
    with pytest.raises(InputError, match="not of the paper's method"):
        run_valid(evaluate_force, [path], EvaluateForce(model=str(model)), tmp_path / "refused.h5")


@pytest.mark.slow
def test_errors_by_what_is_known(tmp_path: Path) -> None:
    """Assert a row for each state of knowledge, less error the more is known, and what cannot be judged refused."""
    path, *_ = (
        write_contact(tmp_path, number, contact("ball", seed), stiffer=2.0)
        for number, seed in ((20, 6002), (8, 6000), (9, 6001))
    )
    identified = tmp_path / "identified"
    identified.mkdir()
    Path(own_sensor(tmp_path, stiffer=2.0)).rename(identified / "evetac.sensor.toml")
    chosen = EvaluateForce(adapt_on=str(tmp_path / "trial[89].tracks.h5"), identified=str(identified))
    _, outcome = run_valid(evaluate_force, [path], chosen, tmp_path / "r.report.h5")
    rows = {row["stiffness"]: row for row in outcome.rows}
    assert list(rows) == ["unknown", "known", "identified", "adapted", "known, adapted", "identified, adapted"]
    assert rows["identified"]["mae_n"] < 0.1
    assert rows["adapted"]["mae_n"] < 0.75 * rows["unknown"]["mae_n"]
    assert rows["adapted"]["contact_right"] == rows["adapted"]["usable"] == 1.0
    assert rows["identified, adapted"]["normal_mae_n"] < rows["unknown"]["normal_mae_n"]
    assert outcome.summary["identified_sensors"] == 1
    for files, wrong, message in (
        ([path], replace(chosen, identified=str(tmp_path / "none")), "no file of any"),
        ([path], replace(chosen, adapt_on=str(path)), "evaluated on"),
        ([write_contact(tmp_path, 22, None)], EvaluateForce(), "have no contact"),
    ):
        with pytest.raises(InputError, match=message):
            run_valid(evaluate_force, files, wrong, tmp_path / "refused.h5")


def test_trajectories_without_an_error_are_left_out(tmp_path: Path) -> None:
    """Assert that means are over the trajectories with a contact, as without the others, and that n says so."""
    pressed, empty = (write_contact(tmp_path, number, of) for number, of in ((20, contact("ball", 6002)), (22, None)))
    outcomes = [
        run_valid(evaluate_force, files, EvaluateForce(), tmp_path / f"{len(files)}.report.h5")[1]
        for files in ([pressed], [pressed, empty])
    ]
    alone, both = (outcome.summary for outcome in outcomes)
    for name in ("mae_n", "normal_within_sd", "counted", "sensors", "worst_sensor_mae_n"):
        assert both[f"known_{name}"] == alone[f"known_{name}"], name
    assert (both["trajectories"], both["known_counted"]) == (2, 1)
    row = next(row for row in outcomes[1].rows if row["file"] == empty.name)
    assert (row["mae_n"], row["slices_counted"], row["slices_in_contact"]) == (None, 0, 0)
    _, (unknown, known) = evaluate_force.for_people(outcomes[1].rows, EvaluateForce())
    assert unknown.endswith("n = 1 of 2 trajectories; 1 without a slice in which a contact is found and enough dots are"
                            " tracked.")  # fmt: skip
    assert f"force {both['known_mae_n']:.3g} N" in known
    on_page = SUBJECT.tables[1].rows(outcomes[1].rows, both)
    assert [(row["trajectories"], row["counted"]) for row in on_page] == [(2, 1), (2, 1)]


def test_what_cannot_be_adapted(own: list[Path], tmp_path: Path) -> None:
    """Assert that two sensors, no contact at all and another frame are refused, and a file without contact is named."""
    rested = write_contact(tmp_path, 22, None)
    for files, message in (
        ([rested], "no reading during a contact"),
        ([own[0], write_contact(tmp_path, 21, contact(), name="second")], "different sensors"),
        ([write_contact(tmp_path, 23, contact(), smaller=2)], "the scale of this frame"),
    ):
        with pytest.raises(InputError, match=message):
            run_valid(train_force, files, TOUCH, tmp_path / "refused.h5")
    _, outcome = run_valid(train_force, [own[0], rested], TOUCH, tmp_path / "one.force-model.h5")
    assert (outcome.rows[0]["contacts"], outcome.rows[0]["without_readings"]) == (1, "trial22.tracks.h5")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a table of forces"),
        ("t,fx,fy,fz\n0,1,2,3", "not a table of forces"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n", "no reading"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n0.3,1,2", "not a reading"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n0.3,1,inf,3", "not a reading"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n,1,2,3", "not a reading"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n9.4,1,2,3", "not a reading"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n0.3,,,\n", "no reading"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n0.01,1,,\n", "no reading during a contact"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n0.3,1,2,\0", "not a reading"),
        pytest.param("t_s,shear_x_n,shear_y_n,normal_n\n0.3,1,2," + "1" * 200_000, "field larger", id="large field"),
    ],
)
def test_tables_that_are_none(tmp_path: Path, text: str, message: str) -> None:
    """Assert that a table without readings, or with senseless ones, is refused in words."""
    path = write_contact(tmp_path, 0, contact(), truth=False)
    with pytest.raises(InputError, match="no known forces"):
        run_valid(train_force, [path], TOUCH, tmp_path)
    path.with_name("trial0.force.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        run_valid(train_force, [path], TOUCH, tmp_path)


def test_contacts_are_numbered_over_time() -> None:
    """Assert that a contact is a stretch of time: short gaps do not divide it, short touches are none, none is none."""
    touches = np.zeros(3000, np.bool_)
    for begin, end in ((100, 500), (600, 900), (1200, 1350), (2000, 3000)):
        touches[begin:end] = True
    numbers = adapt_touch.contact_numbers(touches)
    assert (numbers[100:900] == 0).all()
    assert (numbers[2000:] == 1).all()
    assert (np.delete(numbers, [*range(100, 900), *range(2000, 3000)]) == -1).all()
    assert (adapt_touch.contact_numbers(np.zeros(50, np.bool_)) == -1).all()
    assert adapt_touch.contact_numbers(touches[:0]).shape == (0,)


def test_two_contacts_with_a_reading_each(tmp_path: Path) -> None:
    """Assert that readings are of two contacts where the gel was let go in between, of none where no dot moves."""
    path = write_contact(tmp_path, 1, contact())
    with StageFile(path) as file:
        header, arrays = file.header, {name: file.read(name) for name in file.contents()}
    for name in ("dot_xy_px", "events_per_dot", "lost"):
        arrays[name] = np.concatenate([arrays[name], *[arrays[name][:TOUCHED]] * 12, arrays[name]])
    own = tmp_path / "own"
    own.mkdir()
    write_stage(own / path.name, Recipe("tracks", 1, {"preset": "let go"}, parents=(header,)), arrays)
    (own / "trial1.force.csv").write_text("t_s,shear_x_n,shear_y_n,normal_n\n0.01,0,0,\n0.2,0,0,\n0.7,0,0,\n")
    _, outcome = run_valid(train_force, [own / path.name], TOUCH, own)
    assert (outcome.rows[0]["contacts"], outcome.rows[0]["readings"]) == (2, 2)


def test_two_sensors_of_one_name_are_refused(tmp_path: Path) -> None:
    """Assert that a second gel under the name of the first is not taken for it."""
    files = [write_contact(tmp_path, number, None, stiffer=number) for number in (1, 2)]
    with pytest.raises(InputError, match="two sensors of one name"):
        run_valid(evaluate_force, files, EvaluateForce(), tmp_path / "r.report.h5")
