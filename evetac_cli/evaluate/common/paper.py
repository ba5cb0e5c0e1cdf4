"""The paper's figures, each stored once, and how evetac's figures compare with them.

Tables, reports and plots take the paper's figures only from here. A row of a report has the paper's figure in a column
of its own, `paper_...`. `beside` returns this figure for a row, with a mark that depends on the row and on the headers
behind it. Of the marks that apply, the first of these is used:

- fitted: evetac's scene was adjusted until it gave this figure, so the agreement proves nothing;
- other method: another tracker, training, detector or grip controller than the paper's, or other inputs;
- other scene: objects, motions or surroundings that are not modelled on the paper's, or are unknown;
- other size: another number of trials, trajectories, objects, windows or trainings, or another duration;
- same method: all of these match the paper, although evetac's data may be simulated.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

from evetac_cli.evaluate.common.source import Row, Source
from evetac_cli.kernels import estimates

SAME, METHOD, SIZE, SCENE, FITTED = "same method", "other method", "other size", "other scene", "fitted"
MARKS = (FITTED, METHOD, SCENE, SIZE, SAME)  # in order of precedence

Key = tuple[str | float, ...]  # the quantity, then its subject (object, model, ...)

LAWS = ("paper", "paper-reset")  # controllers: two readings of the paper's text
ROBUSTNESS = ("sideways", "drop-20g", "drop-100g")  # scenes of the paper's tests of robustness
PAPERS_SENSOR = "evetac"  # evetac's model of the sensor on which the paper's detectors were trained
OTHER_SENSOR = "another sensor"


@dataclass(frozen=True)
class Conditions:
    """The conditions under which a figure was obtained, the paper's or evetac's, in evetac's names."""

    method: str  # network with its training, tracker preset, grip controller
    scene: str
    size: tuple[float, ...]  # numbers of trials, objects, trainings and the like, and durations in s
    inputs: str = ""  # inputs of the method, where they may differ


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper."""

    value: float
    unit: str
    where: str  # section or table of the paper
    conditions: Conditions
    fitted_in: str = ""  # the scene of evetac that was adjusted until it gave this figure
    limits: tuple[float, float] | None = None  # the mean less and plus the paper's sd, or what a sentence allows
    trials: int = 0  # of which the figure is a share

    @property
    def spread(self) -> tuple[float, float] | None:
        """The ends of the paper's own spread: its limits, or Wilson's 95 % interval of a share; None if it has none."""
        if self.limits is not None or not self.trials:
            return self.limits
        return estimates.share(round(self.value * self.trials), self.trials)[1:]


# The figures ----------------------------------------------------------------------------------------------------------

TIMING = "Evaluation on Training Objects"
AHEAD = "Evaluating on unseen Testing Objects & Slip Prediction"
GRASPS = "Evaluating the Closed-Loop Pickup and Grasp Controller"
SLIP_INPUTS = "dots by paper, labels by farneback"
DETECTOR = "dots by paper, fast-slow 10 ms ahead by paper"
SEEDS, TRAINED_ON, LIFT_S, BALANCE_S = 5, 360, 10.0, 20.0
HORIZONS_MS = (0, 10, 20)  # for which the paper predicts slip
COLUMNS = 540  # of the frame, without the window, that the paper counts for both sensors
WINDOWS_S = (10.0, 2.0, 1.0)  # lengths of vibration windows
WHOLE_S = 100.0  # recorded per tone


def _slip(value: float, unit: str, where: str, model: str, trajectories: int) -> PaperFigure:
    inputs = "labels by farneback" if "img" in model else SLIP_INPUTS
    conditions = Conditions(f"{model} by paper", "slip", (trajectories, SEEDS, TRAINED_ON), inputs)
    return PaperFigure(value, unit, where, conditions, trials=trajectories if unit == "share" else 0)


def _slip_figures() -> Iterator[tuple[Key, PaperFigure]]:
    published = {  # timing correct, F1
        "no-hist": (0.87, 0.59), "no-hist-img": (0.93, 0.64), "hist10": (0.895, 0.73), "hist10-img": (0.95, 0.79),
        "hist20": (0.925, 0.815), "down5": (0.882, None), "fast-slow": (0.926, 0.816),
    }  # fmt: skip
    for model, (correct, f1) in published.items():
        yield ("correct", "known", model, 0), _slip(correct, "share", TIMING, model, 90)
        if f1 is not None:
            yield ("f1", "known", model, 0), _slip(f1, "F1", TIMING, model, 90)
    unseen = {"hist20": (0.86, 0.84, 0.81), "fast-slow": (0.84, 0.88, 0.84), "hist10-img": (0.89, 0.82, 0.80)}
    for model, shares in unseen.items():
        for horizon_ms, correct in zip(HORIZONS_MS, shares, strict=True):
            yield ("correct", "unseen", model, horizon_ms), _slip(correct, "share", AHEAD, model, 80)
    timing = _slip(0.57, "share", "Evaluating Slip Timing", "fast-slow", 80)
    yield ("10_to_0_ms_ahead", "unseen", "fast-slow", 10), timing
    for number, elsewhere in (("12", 0.26), ("15", 0.32)):  # too early or too late
        conditions = Conditions("fast-slow by paper", "slip", (10, SEEDS, TRAINED_ON), SLIP_INPUTS)
        correct_share = PaperFigure(round(1 - elsewhere, 2), "share", "Evaluating Slip Timing", conditions, trials=10)
        yield ("correct", "object", "fast-slow", 10, number), correct_share
    for model, duration_ms in (("fast-slow", 0.1), ("hist20", 0.1), ("hist10-img", 2.6)):
        figure = _slip(duration_ms, "ms", f"{AHEAD}, on an RTX 3090", model, 80)
        is_bound = "img" not in model  # "within 0.1 ms"; of the image model it gives the mean
        yield ("inference", model), replace(figure, limits=(0.0, duration_ms) if is_bound else None)


def _vibration_figures() -> Iterator[tuple[Key, PaperFigure]]:
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


def _force_figures() -> Iterator[tuple[Key, PaperFigure]]:
    where = "Dot-based Shear Force Reconstruction, table"
    for model, sensor, errors in (  # mean absolute error and its sd, of Fx and Fy
        ("regression", "events", ((0.53, 0.41), (0.41, 0.29))),
        ("regression", "frames", ((0.53, 0.49), (0.44, 0.29))),
        ("network", "events", ((0.33, 0.25), (0.22, 0.18))),
        ("network", "frames", ((0.35, 0.30), (0.37, 0.26))),
    ):
        conditions = Conditions(model, "shear", (1, 4), "dots by paper" if sensor == "events" else "frames")
        for axis, of_axis in zip("xy", errors, strict=True):
            for quantity, value in zip(("mae", "sd"), of_axis, strict=True):
                yield (quantity, model, sensor, axis), PaperFigure(value, "N", where, conditions)
    where = "Dot-based Shear Force Reconstruction"
    for sensor, shares in (("events", (0.37, 0.46)), ("frames", (0.37, 0.16))):
        conditions = Conditions("network", "shear", (1, 4), "dots by paper" if sensor == "events" else "frames")
        for axis, less in zip("xy", shares, strict=True):
            yield ("less by the network", sensor, axis), PaperFigure(less, "share", where, conditions)
    for axis, ratio in (("x", 1.0), ("y", 1.07)):  # of its table's figures; in words "similar quality"
        conditions = Conditions("regression", "shear", (1, 4), "dots by paper")
        yield ("RGB over Evetac", axis), PaperFigure(ratio, "ratio", where, conditions)


def _other_figures() -> Iterator[tuple[Key, PaperFigure]]:
    where = "Data Rate Experiments, table"
    for interval, mean, sd in (("whole", 0.017, 0.004), ("contact", 0.028, 0.008), ("slip", 0.119, 0.006)):
        conditions = Conditions("bytes a second", "data-rate", (5,), f"{COLUMNS} columns")
        fitted_in = "data-rate" if interval == "slip" else ""  # by the object's mass, which the paper does not state
        for key, value in (("data rate", mean), ("data rate, sd", sd)):
            limits = (round(mean - sd, 4), round(mean + sd, 4)) if value == mean else None
            figure = PaperFigure(value, "share of the RGB sensor's", where, conditions, fitted_in, limits)
            yield (key, interval), figure
    where = "Effectiveness of Regularization in Dot Tracking, table"
    for preset, share, lost in (("unregularised", 0.2, 9.5), ("paper", 0.8, 1.5)):
        conditions = Conditions(preset, "edge", (10,))
        yield (
            ("consistent", preset),
            PaperFigure(share, "share", where, conditions, "edge" if preset == "paper" else "", trials=10),
        )
        yield ("dots lost", preset), PaperFigure(lost, "dots", where, conditions)


def _grasp_figures() -> Iterator[tuple[Key, PaperFigure]]:
    every = Conditions("paper", "lift", (12, 120, LIFT_S, BALANCE_S), DETECTOR)
    yield ("kept",), PaperFigure(0.93, "share", GRASPS, every, trials=120)
    yield ("reopened",), PaperFigure(0.43, "share of the closing", GRASPS, every)
    alone = Conditions("none", "lift", (11, 55))
    yield ("lifted by contact alone",), PaperFigure(0.0, "share", GRASPS, alone, fitted_in="lift", trials=55)
    yield ("moved less in most trials",), PaperFigure(10.0, "mm", GRASPS, every)
    # "most": more than half. "A couple of millimeters": 1 to 10 mm is evetac's reading, as in data/likeness.toml.
    yield ("moved below 10 mm",), PaperFigure(0.5, "share (most)", GRASPS, every, limits=(0.5, 1.0))
    yield ("moved in the lift",), PaperFigure(2.0, "mm (a couple)", GRASPS, every, limits=(1.0, 10.0))
    of_object = replace(every, size=(10, LIFT_S, BALANCE_S))
    for number, gain, kept in (
        ("10", "1", 1.0), ("11", "1", 1.0), ("12", "1", 0.9), ("13", "1", 1.0), ("14", "1", 0.6), ("15", "1", 0.9),
        ("16", "1", 1.0), ("17", "1", 1.0), ("18", "1", 1.0), ("19", "2", 1.0), ("20", "2", 1.0),
    ):  # fmt: skip
        yield ("kept", number, gain), PaperFigure(kept, "share", GRASPS, of_object, trials=10)
    for number, ticks in (("17", -7.6), ("18", -13.4)):
        yield ("opening", number, "1"), PaperFigure(ticks, "ticks", GRASPS, of_object, fitted_in="lift")
    where = "Evaluating Controller Robustness"
    for scene, kept, size in (
        *zip(ROBUSTNESS, (1.0, 0.9, 1.0), 3 * ((1, 10),), strict=True),
        (OTHER_SENSOR, 0.95, (8, 40)),  # objects 16, 17, 19 and 20 with both gels
    ):
        conditions = replace(every, scene=scene, size=(*size, LIFT_S, BALANCE_S))
        yield ("kept", scene), PaperFigure(kept, "share", where, conditions, trials=size[1])


FIGURES: dict[Key, PaperFigure] = dict(
    [*_slip_figures(), *_vibration_figures(), *_force_figures(), *_other_figures(), *_grasp_figures()]
)


def value(*key: str | float) -> float | None:
    """Return a figure of the paper by its key; None if the paper has none."""
    figure = FIGURES.get(key)
    return None if figure is None else figure.value


# Which figure belongs to which row ------------------------------------------------------------------------------------


def _scenes(source: Source) -> str:
    return " + ".join(source.scenes)


def _by(what: str, names: Iterable[str]) -> str:
    return f"{what} by {' + '.join(names)}"


def _of_slip(quantity: str) -> Callable[[Row], Key]:
    def key(row: Row) -> Key:
        # The paper has F1 and down5 only for the training objects. -6x6: smaller images for a CPU.
        model, horizon_ms = row["model"].removesuffix("-6x6"), row["horizon_ms"]
        unseen = (quantity, "unseen", model, horizon_ms)
        return unseen if row.get("paper_f1") is None and unseen in FIGURES else (quantity, "known", model, 0)

    return key


def _our_slip(row: Row, source: Source) -> Conditions:
    several = f", {source.networks} networks" if source.networks > 1 else ""
    several += f", {row['folds']} folds" if row.get("folds") else ""
    dots = [] if "img" in row["model"] else [_by("dots", source.trackers)]
    size = (row["trajectories"], row["seeds"], source.training_recordings)
    inputs = ", ".join([*dots, _by("labels", source.labels)])
    truth = ", true slip share" if row.get("true_slip_share") else ""
    return Conditions(f"{row['model']} by {row['preset']}{truth}{several}", _scenes(source), size, inputs)


def _our_force(row: Row, source: Source) -> Conditions:
    inputs = "frames" if row["sensor"] == "frames" else _dots(row, source)
    return Conditions(row["model"], _scenes(source), (row["trajectories"], source.training_recordings), inputs)


def _dots(row: Row, source: Source) -> str:
    return f"dots by {row['tracker']}" if row.get("tracker") else _by("dots", source.trackers)


class PaperSetting(NamedTuple):
    """The parts of a grasp setting as named by `evaluate grasp`."""

    law: str
    scene: str
    gain: str
    method: str  # the controller with everything non-default except gain, scene, sensor and detector

    @classmethod
    def of(cls, row: Row) -> "PaperSetting":
        """Read a row's setting; without these columns, its scene is `lift` on the paper's sensor."""
        law, *words = row["setting"].split(", ")
        gain = next((word.removeprefix("gain ") for word in words if word.startswith("gain ")), "1")
        unusual = [word for word in words if word.endswith((" late", " Hz")) or word.startswith(("margin ", "two "))]
        scene = row.get("scene", "lift")
        if row.get("sensor", PAPERS_SENSOR) != PAPERS_SENSOR or row.get("gel") == "closed":
            scene = OTHER_SENSOR if scene == "lift" else f"{scene}, {OTHER_SENSOR}"
        return cls(law, scene, gain, ", ".join(["paper" if law in LAWS else law, *unusual]))


def _kept(row: Row) -> Key:
    setting = PaperSetting.of(row)
    if row["setting"] == "none" and "object" not in row:
        return ("lifted by contact alone",)
    if setting.law not in LAWS:
        return ()
    if "object" in row:
        usual = setting.scene == "lift" and setting.method == "paper"
        return ("kept", str(row["object"]), setting.gain) if usual else ()
    if setting.scene != "lift":
        return ("kept", setting.scene)
    return ("kept",) if setting.method == "paper" and row["columns"] > 1 else ()


def _opening(row: Row) -> Key:
    kept = _kept(row)
    return ("opening", *kept[1:]) if len(kept) == 3 else ()


def _our_grasp(row: Row, source: Source) -> Conditions:
    setting = PaperSetting.of(row)
    number = (row["trials"],) if "object" in row else (row["columns"], row["trials"])
    if setting.law == "none" or setting.law.startswith("fixed"):
        return Conditions(setting.method, setting.scene, number)
    inputs = f"{_dots(row, source)}, {row.get('slip_detector') or source.detector}"
    return Conditions(setting.method, setting.scene, (*number, *source.grasp_s), inputs)


class PaperColumn(NamedTuple):
    """A column `paper_...`: the key of a row's figure, the row's own conditions, and the columns that both read."""

    key: Callable[[Row], Key]
    ours: Callable[[Row, Source], Conditions]
    needs: tuple[str, ...]
    may_need: tuple[str, ...] = ()  # read if the row has them


def _of_model(key: Callable[[Row], Key], *more: str) -> PaperColumn:
    needs = ("model", "horizon_ms", "preset", "seeds", "trajectories", *more)
    return PaperColumn(key, _our_slip, needs, ("folds", "paper_f1", "true_slip_share"))


def _of_preset(quantity: str) -> PaperColumn:
    def ours(row: Row, source: Source) -> Conditions:
        return Conditions(row["preset"], _scenes(source), (row["trajectories"],))

    return PaperColumn(lambda row: (quantity, row["preset"]), ours, ("preset", "trajectories"))


def _of_interval(quantity: str) -> PaperColumn:
    def ours(row: Row, source: Source) -> Conditions:
        return Conditions("bytes a second", _scenes(source), (row["trajectories"],), f"{row['columns']} columns")

    return PaperColumn(lambda row: (quantity, row["interval"]), ours, ("interval", "trajectories", "columns"))


def _of_axis(quantity: str, axis: str) -> PaperColumn:
    def key(row: Row) -> Key:
        return quantity, row["model"], row["sensor"], axis

    return PaperColumn(key, _our_force, ("sensor", "model", "trajectories"), ("tracker",))


def _of_tone(quantity: str) -> PaperColumn:
    """Return a column of windows; a row over all tones has none as its tone."""

    def key(row: Row) -> Key:
        tone_hz = row.get("expected_hz")
        return (quantity, "all" if tone_hz is None else f"{tone_hz:g}", row["window_s"])

    def ours(row: Row, source: Source) -> Conditions:
        return Conditions(row["method"], _scenes(source), (row["windows"],))

    return PaperColumn(key, ours, ("method", "window_s", "windows"), ("expected_hz",))


def _of_setting(key: Callable[[Row], Key]) -> PaperColumn:
    may_need = ("object", "columns", "scene", "sensor", "gel", "slip_detector", "tracker")
    return PaperColumn(key, _our_grasp, ("setting", "trials"), may_need)


def _of_all_grasps(quantity: str) -> PaperColumn:
    return _of_setting(lambda row: (quantity,) if _kept(row) == ("kept",) else ())


SHOWN: dict[str, PaperColumn] = {
    "paper_slip_correct": _of_model(_of_slip("correct")),
    "paper_f1": _of_model(_of_slip("f1")),
    "paper_slip_correct_of_object": PaperColumn(  # by several models; the paper has it where its detector often fails
        lambda row: ("correct", "object", row["model"], row["horizon_ms"], str(row["object"])),
        lambda row, source: _our_slip({**row, "seeds": row["models"]}, source),
        ("model", "horizon_ms", "preset", "models", "object", "trajectories"),
        ("folds", "true_slip_share"),
    ),
    "paper_10_to_0_ms_ahead": _of_model(_of_slip("10_to_0_ms_ahead")),
    "paper_timing_share": _of_model(
        lambda row: (row["bin"], "unseen" if row["object"] == "all" else "object", row["model"], row["horizon_ms"]),
        *("bin", "object"),
    ),
    "paper_inference_ms": _of_model(lambda row: ("inference", row["model"])),
    "paper_consistent_share": _of_preset("consistent"),
    "paper_dots_lost_mean": _of_preset("dots lost"),
    "paper_success": _of_setting(_kept),
    "paper_reopened_share": _of_all_grasps("reopened"),
    "paper_opening_after_balance_ticks": _of_setting(_opening),
    **{f"paper_{quantity}_n_{axis}": _of_axis(quantity, axis) for quantity in ("mae", "sd") for axis in "xy"},
    "paper_moved_below_10_mm_share": _of_all_grasps("moved below 10 mm"),
    "paper_moved_lift_mm_median": _of_all_grasps("moved in the lift"),
    "paper_share": _of_tone("vibration"),
    "paper_among_three_share": _of_tone("among three"),
    "paper_half_tone_share": _of_tone("half tone"),
    "paper_share_mean": _of_interval("data rate"),
    "paper_share_sd": _of_interval("data rate, sd"),
}


class Beside(NamedTuple):
    """The paper's value and its mark, for display next to a figure of evetac."""

    value: float
    mark: str


def mark(figure: PaperFigure, ours: Conditions, *, simulated: bool) -> str:
    """Return how evetac's figure compares with one of the paper: the first of MARKS that applies."""
    paper = figure.conditions
    if simulated and figure.fitted_in and (ours.method, ours.scene) == (paper.method, figure.fitted_in):
        return FITTED
    if (ours.method, ours.inputs) != (paper.method, paper.inputs):
        return METHOD
    if ours.scene != paper.scene:
        return SCENE
    return SAME if ours.size == paper.size else SIZE


def value_of(column: str, row: Row) -> float | None:
    """Return the paper's figure of a column `paper_...` for a row; None if the paper has none."""
    return value(*SHOWN[column].key(row))


def beside(column: str, row: Row, source: Source) -> Beside | None:
    """Return the paper's figure and its mark for a row of a report; None without one, or without the needed columns."""
    paper_column = SHOWN[column]
    if row.get(column) is None or any(row.get(name) is None for name in paper_column.needs):
        return None
    figure = FIGURES.get(paper_column.key(row))
    if figure is None:
        return None
    return Beside(figure.value, mark(figure, paper_column.ours(row, source), simulated=source.simulated))
