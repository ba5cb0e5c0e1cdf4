"""Train slip detectors on motions, changing one thing at a time, to measure the benefit of each.

    python scripts/studies/slip/recordings.py learn --out DATA/learn      (and choose, into DATA/choose)
    python scripts/studies/slip/train.py features DATA
    python scripts/studies/slip/train.py train DATA --out MODELS --seeds 5

`shipped`, the detector that comes with evetac (`make ship`), and the variants named by their horizon are trained only
if --variant names them. So is `outside`, a network from another package; it needs `pip install --no-deps
./tests/plugin`, for training and for evaluation. Checkpoint, calibration and threshold are chosen on the objects of
`choose`. Existing files are not made again. Then judge.py evaluates the models. All results are simulated.
"""

import argparse
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

SLIPS = ("slip", "slip-varied")  # unloaded at the speed of the paper's ramp
FROM_EVENTS, STICKING = "from-events", "sticking"  # folders of labels from events, and of additional features
TRACKER = "stable"


@dataclass(frozen=True)
class Variant:
    """Training data and options of a detector. labels: truth, or event-flow, which is available only for ramps."""

    model: str = "disp-xy"
    speeds: bool = True
    negatives: bool = True
    labels: str = "truth"
    true_share: bool = True
    sticking: bool = False  # whether the sticking share is an input, for a network that has one
    horizon_ms: int = 10
    steps: int = 10_000
    preset: str = "adamw"
    networks: int = 1

    def words(self) -> list[str]:
        """Return the options of `evetac train`."""
        words = ["--model", self.model, "--preset", self.preset, "--horizon-ms", str(self.horizon_ms)]
        words += ["--max-steps", str(self.steps), "--networks", str(self.networks)]
        return words + ["--learn-true-slip-share"] * self.true_share


VARIANTS = {
    "slips": Variant(speeds=False, negatives=False, true_share=False),
    "slips-events": Variant(speeds=False, negatives=False, true_share=False, labels="event-flow"),
    "speeds": Variant(negatives=False, true_share=False),
    "negatives": Variant(true_share=False),
    "true-share": Variant(),
    "grip": Variant(model="disp-xy-grip"),
    "sticking": Variant(model="disp-xy-grip", sticking=True),
    "fast-slow": Variant(model="fast-slow"),
    "paper": Variant(model="fast-slow", speeds=False, negatives=False, true_share=False, preset="paper", steps=150_000),
}
IDEAS = tuple(VARIANTS)  # compared with each other, by the mean over several seeds
VARIANTS["shipped"] = replace(VARIANTS["sticking"], networks=4)
VARIANTS["outside"] = Variant(model="mean-of-dots")
VARIANTS |= {
    f"{name}-{ms}ms": replace(VARIANTS[name], horizon_ms=ms) for name in ("shipped", "paper") for ms in (0, 20)
}
MOST_STEPS = max(variant.steps for variant in VARIANTS.values())


def run(*words: object) -> None:
    """Run evetac; an error ends this script."""
    command = [sys.executable, "-P", "-m", "evetac_cli", *map(str, words)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"evetac {' '.join(map(str, words))}: {done.stderr}")


def motions_in(role: Path) -> list[Path]:
    """Return the folders of a role, one per motion."""
    return sorted(path for path in role.iterdir() if path.is_dir() and path.name not in (FROM_EVENTS, STICKING))


def make_features(data: Path, jobs: int) -> None:
    """Label, track and featurize the recordings of both roles; slips also with labels from events."""
    several = ("--jobs", jobs)
    for role in (data / "choose", data / "learn"):
        for folder in motions_in(role):
            run("label", folder, "--method", "truth", "--from-start", *several)
            run("track", folder, "--preset", TRACKER, *several)
            run("featurize", folder, "--true-slip-share", *several)
            beside = ("--tracks", folder, "--labels", folder, "--out", role / STICKING / folder.name)
            run("featurize", folder, "--true-slip-share", "--sticking-share", *beside, *several)
            if role.name == "learn" and folder.name in SLIPS:
                own = role / FROM_EVENTS / folder.name
                run("label", folder, "--out", own, *several)
                run("featurize", folder, "--tracks", folder, "--labels", own, "--out", own, *several)
            sys.stdout.write(f"{folder}\n")
            sys.stdout.flush()


def folders_of(variant: Variant, learn: Path) -> list[Path]:
    """Return the folders of features for training a variant."""
    chosen = []
    for folder in motions_in(learn):
        is_slip = folder.name in SLIPS
        if not (is_slip or (variant.speeds if folder.name == "slip-speeds" else variant.negatives)):
            continue
        if is_slip and variant.labels == "event-flow":
            chosen.append(learn / FROM_EVENTS / folder.name)
        else:
            chosen.append(learn / STICKING / folder.name if variant.sticking else folder)
    return chosen


def main(arguments: list[str] | None = None) -> None:
    """Make features, or train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("features", "train"))
    parser.add_argument("data", type=Path, help="folder that contains learn and choose")
    parser.add_argument("--out", type=Path, help="folder of the models, with one folder per variant")
    parser.add_argument("--variant", nargs="*", default=list(IDEAS), choices=list(VARIANTS))
    parser.add_argument(
        "--jobs", type=int, default=1, help="number of processes for features, or of parallel trainings"
    )
    parser.add_argument("--seeds", type=int, default=5, help="models of each variant")
    parser.add_argument("--steps", type=int, default=MOST_STEPS, help="limit of training steps, for a first look")
    chosen = parser.parse_args(arguments)
    if chosen.what == "features":
        make_features(chosen.data, chosen.jobs)
        return
    for name in chosen.variant:
        variant = VARIANTS[name]
        variant = replace(variant, steps=min(variant.steps, chosen.steps))
        choose = chosen.data / "choose" / STICKING if variant.sticking else chosen.data / "choose"
        validate = ["--validate", str(choose / "*" / "*.features.h5")]
        several = ["--seeds", chosen.seeds, "--jobs", chosen.jobs]
        run("train", *folders_of(variant, chosen.data / "learn"), *validate, *variant.words(), *several,
            "--out", chosen.out / name)  # fmt: skip
        sys.stdout.write(f"{name}\n")


if __name__ == "__main__":
    main()
