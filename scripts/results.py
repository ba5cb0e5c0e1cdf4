"""Write what the make targets left in a folder of reports into the README, as tables beside the paper's figures.

    python scripts/results.py reports README.md

Between the two marks in the README stands what this wrote last; a table whose report is missing is left out.
"""

import json
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

BEGIN, END = "<!-- results, written by scripts/results.py -->\n", "<!-- end of results -->\n"
NETS = {"regression": "linear regression", "network": "network"}
PRESETS = ("stable", "paper", "unregularised", "official")
SENSORS = {"events": "Evetac", "frames": "RGB sensor"}
Row = dict[str, Any]


def number(value: float | None, digits: int = 2) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def beside(ours: float | None, paper: float | None, digits: int = 2) -> str:
    """Our figure, and the paper's in brackets."""
    return number(ours, digits) + (f" ({paper:.{digits}f})" if paper is not None else "")


def table(title: str, heads: list[str], rows: list[list[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return f"{title}\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def having(report: Row, *columns: str) -> list[Row]:
    """The rows of a report that have these columns: its tables are told apart so."""
    return [row for row in report["rows"] if all(column in row for column in columns)]


def slip_rows(report: Row) -> list[list[str]]:
    return [
        [
            row["setting"],
            str(row["seeds"]),
            beside(row["slip_correct"], row["paper_slip_correct"]),
            number(row["slip_correct_sd_seeds"]),
            number(row["slip_early"]),
            number(row["slip_late"]),
            beside(row["f1"], row["paper_f1"]),
            number(row["f1_sd_seeds"]),
        ]
        for row in having(report, "seeds")
    ]


SLIP_HEADS = ["model", "seeds", "timing correct (paper)", "sd", "early", "late", "F1 (paper)", "sd"]


def slip_training(report: Row) -> str:
    return table("Slip detection, unseen trajectories of the training objects 1-9:", SLIP_HEADS, slip_rows(report))


def slip_unseen(report: Row) -> str:
    return table("Slip detection and prediction, objects never seen (10-17):", SLIP_HEADS, slip_rows(report))


def model_cost(report: Row) -> str:
    rows = [
        [
            row["setting"],
            str(row["parameters"]),
            number(row["time_us_median"], 1),
            number(row["step_us_median"], 1),
            number(row["slip_correct"]),
            number(row["f1"]),
            "yes" if row["pareto_timing"] or row["pareto_f1"] else "",
        ]
        for row in having(report, "pareto_f1")
    ]
    heads = [
        "model",
        "parameters",
        "inference [us]",
        "step from events on [us]",
        "timing correct",
        "F1",
        "Pareto front",
    ]
    return table("What a detector costs, one core, median:", heads, rows)


def edges(report: Row) -> str:
    rows = [
        [
            row["preset"],
            f"{row['consistent']} of {row['trajectories']}"
            + (f" ({row['paper_consistent_share']:.0%})" if row["paper_consistent_share"] is not None else ""),
            beside(row["dots_lost_mean"], row["paper_dots_lost_mean"], 1),
        ]
        for row in presets(report)
    ]
    heads = ["preset", "all dots end where they began (paper)", "dots lost where not (paper)"]
    return table("Tracking, a finger or a handle rubs over the cut gel:", heads, rows)


def presets(report: Row) -> list[Row]:
    return [row for row in report["rows"] if "file" not in row]


def tracking(folder: Path) -> str:
    rows = []
    for path in sorted(folder.glob("tracking-*.json")):
        report = json.loads(path.read_text())
        scene, gel = path.stem.split("-")[1:]
        of = {row["preset"]: row for row in presets(report)}
        cells = [
            f"{of[name]['error_px_rms']:.2f}, {of[name]['error_px_worst']:.1f}" if name in of else ""
            for name in PRESETS
        ]
        one = next(iter(of.values()))
        rows.append([f"{scene}, {gel}", str(one["trajectories"]), *cells, number(one["still_px_rms"])])
        rows[-1].append(number(of["stable"]["events_per_dot"], 1) if "stable" in of else "")
    heads = ["scene, gel", "trajectories", *PRESETS, "standing still", "events a dot and slice"]
    return table("Tracking, distance from truth in px, rms and worst dot:", heads, rows)


def labels(report: Row) -> str:
    found = report["summary"]
    row = [
        f"{found['onsets_found']} of {found['trajectories']}",
        number(found["onset_error_ms_median"], 0),
        number(found["onset_error_ms_worst"], 0),
        number(found["within_minus4_plus3_ms"]),
        str(found["earlier_than_4_ms_before_gross_slip"]),
    ]
    heads = ["onsets found", "median error [ms]", "worst [ms]", "share in -4..+3 ms", "over 4 ms before gross slip"]
    return table("Slip labels against truth, all twenty objects:", heads, [row])


def data_rate(report: Row) -> str:
    paper = tomllib.loads((Path(__file__).parents[1] / "evetac_cli" / "paper.toml").read_text())["data_rate"]
    trajectories = having(report, "share_whole")
    rows = []
    for name, words in (("whole", "whole trajectory"), ("contact", "contact"), ("slip", "0.5 s about slip")):
        shares = [row[f"share_{name}"] for row in trajectories]
        mean = sum(shares) / len(shares)
        sd = (sum((share - mean) ** 2 for share in shares) / max(len(shares) - 1, 1)) ** 0.5
        rows.append([words, f"{mean:.4f} ± {sd:.4f}", f"{paper[name][0]} ± {paper[name][1]}"])
    title = f"Bytes a second against an RGB sensor, {len(trajectories)} trajectories:"
    return table(title, ["", "ours", "paper"], rows)


def vibration(report: Row, which: str) -> str:
    judged = having(report, "window_s", "correct")
    lengths = list(dict.fromkeys(row["window_s"] for row in judged))
    rows = []
    for method, hertz in dict.fromkeys((row["method"], row["expected_hz"]) for row in judged):
        cells = []
        for length in lengths:
            same = [
                row for row in judged if (row["method"], row["expected_hz"], row["window_s"]) == (method, hertz, length)
            ]
            right, windows = sum(row["correct"] for row in same), sum(row["windows"] for row in same)
            paper = same[0].get("paper_share") if same and method == "paper" else None
            cells.append(f"{right}/{windows}" + (f" ({paper:.0%})" if paper is not None else ""))
        rows.append([method, f"{hertz:g}", *cells])
    heads = ["method", "tone [Hz]", *(f"{length:g} s" for length in lengths)]
    title = f"Vibration, {which}: windows whose tone is right within 1 Hz (2 Hz in 0.25 s; paper):"
    return table(title, heads, rows)


def force(report: Row) -> str:
    gels = list(dict.fromkeys(row["sensor_name"] for row in report["rows"]))
    rows = []
    for sensor, model in dict.fromkeys((row["sensor"], row["model"]) for row in report["rows"]):
        cells = []
        for gel in gels:
            same = [
                row
                for row in report["rows"]
                if (row["sensor"], row["model"], row["sensor_name"]) == (sensor, model, gel)
            ]
            errors = [sum(row[f"mae_n_{axis}"] for row in same) / len(same) for axis in "xy"]
            papers = [same[0][f"paper_mae_n_{axis}"] for axis in "xy"]
            told = papers[0] is not None
            cells.append(
                ", ".join(number(error) for error in errors) + (f" ({papers[0]}, {papers[1]})" if told else "")
            )
        rows.append([SENSORS[sensor], NETS[model], *cells])
    title = "Shear force, mean absolute error of Fx, Fy in N on unseen trajectories; fitted to the first gel alone:"
    return table(
        title, ["sensor", "model", *(f"`{gel}`" + (" (paper)" if gel == gels[0] else "") for gel in gels)], rows
    )


def grasps(report: Row, which: str) -> str:
    rows = [
        [
            row["setting"],
            str(row["trials"]),
            beside(row["success"], row["paper_success"]),
            number(row["force_end_n"]),
            number(row["moved_mm_median"]),
            number(row["moved_mm_mean"]),
            beside(row["reopened_share"], row["paper_reopened_share"]),
        ]
        for row in having(report, "columns")
    ]
    heads = ["controller", "trials", "lifted and kept (paper)", "grip at the end [N]", "moved, median [mm]", "mean"]
    return table(f"Grasps, {which}:", [*heads, "opened again in balance (paper)"], rows)


def objects(report: Row) -> str:
    """Objects down, controllers across, where several held them all."""
    rows = having(report, "object", "trials")
    settings = [name for name in dict.fromkeys(row["setting"] for row in rows) if name != "none"]
    settings = [name for name in settings if not name.startswith("fixed")]
    lines = []
    for number_ in sorted({row["object"] for row in rows}):
        of = {row["setting"]: row for row in rows if row["object"] == number_}
        cells = []
        for name in settings:
            row = of.get(name)
            figures = (
                () if row is None else (number(row["opening_after_balance_ticks"], 1), number(row["force_end_n"], 1))
            )
            cells.append("" if row is None else ", ".join((f"{row['success']:.0%}", *figures)))
        told = [
            row["paper_opening_after_balance_ticks"]
            for row in of.values()
            if row["paper_opening_after_balance_ticks"] is not None
        ]
        lines.append([str(number_), *cells, number(told[0], 1) if told else ""])
    return table("Grasps by object: kept, ticks closed at the end, N:", ["object", *settings, "paper, ticks"], lines)


def grasp_tables(report: Row) -> str:
    return grasps(report, "objects 10-20, lifted and balanced by feel") + "\nSimulated. " + objects(report)


TABLES: dict[str, Callable[[Row], str]] = {
    "slip-training-objects": slip_training,
    "slip-unseen-objects": slip_unseen,
    "model-cost": model_cost,
    "labels": labels,
    "tracking-edge-cut": edges,
    "data-rate": data_rate,
    "vibration": lambda report: vibration(report, "100 s a tone"),
    "vibration-randomized": lambda report: vibration(report, "10 s a tone, loudness, place and harmonics drawn anew"),
    "force": force,
    "grasps": grasp_tables,
    "grasp-robustness": lambda report: grasps(report, "sideways, with a falling weight, on another sensor"),
}


def tables(folder: Path) -> Iterator[str]:
    for name, write in TABLES.items():
        path = folder / f"{name}.json"
        if path.exists():
            report = json.loads(path.read_text())
            yield ("Simulated. " if report["simulated"] else "") + write(report)
            if name == "tracking-edge-cut":
                yield "Simulated. " + tracking(folder)


def main() -> None:
    folder, page = Path(sys.argv[1]), Path(sys.argv[2])
    written = list(tables(folder))
    if not written:
        raise SystemExit(f"{folder}: no reports; make tracking, labels, ... leave them there")
    before, rest = page.read_text().split(BEGIN)
    _, after = rest.split(END)
    page.write_text(before + BEGIN + "\n" + "\n".join(written) + "\n" + END + after)


if __name__ == "__main__":
    main()
