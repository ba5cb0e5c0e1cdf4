"""Print the table at the end of `make demo` from the reports in the present folder; the argument is when it started."""

import json
import sys
import time
from pathlib import Path

from evetac_cli.console import print_table
from evetac_cli.store.files import StageFile

KINDS = ("recording", "labels", "tracks", "features", "model", "report")


def figures(folder: Path, subject: str) -> tuple[list[dict], dict]:
    with StageFile(folder / f"{subject}.report.h5", "report") as report:
        return json.loads(report.read("rows")), json.loads(report.read("summary"))


def main() -> None:
    folder, started = Path(), float(sys.argv[1])
    _, labels = figures(folder, "labels")
    _, tracking = figures(folder, "tracking")
    _, slip = figures(folder, "slip")
    grasps, _ = figures(folder, "grasp")
    still = f"{tracking['error_px_rms']:.3g} ({tracking['still_px_rms']:.3g})"
    table = {
        "onset of slip: labels against truth, median": f"{labels['onset_error_ms_median']:.3g} ms",
        "... worst": f"{labels['onset_error_ms_worst']:.3g} ms",
        "... found": f"{labels['onsets_found']} of {labels['trajectories']}",
        "dots tracked, error, rms (standing still)": f"{still} px",
        "slip timing correct, unseen trajectories": f"{slip['slip_correct']:.3g}",
        "... too early, too late": f"{slip['slip_early']:.3g}, {slip['slip_late']:.3g}",
        "slip F1, unseen trajectories": f"{slip['f1']:.3g}",
    }
    for grasp in (row for row in grasps if "file" in row):
        alone = grasp["setting"] == "none"
        how = "without the detector" if alone else "with the detector"
        if not grasp["lifted"]:
            result = "not lifted"
        elif alone:
            result = "lifted"
        else:
            result = f"lifted, {'held' if grasp['balanced'] else 'lost in balance'}, moved {grasp['moved_mm']:.2g} mm"
        table[f"grasp of object {grasp['object']} {how}"] = result
    rows = [{"what": what, "figure": figure} for what, figure in table.items()]
    print_table("evetac demo", rows, {}, simulated=True)
    made = [path for path in folder.rglob("*.h5") if path.stat().st_mtime >= started]
    files = {kind: len(list(folder.rglob(f"*.{kind}.h5"))) for kind in KINDS}
    print(f"{folder.resolve().name}/ holds " + ", ".join(f"{count} {kind}" for kind, count in files.items()), end="; ")
    print(f"{len(made)} made in {time.time() - started:.0f} s" if made else "all up to date, nothing to do")


if __name__ == "__main__":
    main()
