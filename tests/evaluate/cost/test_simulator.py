"""What the part `sim` of evaluate cost says about all its rows, by hand."""

from evetac_cli.evaluate.cost import gel as gel_cost
from evetac_cli.evaluate.cost import simulator as simulator_cost


def test_what_the_implicit_step_saves():
    """Assert that it is the best explicit run time over the least implicit one of no greater error."""

    def row(setting, error, time_us):
        outcome = "finished" if error else "blew up after 1 ms"
        errors = {"error_um_object_rms": error, "error_um_gel_rms": error}
        return {"part": gel_cost.PART, "setting": setting, **errors, "time_us_median": time_us, "outcome": outcome}

    rows = [
        row("reference: theta 0.51, dt 5 us", 0.01, 1e4),
        row("theta 1, dt 1 ms", 20.0, 10.0),
        row("theta 0.51, dt 1 ms", 9.0, 40.0),
        row("theta 0.51, dt 0.5 ms", 3.0, 80.0),
        row("explicit, dt 10 us", None, 100.0),
        row("explicit, dt 5 us", 100.0, 1000.0),
        row("explicit, dt 1 us", 10.0, 8000.0),
        {"part": "mechanics, slow unloading", "setting": "fixed step, 1 ms", "time_us_median": 1.0},
    ]
    summary = simulator_cost.summary(rows)
    assert summary["implicit_saves_times"] == 200.0
    assert summary["explicit_blows_up_at"] == "10 us"
    assert simulator_cost.summary([rows[0], rows[4]])["implicit_saves_times"] is None
    assert simulator_cost.summary([rows[0], rows[1], rows[6]])["implicit_saves_times"] is None
