"""Print the table at the end of `make demo` from the reports in its folder."""

import json
import sys
from pathlib import Path

from evetac_cli.console import print_table
from evetac_cli.store.files import StageFile

KINDS = ("recording", "labels", "tracks", "features", "model", "report")


def figures(folder: Path, subject: str) -> tuple[list[dict], dict]:
    with StageFile(folder / f"{subject}.report.h5", "report") as report:
        return json.loads(report.read("rows")), json.loads(report.read("summary"))


def main() -> None:
    folder, seconds = Path(sys.argv[1]), int(sys.argv[2])
    _, labels = figures(folder, "labels")
    _, tracking = figures(folder, "tracking")
    _, slip = figures(folder, "slip")
    grasps, _ = figures(folder, "grasp")
    rows = [
        {"what": "onset of slip: labels against truth, median", "figure": labels["onset_error_ms_median"], "unit": "ms"},
        {"what": "... worst", "figure": labels["onset_error_ms_worst"], "unit": "ms"},
        {"what": "... found", "figure": f"{labels['onsets_found']} of {labels['trajectories']}", "unit": ""},
        {"what": "dot tracking error, rms (a tracker that stands still)",
         "figure": f"{tracking['error_px_rms']:.3g} ({tracking['still_px_rms']:.3g})", "unit": "px"},
        {"what": "slip timing correct, unseen trajectories", "figure": slip["slip_correct"], "unit": "share"},
        {"what": "... too early, too late", "figure": f"{slip['slip_early']:.3g}, {slip['slip_late']:.3g}", "unit": "share"},
        {"what": "slip F1, unseen trajectories", "figure": slip["f1"], "unit": ""},
    ]  # fmt: skip
    for grasp in grasps:
        how = "without the detector" if grasp["controller"] == "none" else "with the detector"
        if not grasp["lifted"]:
            result = "not lifted"
        elif grasp["controller"] == "none":
            result = "lifted"
        else:
            result = f"lifted, {'held' if grasp['balanced'] else 'lost in balance'}, moved {grasp['moved_mm']:.2g} mm"
        rows.append({"what": f"grasp of object {grasp['object']} {how}", "figure": result, "unit": ""})
    print_table("evetac demo", rows, {}, simulated=True)
    files = {kind: len(list(folder.rglob(f"*.{kind}.h5"))) for kind in KINDS}
    print(f"{folder}/ holds " + ", ".join(f"{count} {kind}" for kind, count in files.items()) + f"; {seconds} s")


if __name__ == "__main__":
    main()
