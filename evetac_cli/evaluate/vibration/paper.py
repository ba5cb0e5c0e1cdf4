"""The paper's figures on vibration, and the rows that they belong to."""

from collections.abc import Iterator
from dataclasses import replace

from evetac_cli.evaluate.common.marks import Conditions, Key, Paper, PaperColumn, PaperFigure, scenes
from evetac_cli.evaluate.common.source import Row, Source

WINDOWS_S = (10.0, 2.0, 1.0)  # lengths of windows
WHOLE_S = 100.0  # recorded per tone


def _figures() -> Iterator[tuple[Key, PaperFigure]]:
    where = "Sensing Vibrations, table of windows"
    for tone, shares in (
        ("100", (1.00, 0.98, 0.96)), ("200", (1.00, 0.92, 0.69)), ("300", (1.00, 1.00, 0.99)),
        ("400", (1.00, 1.00, 0.98)), ("498", (1.00, 1.00, 1.00)), ("all", (1.00, 0.98, 0.924)),
    ):  # fmt: skip
        for length_s, share in zip(WINDOWS_S, shares, strict=True):
            windows = WHOLE_S / length_s * (5 if tone == "all" else 1)
            conditions = Conditions("paper", "vibration", (windows,))
            figure = PaperFigure(share, "share", where, conditions, fitted_in="vibration", trials=round(windows))
            yield ("vibration", tone, length_s), figure
            if tone == "all":
                among = replace(
                    figure, value=1.0, where="Sensing Vibrations", fitted_in="", trials=0, limits=(1.0, 1.0)
                )
                yield ("among three", tone, length_s), among
                if length_s == WINDOWS_S[1]:  # 5 of 250
                    yield ("half tone", tone, length_s), replace(figure, value=0.02, where="Sensing Vibrations")


def _of_tone(quantity: str) -> PaperColumn:
    """Return a column of windows; a row over all tones has none as its tone."""

    def key(row: Row) -> Key:
        tone_hz = row.get("expected_hz")
        return (quantity, "all" if tone_hz is None else f"{tone_hz:g}", row["window_s"])

    def ours(row: Row, source: Source) -> Conditions:
        return Conditions(row["method"], scenes(source), (row["windows"],))

    return PaperColumn(key, ours, ("method", "window_s", "windows"), ("expected_hz",))


PAPER = Paper(
    dict(_figures()),
    {
        "paper_share": _of_tone("vibration"),
        "paper_among_three_share": _of_tone("among three"),
        "paper_half_tone_share": _of_tone("half tone"),
    },
)
