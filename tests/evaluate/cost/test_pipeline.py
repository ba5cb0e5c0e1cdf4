"""The part `pipeline`: errors by hand, the tables, real trials through the whole chain."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli.cli import main
from evetac_cli.evaluate.common.rows import Extent, SolverSetting, line
from evetac_cli.evaluate.cost import EvaluateCost, pipeline
from evetac_cli.evaluate.cost import command as cost
from evetac_cli.evaluate.cost.pipeline import (
    DEFAULTS,
    ERRORS,
    Chain,
    ChainTrial,
    Lifted,
    compared,
    detection_moved_ms,
    run_chain,
    slip_errors,
    tables,
    trials,
)
from evetac_cli.evaluate.labels.measure import true_onsets
from evetac_cli.jobs import Rows
from evetac_cli.kernels.force.models import Regression
from evetac_cli.store.recordings.read import open_recording

HALF = SolverSetting("fixed step", "0.5 ms", {"step_ms": 0.5})


def chain(onset: int | None, label: int | None, detection: int | None, off_px: float = 0.0) -> Chain:
    """A trial of 100 slices with two dots that are off the truth by so much."""
    true = np.zeros((100, 2, 2))
    true[:, :, 0] = np.arange(100)[:, None]
    force = np.stack([2.0 * np.arange(100), np.zeros(100)], axis=1)
    return Chain(onset, label, detection, true + (off_px, 0.0), true, np.zeros((2, 2)), force, 100.0, 300.0)


def test_errors_by_hand() -> None:
    """Assert the distances in time, px and N; an onset that is missing counts as one at the end."""
    twice = Regression(np.diag([2.0, 2.0]), np.zeros(2))
    errors = slip_errors(chain(52, 47, None, off_px=0.5), chain(50, 50, 50), twice)
    assert errors == pytest.approx(
        {
            "error_ms_gross_slip": 2.0,
            "error_ms_label": 3.0,
            "error_share_detection": 1.0,
            "error_px_dots": 0.5,
            "error_n_shear": 1.0,
        }
    )
    assert set(errors) < set(ERRORS)
    assert all(np.isnan(list(slip_errors(chain(1, 1, 1), chain(None, None, None), twice).values())))


def test_how_far_the_first_detection_moves() -> None:
    """Assert that it is compared with that of the reference, the end where there is none, and that 5 ms are not far."""
    twice = Regression(np.diag([2.0, 2.0]), np.zeros(2))
    for ours, theirs, moved in ((45, 50, 5.0), (44, 50, 6.0), (None, 50, 50.0), (50, None, 50.0), (None, None, 0.0)):
        one, other = chain(50, 50, ours), chain(50, 50, theirs)
        assert detection_moved_ms(one, other) == moved
        assert slip_errors(one, other, twice)["error_share_detection"] == float(moved > 5.0)
    assert np.isnan(detection_moved_ms(chain(1, 1, 1), chain(None, None, None)))


def measured(
    setting: SolverSetting, slow: float, off: float, held: bool = True, moved_from: int | None = 50
) -> tuple[SolverSetting, Rows]:
    rows = []
    for trial in range(4):
        errors = dict.fromkeys(pipeline.SLIP_ERRORS, off + 0.01 * trial) | {"error_share_detection": float(off > 20.5)}
        one = chain(50, 50, 50)._replace(chain_us=slow + trial, record_us=0.5 * slow)
        made = one, Lifted(held, 1.0 + off, slow)
        nothing = Regression(np.zeros((2, 2)), np.zeros(2))
        rows.append(compared(made, (chain(50, 50, moved_from), Lifted(True, 1.0, 1.0)), nothing) | errors)
    return setting, rows


def test_tables() -> None:
    """Assert flags, means, and paired differences from the defaults."""
    fine, coarse = line("fixed step", "step_ms", (0.25, 1.0), "ms")
    rows = tables(
        [
            measured(SolverSetting("reference", solver={"step_ms": 0.1}), 999.0, 0.0),
            measured(DEFAULTS, 300.0, 20.0),
            measured(fine, 600.0, 10.0),
            measured(coarse, 310.0, 21.0, held=False, moved_from=None),
        ]
    )
    json.dumps(rows, allow_nan=False, default=str)
    settings = {row["setting"]: row for row in rows if "flags" in row}
    assert [row["flags"] for row in settings.values()] == ["--step-ms 0.1", "none", "--step-ms 0.25", "--step-ms 1"]
    assert settings["reference"]["error_ms_gross_slip"] is None
    assert settings["reference"]["error_share_detection"] is settings["reference"]["detection_moved_ms_median"] is None
    moved = [(row["error_share_detection"], row["detection_moved_ms_median"]) for row in settings.values()]
    assert moved[1:] == [(0.0, 0.0), (0.0, 0.0), (1.0, 50.0)]
    assert settings["defaults"]["error_px_dots"] == pytest.approx(20.015)
    assert settings["fixed step, 1 ms"]["error_share_lost"] == 1.0
    assert settings["fixed step, 1 ms"]["error_mm_moved"] is None
    apart = {(row["error"], row["setting"]): row for row in rows if "error" in row}
    assert len(apart) == 2 * len(ERRORS)
    assert apart["px_dots", "fixed step, 0.25 ms"]["more_than_defaults"] == pytest.approx(-10.0)
    assert apart["px_dots", "fixed step, 0.25 ms"]["interval_high"] < 0
    assert apart["px_dots", "fixed step, 0.25 ms"]["trials"] == 4
    assert apart["share_detection", "fixed step, 1 ms"]["more_than_defaults"] == 1.0
    summary = pipeline.summary(rows)
    assert (summary["settings"], summary["trials"], summary["reference"]) == (4, 4, "--step-ms 0.1")


def test_trials_have_seeds_of_their_own() -> None:
    """Assert that trials go through the objects in turn, and never use a seed of the calibration."""
    chosen = trials(12, 10_000)
    assert [trial.seed for trial in chosen] == list(range(10_000, 10_012))
    assert chosen[10].object == chosen[0].object != chosen[1].object
    assert not {trial.seed for trial in chosen} & {trial.seed for trial in pipeline.CALIBRATION}


@pytest.mark.slow
@pytest.mark.parametrize("setting", [DEFAULTS, pytest.param(HALF, marks=pytest.mark.slow)], ids=["defaults", "half"])
def test_a_trial_is_that_of_the_command(short_scene: Path, tmp_path: Path, setting: SolverSetting) -> None:
    """Assert that `evetac record` with the flags of a row makes the trial of the chain: the same recipe and onset."""
    chained = run_chain(ChainTrial(8, 10_000, 11), setting, tmp_path / "chain", str(short_scene))
    flags = ["--object", "8", "--seed", "10000", *setting.flags.split(), "-o", str(tmp_path / "a.recording.h5")]
    shown = CliRunner().invoke(main.app, ["record", "--scene", str(short_scene), *flags])
    assert shown.exit_code == 0, shown.output
    (recorded,) = (tmp_path / "chain").glob("*.recording.h5")
    with open_recording(tmp_path / "a.recording.h5") as ours, open_recording(recorded) as other:
        assert ours.header["id"] == other.header["id"]
        assert ours.header["parameters"]["scene"]["solver"].get("step_ms") == setting.solver.get("step_ms")
        assert len(ours) == chained.slices
        assert true_onsets(ours)["t_s_ms"] == chained.gross_slip_ms
    assert 0 < chained.record_us < chained.chain_us
    assert chained.dot_xy_px.shape == chained.true_dot_xy_px.shape == (chained.slices, 56, 2)


@pytest.mark.slow
def test_a_report(short_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert the report of two trials with the defaults alone: the same errors as the reference, and no difference."""
    monkeypatch.setattr(pipeline, "CHOICES", Extent((), ()))
    monkeypatch.setattr(pipeline, "REFERENCE", SolverSetting("reference"))
    monkeypatch.setattr(pipeline, "OBJECTS", (8,))
    monkeypatch.setattr(pipeline, "CALIBRATION", (ChainTrial(8, 9000, 11),))
    real = run_chain
    monkeypatch.setattr(pipeline, "run_chain", lambda *given: real(*given, str(short_scene)))
    monkeypatch.setattr(pipeline, "run_grasp", lambda *_: Lifted(True, 2.0, 400.0))
    chosen = EvaluateCost(part="pipeline", trials=2)
    (job,) = cost.jobs([], chosen, tmp_path)
    assert job.output.name == "pipeline.cost.report.h5"
    reports: list[tuple[int, int]] = []
    outcome = cost.run(job, chosen, progress=lambda done, total: reports.append((done, total)))
    reference, defaults = (row for row in outcome.rows if "flags" in row)
    assert reports[-1] == (5, 5)
    assert outcome.simulated
    assert outcome.summary["trials"] == 2
    assert defaults["error_ms_gross_slip"] == 0.0
    assert defaults["error_mm_moved"] == 0.0
    for name in ("error_ms_label", "error_px_dots", "error_n_shear"):
        assert defaults[name] == reference[name]
    assert 0 < defaults["error_px_dots"] < 1
    assert 0 < defaults["record_us_median"] < defaults["time_us_median"] <= defaults["time_us_p99"]


@pytest.mark.slow
def test_a_grasp(tmp_path: Path) -> None:
    """Assert that a grasp is made as the command makes it, and held."""
    lifted = pipeline.run_grasp(ChainTrial(8, 10_000, 11), DEFAULTS, tmp_path)
    assert lifted.held
    assert 0 < lifted.moved_mm < 25
    assert lifted.grasp_us > 0
