"""The view of characters: dots are seen, scattered noise is not."""

import numpy as np

from evetac_cli.trials.live_view import process as terminal
from evetac_cli.trials.live_view.samples import Follower
from evetac_cli.trials.live_view.shared_view import SharedView

FRAME_PX = (640, 480)


def picture(*places: tuple[int, int, int]) -> list[str]:
    """Lines for so many events at each pixel."""
    x, y = (np.concatenate([np.full(place[2], place[k]) for place in places] or [np.empty(0, int)]) for k in (0, 1))
    return terminal.picture(x, y, FRAME_PX).splitlines()


def test_picture_is_where_the_events_are() -> None:
    """Assert that events darken their own place only, more events more, and no event nothing; edges included."""
    lines = picture((0, 0, 6), (639, 479, 500))
    assert len(lines) == terminal.ROWS
    assert {len(line) for line in lines} == {terminal.COLUMNS}
    assert lines[0][0] != " "
    assert terminal.SHADES.index(lines[-1][-1]) > terminal.SHADES.index(lines[0][0])
    assert "".join(lines).count(" ") == terminal.ROWS * terminal.COLUMNS - 2
    assert set("".join(picture())) == {" "}


def test_a_noise_event_does_not_look_like_a_dot() -> None:
    """Assert that single events show nothing, nor does even noise of any rate, and that the rim of a dot still does."""
    assert set("".join(picture((100, 100, 1), (300, 200, 2), (301, 400, 1)))) == {" "}
    rng = np.random.default_rng(0)
    for rate in (1_000, 5_000, 50_000):  # of 50 ms
        x, y = rng.integers(0, 640, rate), rng.integers(0, 480, rate)
        noise = terminal.picture(x, y, FRAME_PX)
        assert noise.count(" ") > 0.95 * terminal.ROWS * terminal.COLUMNS
        turn = rng.uniform(0, 2 * np.pi, rate // 20 + 200)
        dot_x, dot_y = (320 + 11 * np.cos(turn)).astype(int), (240 + 11 * np.sin(turn)).astype(int)
        seen = terminal.picture(np.concatenate([x, dot_x]), np.concatenate([y, dot_y]), FRAME_PX).splitlines()
        around = "".join(line[38:42] for line in seen[14:17])
        assert around.strip(), rate


def test_the_figures_fit_a_line() -> None:
    """Assert a line of 80 characters with what is known, and the last message below the picture."""
    sample = {
        "t": 12.34, "events_per_s": 1234567.0, "late_most_ms": 1.25, "probability": 0.5, "position_ticks": 400,
        "current_ma": -12.0, "goal_ma": None,
    }  # fmt: skip
    lines = terminal.screen(Follower(SharedView()), sample, "unknown, at least 12", ["first", "last"]).splitlines()
    assert len(lines[0]) <= terminal.COLUMNS
    assert lines[0].startswith("12.3 s  1,234,567 events/s  lost unknown, at least 12  late 1.2 ms  slip 0.50")
    assert lines[-1] == "last"
    assert terminal.headline({"t": 0.0, "probability": None}, "0") == "0.0 s  lost 0"
