"""Build the commands of every experiment from its sizes.

A command is a list of words. Its globs are expanded in the experiment's folder when it runs, and `--jobs` is added
then.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

Sizes = dict[str, Any]  # name -> int, text such as "1-9", or a tuple of names
Command = list[str]


def evetac(*words: object) -> Command:
    return ["evetac", *(str(word) for word in words)]


def script(name: str, *words: object) -> Command:
    return ["python", f"scripts/{name}", *(str(word) for word in words)]


def demo_steps(sizes: Sizes) -> Iterator[Command]:
    """Return the demo's commands; training, validation and test trajectories have separate seeds."""
    seed = sizes["seed"]
    yield evetac("record", "--object", "3,6,8,9", "--count", sizes["learn"], "--seed", seed, "--out", "learn")
    yield evetac("record", "--object", "3,6,8,9", "--seed", seed + 500, "--out", "choose")
    yield evetac("record", "--object", "4,8,11", "--count", sizes["unseen"], "--seed", seed + 1000, "--out", "unseen")
    yield evetac("track", "*/*.recording.h5")
    yield evetac("label", "*/*.recording.h5", "--after-ms", 25)
    yield evetac("featurize", "*/*.recording.h5")
    yield evetac("train", "learn/*.features.h5", "--validate", "choose", "--model", "disp-xy", "--preset", "adam",
                 "--epochs", sizes["epochs"], "--seed", seed, "--out", "slip.model.h5")  # fmt: skip
    yield evetac("grasp", "--object", 11, "--seed", seed, "--model", "slip.model.h5", "--lift-s", 7, "--balance-s", 5,
                 "--out", "with-detector.recording.h5")  # fmt: skip
    yield evetac("grasp", "--object", 11, "--seed", seed, "--controller", "none", "--lift-s", 7, "--balance-s", 0,
                 "--out", "without-detector.recording.h5")  # fmt: skip


def demo_evaluations(sizes: Sizes) -> dict[str, Command]:
    return {
        "labels": evetac("evaluate", "labels", "unseen/*.labels.h5"),
        "tracking": evetac("evaluate", "tracking", "unseen/*.tracks.h5"),
        "slip": evetac("evaluate", "slip", "unseen/*.features.h5", "--model", "slip.model.h5"),
        "grasp": evetac("evaluate", "grasp", "with*-detector.recording.h5"),
    }


SLIP: Sizes = {
    "seed": 0,
    "sensor": "evetac",
    "tracker": "stable",
    "known": "1-9",  # objects that detectors are trained on
    "unseen": "10-17",  # unseen objects
    "train": 12,  # trajectories per object, by role
    "validate": 2,
    "test": 10,
    "seeds": 5,  # of training
    "models": ("no-hist", "hist10", "events-only", "disp-only", "hist20", "down5", "fast-slow"),
    "ours": ("disp-xy",),
    "image_models": ("no-hist-img-6x6", "hist10-img-6x6"),
    "horizon_ms": ("10", "20"),
    "presets": ("adamw", "paper"),
    "folds": 3,
    "steps": 40_000,
}
SMALL_SLIP: Sizes = {
    "known": "3,8",
    "unseen": "11",
    "train": 1,
    "validate": 1,
    "test": 1,
    "seeds": 1,
    "models": ("hist10", "fast-slow"),
    "image_models": ("hist10-img-6x6",),
    "horizon_ms": ("10",),
    "folds": 2,
    "steps": 200,
}
AHEAD = ("hist20", "fast-slow")  # models that are also trained to predict
LABELS = "event-flow"


def slip_data_steps(sizes: Sizes) -> Iterator[Command]:
    roles = (("learn", "known", "train", 0), ("choose", "known", "validate", 500), ("known", "known", "test", 1000),
             ("unseen", "unseen", "test", 1500))  # fmt: skip
    for folder, objects, count, offset in roles:
        yield evetac("record", "--scene", "slip", "--sensor", sizes["sensor"], "--object", sizes[objects],
                     "--count", sizes[count], "--seed", sizes["seed"] + offset, "--out", folder)  # fmt: skip
        yield evetac("label", f"{folder}/*.recording.h5")
        yield evetac("track", f"{folder}/*.recording.h5", "--preset", sizes["tracker"])
        yield evetac("featurize", f"{folder}/*.recording.h5", "--images")
    yield evetac("label", "learn/*.recording.h5", "--method", "truth", "--out", "truth")
    yield evetac("featurize", "learn/*.recording.h5", "--tracks", "learn", "--labels", "truth", "--out", "truth")


def learn(sizes: Sizes, features: str, folder: str, seeds: int, preset: str, steps: int, *words: object) -> Command:
    """Train one architecture with several seeds."""
    return evetac("train", f"{features}/*.features.h5", *words, "--preset", preset, "--max-steps", steps,
                  "--validate", "choose", "--seed", sizes["seed"], "--seeds", seeds,
                  "--out", f"models/{folder}")  # fmt: skip


def slip_model_steps(sizes: Sizes) -> Iterator[Command]:
    seeds, adamw_steps = sizes["seeds"], min(sizes["steps"], 10_000)
    for preset in sizes["presets"]:
        ours = sizes["ours"] if preset == "adamw" else ()
        steps = adamw_steps if preset == "adamw" else sizes["steps"]
        for model in (*sizes["models"], *ours):
            yield learn(sizes, "learn", preset, seeds, preset, steps, "--model", model)
        for model in (*(name for name in sizes["models"] if name in AHEAD), *ours):
            for horizon_ms in sizes["horizon_ms"]:
                yield learn(sizes, "learn", f"{preset}-ahead", seeds, preset, steps,
                            "--model", model, "--horizon-ms", horizon_ms)  # fmt: skip
    fast_slow = ("--model", "fast-slow", "--horizon-ms", 10)
    yield learn(sizes, "truth", "truth", seeds, "adamw", adamw_steps, *fast_slow)
    if sizes["folds"]:
        yield learn(sizes, "learn", "folds", seeds, "adamw", adamw_steps, *fast_slow, "--folds", sizes["folds"])


def slip_image_steps(sizes: Sizes) -> Iterator[Command]:
    """Train image baselines on images summed over 6 x 6 px, for a CPU, and hist10 for the same number of steps."""
    steps = min(sizes["steps"], 3_000)
    for model in ("hist10", *sizes["image_models"]):
        yield learn(sizes, "learn", "images", sizes["seeds"], "adamw", steps, "--model", model)
    for model in (name for name in sizes["image_models"] if name.startswith("hist10-img")):
        for horizon_ms in sizes["horizon_ms"]:
            yield learn(sizes, "learn", "images-ahead", sizes["seeds"], "adamw", steps,
                        "--model", model, "--horizon-ms", horizon_ms)  # fmt: skip


def slip_evaluations(sizes: Sizes) -> dict[str, Command]:
    unseen = ("models/*/hist20*.model.h5", "models/*/fast-slow*.model.h5", "models/*/disp-xy*.model.h5")
    known = ("models/paper/*.model.h5", "models/adamw/*.model.h5")
    return {
        "slip-training-objects": evetac("evaluate", "slip", "known/*.features.h5", "--model", *known),
        "slip-unseen-objects": evetac("evaluate", "slip", "unseen/*.features.h5", "--model", *unseen),
        "model-cost": evetac("evaluate", "cost", "model", "slip-unseen-objects.report.h5", "--model", *unseen),
    }


def slip_image_evaluations(sizes: Sizes) -> dict[str, Command]:
    known, unseen = "models/images/*.model.h5", "models/images*/hist10-img*.model.h5"
    return {
        "slip-images-training-objects": evetac("evaluate", "slip", "known/*.features.h5", "--model", known),
        "slip-images-unseen-objects": evetac("evaluate", "slip", "unseen/*.features.h5", "--model", unseen),
        "image-model-cost": evetac("evaluate", "cost", "model", "slip-images-unseen-objects.report.h5",
                                   "--model", unseen),
    }  # fmt: skip


def true_share_steps(sizes: Sizes) -> Iterator[Command]:
    """Run the same trainings on labels alone, and with the true slipping share of the contact in addition."""
    roles = (("learn", "known", "train", 0), ("choose", "known", "validate", 500), ("unseen", "unseen", "test", 1500))
    for folder, objects, count, offset in roles:
        yield evetac("record", "--scene", "slip", "--object", sizes[objects], "--count", sizes[count],
                     "--seed", sizes["seed"] + offset, "--out", folder)  # fmt: skip
        yield evetac("label", f"{folder}/*.recording.h5")
        yield evetac("track", f"{folder}/*.recording.h5")
        share = ("--true-slip-share",) if folder == "learn" else ()
        yield evetac("featurize", f"{folder}/*.recording.h5", *share)
    for horizon_ms in sizes["horizon_ms"]:
        for folder, words in (("labels", ()), ("truth", ("--learn-true-slip-share",))):
            yield learn(sizes, "learn", folder, sizes["seeds"], "adamw", sizes["steps"],
                        "--model", sizes["model"], "--horizon-ms", horizon_ms, *words)  # fmt: skip


RECIPE: Sizes = {
    "seed": 41_000,
    "known": "1-9",
    "unseen": "10-17",
    "train": 35,  # of each object: 315 for training, and 45 on which checkpoint and threshold are chosen
    "choose": 5,
    "test": 10,
    "models": ("fast-slow", "hist20", "hist10", "no-hist", "events-only", "disp-only"),
    "ahead": ("10",),  # ms ahead of slip that CHANGED_MODEL is also trained to warn
    "seeds": 2,
    "steps": 150_000,  # upper limit of steps, for 70 epochs
    "changes": ("tracker", "labels", "size", "noise"),
}
SMALL_RECIPE: Sizes = {
    "known": "3,8",
    "unseen": "11",
    "train": 2,
    "choose": 1,
    "test": 1,
    "models": ("fast-slow",),
    "ahead": (),
    "seeds": 1,
    "steps": 200,
    "changes": ("tracker", "size"),
}
ROLES = (("learn", "known", "train", 0), ("choose", "known", "choose", 500), ("known", "known", "test", 1000),
         ("unseen", "unseen", "test", 1500))  # fmt: skip
CHANGED_MODEL = "fast-slow"  # the model that is trained for changed settings
FEWER = ("*-00[1-9]", "*-01[0-2]")  # of 35 trajectories per object, when their number is varied


def recipe_steps(sizes: Sizes) -> Iterator[Command]:
    """Run the paper's recipe (tracker, labels, numbers of trajectories, training), then change one at a time."""
    for change in ("nothing", *sizes["changes"]):
        if change == "size":  # trains on a subset of the trajectories
            features = [f"nothing/learn/{name}.features.h5" for name in FEWER]
            yield from _recipe_trainings(sizes, "nothing", change, *features)
            continue
        recordings = "quiet" if change == "noise" else "recordings"
        tracker = "stable" if change == "tracker" else "paper"
        labels = "event-flow" if change == "labels" else "farneback"
        for role, objects, count, offset in ROLES:
            here = f"{recordings}/{role}/*.recording.h5"
            if change in ("nothing", "noise"):
                sensor = ROOT / "scripts" / "no-noise.sensor.toml" if change == "noise" else "evetac"
                yield evetac("record", "--scene", "slip", "--sensor", sensor, "--object", sizes[objects],
                             "--count", sizes[count], "--seed", sizes["seed"] + offset,
                             "--out", f"{recordings}/{role}")  # fmt: skip
            of_labels, of_tracks = (f"{recordings}/{how}/{role}" for how in (labels, tracker))
            yield evetac("label", here, "--method", labels, "--out", of_labels)
            yield evetac("track", here, "--preset", tracker, "--out", of_tracks)
            yield evetac("featurize", here, "--tracks", of_tracks, "--labels", of_labels, "--out", f"{change}/{role}")
        yield from _recipe_trainings(sizes, change, change, f"{change}/learn/*.features.h5")


def _recipe_trainings(sizes: Sizes, features: str, change: str, *learnt: str) -> Iterator[Command]:
    trained: list[tuple[str, ...]] = [(CHANGED_MODEL,)]
    if change == "nothing":
        trained = [(model,) for model in sizes["models"]]
        trained += [(CHANGED_MODEL, "--horizon-ms", horizon_ms) for horizon_ms in sizes["ahead"]]
    for words in trained:
        yield evetac("train", *learnt, "--model", *words, "--preset", "paper", "--max-steps", sizes["steps"],
                     "--validate", f"{features}/choose", "--seed", sizes["seed"], "--seeds", sizes["seeds"],
                     "--out", f"models/{change}")  # fmt: skip


def recipe_evaluations(sizes: Sizes) -> dict[str, Command]:
    """Evaluate each training with its own tracker and labels on the same slips."""
    return {
        f"recipe-{change}-{role}": evetac(
            "evaluate", "slip", f"{'nothing' if change == 'size' else change}/{role}/*.features.h5",
            "--model", f"models/{change}/*.model.h5",
            "--recordings", f"{'quiet' if change == 'noise' else 'recordings'}/{role}",
        )
        for change in ("nothing", *sizes["changes"])
        for role in ("known", "unseen")
    }  # fmt: skip


TRACKING_SCENES = (
    ("edge-cut", ("--scene", "edge")),
    ("edge-closed", ("--scene", "edge", "--gel", "closed")),
    *(
        (f"{scene}-{gel}", ("--scene", scene, "--gel", gel, *objects))
        for gel in ("cut", "closed")
        for scene, objects in (("slip", ("--object", "3,8,11,16,18")), ("shear", ()))
    ),
)


def tracking_steps(sizes: Sizes) -> Iterator[Command]:
    count = {"edge-cut": sizes["edges"], "edge-closed": min(sizes["edges"], 5)}
    for name, words in TRACKING_SCENES:
        counted = ("--count", count[name]) if name in count else ()
        yield evetac("record", *words, *counted, "--seed", sizes["seed"], "--out", name)
        for preset in sizes["presets"]:
            yield evetac("track", f"{name}/*.recording.h5", "--preset", preset, "--out", f"{name}/{preset}")


def tracking_evaluations(sizes: Sizes) -> dict[str, Command]:
    return {
        f"tracking-{name}": evetac("evaluate", "tracking", f"{name}/*/*.tracks.h5", "--recordings", name)
        for name, _ in TRACKING_SCENES
    }


def vibration_steps(sizes: Sizes) -> Iterator[Command]:
    tones = ("--tone", ",".join(sizes["tones"])) if sizes["tones"] else ()
    yield evetac("record", "--scene", "vibration", *tones, "--seed", sizes["seed"], "--out", ".")
    yield evetac("record", "--scene", "vibration-randomized", *tones, "--count", sizes["randomized"],
                 "--seed", sizes["seed"], "--out", "randomized")  # fmt: skip


def vibration_evaluations(sizes: Sizes) -> dict[str, Command]:
    seed, windows = sizes["seed"], ("--windows", "10,2,1,0.25")
    files = {"vibration": f"vibration-*hz-s{seed}-000", "vibration-randomized": f"randomized/*hz-s{seed}-*"}
    return {name: evetac("evaluate", "vibration", f"{file}.recording.h5", *windows) for name, file in files.items()}


def data_rate_steps(sizes: Sizes) -> Iterator[Command]:
    """Record the data-rate scene; it gives object 1 an assumed weight, as the paper does not name its object."""
    yield evetac("record", "--scene", "data-rate", "--object", "1", "--count", sizes["trajectories"],
                 "--seed", sizes["seed"], "--out", ".")  # fmt: skip


def data_rate_evaluations(sizes: Sizes) -> dict[str, Command]:
    return {"data-rate": evetac("evaluate", "data-rate", f"data-rate-*-s{sizes['seed']}-*.recording.h5")}


def force_steps(sizes: Sizes) -> Iterator[Command]:
    """Record force trajectories; the first one for evaluation has the same pushes on every gel."""
    seed = sizes["seed"]
    yield evetac("record", "--scene", "shear", "--count", 4, "--seed", seed, "--out", "learn")
    yield evetac("record", "--scene", "shear", "--count", sizes["judged"], "--seed", seed + 500, "--out", "unseen")
    for other in sizes["others"]:
        yield evetac("record", "--scene", "shear", "--sensor", other, "--seed", seed + 500, "--out", other)
    yield evetac("track", "*/*.recording.h5", "--preset", sizes["tracker"])
    yield evetac("track-rgb", "*/*.recording.h5")
    for each in range(seed, seed + sizes["seeds"]):
        yield evetac("train-force", "learn/*.tracks.h5", "--seed", each,
                     "--out", f"models/events-{each}.force-model.h5")  # fmt: skip
        yield evetac("train-force", "learn/rgb/*.tracks.h5", "--seed", each,
                     "--out", f"models/frames-{each}.force-model.h5")  # fmt: skip


def force_evaluations(sizes: Sizes) -> dict[str, Command]:
    others = [f"{other}/{tracks}" for other in sizes["others"] for tracks in ("*.tracks.h5", "rgb/*.tracks.h5")]
    return {
        "force": evetac("evaluate", "force", "unseen/*.tracks.h5", "unseen/rgb/*.tracks.h5", *others,
                        "--model", "models", "--seed", sizes["seed"])
    }  # fmt: skip


def grasp_steps(sizes: Sizes) -> Iterator[Command]:
    """Grasp the objects of the paper's figure, some with double gain as there; then weights, sensor, closed gel."""
    trials, half = sizes["trials"], (sizes["trials"] + 1) // 2

    def grasp(out: str, count: int, objects: str, *words: object) -> Command:
        return evetac("grasp", *words, "--object", objects, "--count", count, "--seed", sizes["seed"], "--out", out)

    for controller in sizes["controllers"]:
        law = ("--controller", controller)
        gain = () if controller == "load-proportional" else ("--gain", 2)
        yield grasp(controller, trials, sizes["objects"], *law)
        if gain:
            yield grasp(f"{controller}-higher", trials, "14,19,20", *law, *gain)
        else:
            yield grasp(controller, trials, "19,20", *law)
        tests = f"{controller}-tests"
        yield grasp(tests, trials, "16", *law, "--scene", "sideways")
        yield grasp(tests, trials, "16", *law, "--scene", "drop-20g")
        yield grasp(tests, trials, "16", *law, *gain, "--scene", "drop-100g")
        for gel in ("cut", "closed"):
            second, folder = ("--sensor", "second", "--gel", gel), f"{controller}-second-{gel}"
            yield grasp(folder, half, "16,17", *law, *second)
            yield grasp(folder, half, "19,20", *law, *gain, *second)
    yield grasp("alone", sizes["alone"], "10-20", "--controller", "none", "--balance-s", 0)
    for ticks in (4, 8, 16):
        yield grasp(f"fixed-{ticks}", sizes["alone"], "11,18", "--controller", f"fixed:{ticks}")


def grasp_evaluations(sizes: Sizes) -> dict[str, Command]:
    laws = sizes["controllers"]
    lifts = [f"{law}{part}/*.recording.h5" for law in laws for part in ("", "-higher")]
    tests = [f"{law}-{part}/*.recording.h5" for law in laws for part in ("tests", "second-*")]
    return {
        "grasps": evetac("evaluate", "grasp", *lifts, "alone/*.recording.h5", "fixed-*/*.recording.h5"),
        "grasp-robustness": evetac("evaluate", "grasp", *tests),
    }


def strip_steps(sizes: Sizes) -> Iterator[Command]:
    seed = sizes["seed"]
    for scene in ("slip", "data-rate", "shear", "press", "edge"):
        yield evetac("record", "--scene", scene, "--seed", seed, "--out", f"{scene}.recording.h5")
    yield script("pictures/strips.py", "--short-vibration", "vibration.toml")
    yield evetac("record", "--scene", "vibration.toml", "--tone", 200, "--seed", seed,
                 "--out", "vibration.recording.h5")  # fmt: skip
    for scene in ("lift", "sideways", "drop-20g", "drop-100g"):
        yield evetac("grasp", "--scene", scene, "--object", 16, "--seed", seed, "--model", "../demo/slip.model.h5",
                     "--out", f"{scene}.recording.h5")  # fmt: skip
    yield script("pictures/strips.py", "*.recording.h5", "--out", ".")


def film_steps(sizes: Sizes) -> Iterator[Command]:
    """Record the catch for the film, which shows the farthest slide that was caught."""
    yield evetac("grasp", "--object", 17, "--seed", 0, "--lift-s", 7, "--balance-s", 5,
                 "--texture", "on", "--out", "catch.recording.h5")  # fmt: skip
    yield evetac("track", "catch.recording.h5")
    yield script("pictures/film.py", "catch.recording.h5", "--out", "catch.gif")


def ship_steps(sizes: Sizes) -> Iterator[Command]:
    """Record motions for the pretrained slip detector, train it, and put it into the package."""
    some = ("--motions", ",".join(sizes["motions"])) if sizes["motions"] else ()
    for role in ("learn", "choose"):
        yield script("motion_recordings.py", role, "--out", role, "--per-object", sizes["per_object"], *some)
    yield script("train_detectors.py", "features", ".")
    yield script("train_detectors.py", "train", ".", "--variant", "shipped", "--seeds", 1, "--steps", sizes["steps"],
                 "--out", "models")  # fmt: skip
    yield script("ship/ship_model.py", "models/shipped/*.model.h5")
