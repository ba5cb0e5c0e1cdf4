"""Train slip detectors on motions, one thing changed at a time, to see what each is worth.

    python scripts/motion_recordings.py learn --out DATA/learn      (and choose, into DATA/choose)
    python scripts/train_detectors.py features DATA
    python scripts/train_detectors.py train DATA --out MODELS --seeds 5

Checkpoint, calibration and threshold are chosen on the objects of `choose`. What is there is not made again. Then
scripts/judge_slip.py judges the models. All of it simulated.
"""

import argparse
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

SLIPS = ("slip", "slip-varied")  # unloaded at the speed of the paper's ramp
FROM_EVENTS = "from-events"  # folder of labels and features that know no truth
TRACKER = "stable"


@dataclass(frozen=True)
class Variant:
    """What a detector is trained on, and how. labels: truth, or event-flow, which knows the ramps alone."""

    model: str = "disp-xy"
    speeds: bool = True
    negatives: bool = True
    labels: str = "truth"
    true_share: bool = True
    horizon_ms: int = 10
    steps: int = 10_000
    preset: str = "adamw"
    networks: int = 1

    def words(self) -> list[str]:
        """The options of `evetac train`."""
        words = ["--model", self.model, "--preset", self.preset, "--horizon-ms", str(self.horizon_ms)]
        words += ["--max-steps", str(self.steps), "--networks", str(self.networks)]
        return words + ["--learn-true-slip-share"] * self.true_share


VARIANTS = {
    "slips": Variant(speeds=False, negatives=False, true_share=False),
    "slips-events": Variant(speeds=False, negatives=False, true_share=False, labels="event-flow"),
    "speeds": Variant(negatives=False, true_share=False),
    "negatives": Variant(true_share=False),
    "share": Variant(),
    "grip": Variant(model="disp-xy-grip"),
    "fast-slow": Variant(model="fast-slow"),
    "paper": Variant(model="fast-slow", speeds=False, negatives=False, true_share=False, preset="paper", steps=150_000),
}


def run(*words: object) -> None:
    """Run evetac; an error of it ends this script."""
    command = [sys.executable, "-m", "evetac_cli", *map(str, words)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"evetac {' '.join(map(str, words))}: {done.stderr}")


def make_features(data: Path) -> None:
    """Label, track and featurize the recordings of both roles; slips also with labels from events."""
    for role in ("choose", "learn"):
        for folder in sorted(path for path in (data / role).iterdir() if path.is_dir() and path.name != FROM_EVENTS):
            run("label", folder, "--method", "truth", "--from-start")
            run("track", folder, "--preset", TRACKER)
            run("featurize", folder, "--true-slip-share")
            if role == "learn" and folder.name in SLIPS:
                own = folder.parent / FROM_EVENTS / folder.name
                run("label", folder, "--out", own)
                run("featurize", folder, "--tracks", folder, "--labels", own, "--out", own)
            sys.stdout.write(f"{folder}\n")


def folders_of(variant: Variant, learn: Path) -> list[Path]:
    """The folders of features that a variant is trained on."""
    names = [path.name for path in sorted(learn.iterdir()) if path.is_dir() and path.name != FROM_EVENTS]
    chosen = [
        name
        for name in names
        if name in SLIPS or (name == "slip-speeds" and variant.speeds) or (name != "slip-speeds" and variant.negatives)
    ]
    own = learn / FROM_EVENTS if variant.labels == "event-flow" else learn
    return [(own if name in SLIPS else learn) / name for name in chosen]


def main() -> None:
    """Make features, or train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("features", "train"))
    parser.add_argument("data", type=Path, help="folder with learn and choose below")
    parser.add_argument("--out", type=Path, help="folder of the models, one folder a variant below")
    parser.add_argument("--variant", nargs="*", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--seeds", type=int, default=5, help="models of each variant")
    chosen = parser.parse_args()
    if chosen.what == "features":
        make_features(chosen.data)
        return
    for name in chosen.variant:
        variant = VARIANTS[name]
        validate = ["--validate", str(chosen.data / "choose" / "*" / "*.features.h5")]
        folders = folders_of(variant, chosen.data / "learn")
        run("train", *folders, *validate, *variant.words(), "--seeds", chosen.seeds, "--out", chosen.out / name)
        sys.stdout.write(f"{name}\n")


if __name__ == "__main__":
    main()
