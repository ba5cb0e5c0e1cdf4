"""Build the commands of every experiment from its sizes.

A command is a list of words. Its globs are expanded in the experiment's folder when it runs, and `--jobs` is added
then.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

Sizes = dict[str, Any]  # name -> int, text such as "1-9", or a tuple of names
Command = list[str]
GRID = ("--node-pitch-mm", 1.45)  # of every simulated grasp: its tables are of one grid


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
    yield evetac("train", "learn/*.features.h5", "--validate", "choose", "--model", "fast-slow", "--preset", "adam",
                 "--epochs", sizes["epochs"], "--seed", seed, "--out", "slip.model.h5")  # fmt: skip
    yield evetac("grasp", "--object", 11, "--seed", seed, *GRID, "--controller", "paper", "--model", "slip.model.h5",
                 "--lift-s", 7, "--balance-s", 5, "--out", "with-detector.recording.h5")  # fmt: skip
    yield evetac("grasp", "--object", 11, "--seed", seed, *GRID, "--controller", "none", "--lift-s", 7,
                 "--balance-s", 0, "--out", "without-detector.recording.h5")  # fmt: skip


def demo_evaluations(sizes: Sizes) -> dict[str, Command]:
    return {
        "labels": evetac("evaluate", "labels", "unseen/*.labels.h5"),
        "tracking": evetac("evaluate", "tracking", "unseen/*.tracks.h5"),
        "slip": evetac("evaluate", "slip", "unseen/*.features.h5", "--model", "slip.model.h5"),
        "grasp": evetac("evaluate", "grasp", "with*-detector.recording.h5"),
    }


RECIPE: Sizes = {
    "seed": 9_000,  # of the trajectories for training; 500 later: those on which checkpoint and threshold are chosen
    "judged": 100_000,  # of the trajectories for evaluation, known objects; 500 later: unseen objects
    "known": "1-9",
    "unseen": "10-17",
    "train": 35,  # of each object: 315 for training, and 45 on which checkpoint and threshold are chosen
    "choose": 5,
    "test": 10,
    "models": ("no-hist", "hist10", "events-only", "disp-only", "down5", "hist20", "fast-slow"),
    "ahead": ("hist20", "fast-slow"),  # models that are also trained to warn
    "horizon_ms": ("10", "20"),
    "seeds": 2,  # of training
    "headlines": ("fast-slow",),  # models that headlines name: trained with more seeds, now and 10 ms ahead
    "headline_seeds": 5,
    "steps": 150_000,  # upper limit of steps, for 70 epochs
}
SMALL_RECIPE: Sizes = {
    "seed": 100,
    "judged": 1_000,
    "known": "3,8",
    "unseen": "11",
    "train": 2,
    "choose": 1,
    "test": 1,
    "models": ("fast-slow",),
    "ahead": (),
    "seeds": 1,
    "headlines": (),
    "steps": 200,
}


def recipe_steps(sizes: Sizes) -> Iterator[Command]:
    """Run the paper's recipe: tracker, labels, numbers of trajectories, training."""
    seed, judged = sizes["seed"], sizes["judged"]
    roles = (("learn", "known", "train", seed), ("choose", "known", "choose", seed + 500),
             ("known", "known", "test", judged), ("unseen", "unseen", "test", judged + 500))  # fmt: skip
    for role, objects, count, first in roles:
        recordings = f"recordings/{role}"
        here, labels, tracks = f"{recordings}/*.recording.h5", f"{recordings}/labels", f"{recordings}/tracks"
        yield evetac("record", "--scene", "slip", "--object", sizes[objects], "--count", sizes[count],
                     "--seed", first, "--out", recordings)  # fmt: skip
        yield evetac("label", here, "--method", "farneback", "--out", labels)
        yield evetac("track", here, "--preset", "paper", "--out", tracks)
        yield evetac("featurize", here, "--tracks", tracks, "--labels", labels, "--out", f"features/{role}")
    seeds, more = sizes["seeds"], sizes["headline_seeds"] - sizes["seeds"]
    trained = [(model, "0", 0, seeds) for model in sizes["models"]]
    trained += [(model, ms, 0, seeds) for model in sizes["ahead"] for ms in sizes["horizon_ms"]]
    trained += [(model, ms, seeds, more) for model in sizes["headlines"] for ms in ("0", "10")]
    for model, horizon_ms, first, count in trained:
        yield evetac("train", "features/learn/*.features.h5", "--model", model, "--horizon-ms", horizon_ms,
                     "--preset", "paper", "--max-steps", sizes["steps"], "--validate", "features/choose",
                     "--seed", sizes["seed"] + first, "--seeds", count, "--out", "models/recipe")  # fmt: skip


def recipe_evaluations(sizes: Sizes) -> dict[str, Command]:
    """Evaluate all networks on the same slips; then measure run times."""
    evaluations = {
        f"recipe-{role}": evetac("evaluate", "slip", f"features/{role}/*.features.h5",
                                 "--model", "models/recipe/*.model.h5", "--recordings", f"recordings/{role}")
        for role in ("known", "unseen")
    }  # fmt: skip
    evaluations["model-cost"] = evetac("evaluate", "cost", "model", "recipe-unseen.report.h5",
                                       "--model", "models/recipe/*.model.h5")  # fmt: skip
    return evaluations


IMAGES: Sizes = {
    "models": ("no-hist-img-6x6", "hist10-img-6x6"),  # those of 540 x 480 px need a GPU
    "files": "*-00[0-4]",  # trajectories of each object
    "seed": 9_000,
    "seeds": 2,
    "steps": 3_000,
}


def image_steps(sizes: Sizes) -> Iterator[Command]:
    """Train networks on event images of 90 x 80 px on a part of the recipe's trajectories."""
    for role in ("learn", "choose", "known", "unseen"):
        recordings = f"recordings/{role}"
        yield evetac("featurize", f"{recordings}/{sizes['files']}.recording.h5", "--tracks", f"{recordings}/tracks",
                     "--labels", f"{recordings}/labels", "--images", "--out", f"images/{role}")  # fmt: skip
    for model in sizes["models"]:
        yield evetac("train", "images/learn/*.features.h5", "--model", model, "--preset", "paper",
                     "--max-steps", sizes["steps"], "--validate", "images/choose", "--seed", sizes["seed"],
                     "--seeds", sizes["seeds"], "--out", "models/images")  # fmt: skip


def image_evaluations(sizes: Sizes) -> dict[str, Command]:
    return {
        f"images-{role}": evetac("evaluate", "slip", f"images/{role}/*.features.h5",
                                 "--model", "models/images/*.model.h5", "--recordings", f"recordings/{role}")
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
    for name, words in TRACKING_SCENES:
        count = sizes["edges"] if name == "edge-cut" else sizes["others"]  # slip: of each object
        yield evetac("record", *words, "--count", count, "--seed", sizes["seed"], "--out", name)
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


DATA_RATE_OBJECTS = ("1", "3", "5", "8", "11")


def data_rate_steps(sizes: Sizes) -> Iterator[Command]:
    """Record the data-rate scene; it gives every object an assumed weight, as the paper does not name its object."""
    for number in sizes["objects"]:
        yield evetac("record", "--scene", "data-rate", "--object", number, "--count", sizes["trajectories"],
                     "--seed", sizes["seed"], "--out", f"object-{number}")  # fmt: skip


def data_rate_evaluations(sizes: Sizes) -> dict[str, Command]:
    return {
        f"data-rate-object-{number}": evetac("evaluate", "data-rate", f"object-{number}/*.recording.h5")
        for number in sizes["objects"]
    }


FORCE: Sizes = {
    "seed": 8_700,  # of the trajectories for training
    "judged": 103_500,
    "trackers": ("paper", "paper-5-events", "stable"),
    "seeds": 5,
    "trials": 5,
    "others": ("second", "soft-gel", "stiff-gel"),
}


def force_steps(sizes: Sizes) -> Iterator[Command]:
    """Record force trajectories; those for evaluation have the same pushes on every gel."""
    yield evetac("record", "--scene", "shear", "--count", 4, "--seed", sizes["seed"], "--out", "learn")
    yield evetac("record", "--scene", "shear", "--count", sizes["trials"], "--seed", sizes["judged"],
                 "--out", "unseen")  # fmt: skip
    for other in sizes["others"]:
        yield evetac("record", "--scene", "shear", "--sensor", other, "--count", sizes["trials"],
                     "--seed", sizes["judged"], "--out", other)  # fmt: skip
    folders = ("learn", "unseen", *sizes["others"])
    for folder in folders:
        for tracker in sizes["trackers"]:
            yield evetac("track", f"{folder}/*.recording.h5", "--preset", tracker, "--out", f"{folder}/{tracker}")
        yield evetac("track", f"{folder}/*.recording.h5", "--rgb", "--out", f"{folder}/rgb")
    for dots in (*sizes["trackers"], "rgb"):
        for seed in range(sizes["seed"], sizes["seed"] + sizes["seeds"]):
            yield evetac("train-force", f"learn/{dots}/*.tracks.h5", "--seed", seed,
                         "--out", f"models/{dots}/{dots}-{seed}.force-model.h5")  # fmt: skip


def force_evaluations(sizes: Sizes) -> dict[str, Command]:
    """Evaluate the dots of each tracker, and those in RGB frames, with the models trained on such dots."""
    return {
        f"force-{dots}": evetac("evaluate", "force",
                                *(f"{folder}/{dots}/*.tracks.h5" for folder in ("unseen", *sizes["others"])),
                                "--model", f"models/{dots}", "--seed", sizes["judged"])
        for dots in (*sizes["trackers"], "rgb")
    }  # fmt: skip


FROZEN_MODELS = ROOT / "docs" / "results" / "models"
PAPER_DETECTOR = (
    "--model",
    FROZEN_MODELS / "recipe" / "fast-slow-10ms-s9000.model.h5",
)  # of the experiment paper-recipe
# Controller and detector of each row of the grasp tables. A model trained by the paper's recipe has the threshold of
# the paper's rule.
GRASP_SETTINGS: dict[str, Command] = {
    "paper": ["--controller", "paper", *map(str, PAPER_DETECTOR), "--tracker", "paper"],
    "paper-reset": ["--controller", "paper-reset", *map(str, PAPER_DETECTOR), "--tracker", "paper"],
    "load-proportional": ["--controller", "load-proportional", "--model", "shipped"],
}


def grasp_steps(sizes: Sizes) -> Iterator[Command]:
    """Grasp the objects of the paper's figure, some with double gain as there; then weights, sensor, closed gel."""
    trials, half = sizes["trials"], (sizes["trials"] + 1) // 2

    def grasp(out: str, count: int, objects: str, *words: object) -> Command:
        named = ("--object", objects, "--count", count, "--seed", sizes["seed"], *GRID)
        return evetac("grasp", *words, *named, "--out", out)

    for name in sizes["settings"]:
        setting = GRASP_SETTINGS[name]
        gain = () if "load-proportional" in setting else ("--gain", 2)
        if gain:
            yield grasp(name, trials, sizes["objects"], *setting)
            yield grasp(f"{name}-higher", trials, "14,19,20", *setting, *gain)
        else:
            yield grasp(name, trials, f"{sizes['objects']},19,20", *setting)
        tests = f"{name}-tests"
        yield grasp(tests, trials, "16", *setting, "--scene", "sideways")
        yield grasp(tests, trials, "16", *setting, "--scene", "drop-20g")
        yield grasp(tests, trials, "16", *setting, *gain, "--scene", "drop-100g")
        for gel in ("cut", "closed"):
            second, folder = ("--sensor", "second", "--gel", gel), f"{name}-second-{gel}"
            yield grasp(folder, half, "16,17", *setting, *second)
            yield grasp(folder, half, "19,20", *setting, *gain, *second)
    yield grasp("alone", sizes["alone"], "10-20", "--controller", "none", "--balance-s", 0)
    for ticks in (4, 8, 16):
        yield grasp(f"alone-{ticks}", sizes["alone"], "11,18", "--controller", f"fixed:{ticks}")


def grasp_evaluations(sizes: Sizes) -> dict[str, Command]:
    """Evaluate the grasps of each controller and detector on their own: settings do not name the detector."""
    return {
        **{
            f"grasps-{name}": evetac("evaluate", "grasp", f"{name}/*.recording.h5", f"{name}-higher/*.recording.h5")
            for name in sizes["settings"]
        },
        "grasps-alone": evetac("evaluate", "grasp", "alone/*.recording.h5", "alone-*/*.recording.h5"),
        **{
            f"grasp-robustness-{name}": evetac(
                "evaluate", "grasp", f"{name}-tests/*.recording.h5", f"{name}-second-*/*.recording.h5"
            )
            for name in sizes["settings"]
        },
    }


def strip_steps(sizes: Sizes) -> Iterator[Command]:
    seed = sizes["seed"]
    for scene in ("slip", "data-rate", "shear", "press", "edge"):
        yield evetac("record", "--scene", scene, "--seed", seed, "--out", f"{scene}.recording.h5")
    yield script("pictures/strips.py", "--short-vibration", "vibration.toml")
    yield evetac("record", "--scene", "vibration.toml", "--tone", 200, "--seed", seed,
                 "--out", "vibration.recording.h5")  # fmt: skip
    for scene in ("lift", "sideways", "drop-20g", "drop-100g"):
        yield evetac("grasp", "--scene", scene, "--object", 16, "--seed", seed, *GRID, "--controller", "paper",
                     "--model", "../demo/slip.model.h5", "--out", f"{scene}.recording.h5")  # fmt: skip
    yield script("pictures/strips.py", "*.recording.h5", "--out", ".")


def film_steps(sizes: Sizes) -> Iterator[Command]:
    """Record the catch for the film, which shows the farthest slide that was caught."""
    yield evetac("grasp", "--object", 17, "--seed", 0, *GRID, "--controller", "paper", "--model", "shipped",
                 "--lift-s", 7, "--balance-s", 5, "--texture", "on", "--out", "catch.recording.h5")  # fmt: skip
    yield evetac("track", "catch.recording.h5")
    yield script("pictures/film.py", "catch.recording.h5", "--out", "catch.gif")
