"""All experiments, those of the paper and those of the studies; scripts/reproduce/run.py runs them."""

from scripts.paper import detections
from scripts.reproduce import steps, tables
from scripts.reproduce.experiment import Experiment
from scripts.studies.labels import judge as labels
from scripts.studies.likeness import tables as likeness
from scripts.studies.parts import effects
from scripts.studies.robots import tables as robots
from scripts.studies.sensors import blind, forces
from scripts.studies.slip import judge as slip
from scripts.studies.slip import recordings
from scripts.studies.sticking import judge as sticking
from scripts.studies.touch import study as touch

STUDIES = tuple(
    module.STUDY for module in (recordings, effects, blind, forces, robots, slip, labels, sticking, touch, likeness)
)
# The experiments of the paper, and pictures.
PAPER: tuple[Experiment, ...] = (
    Experiment(
        "demo", "all steps from touch to grasp on a simulated sensor", "demo", 0.1,
        full={"seed": 0, "learn": 5, "unseen": 3, "epochs": 30},
        small={"learn": 1, "unseen": 1, "epochs": 2},
        steps=steps.demo_steps, evaluations=steps.demo_evaluations, published=False,
        tables=(tables.DEMO,),
    ),
    Experiment(
        "paper-recipe", "slip detection by the paper's recipe at full size",
        "data/paper-recipe", 4.0, full=steps.RECIPE, small=steps.SMALL_RECIPE,
        steps=steps.recipe_steps, evaluations=steps.recipe_evaluations,
        tables=(tables.PAPER_RECIPE, tables.MODEL_COST, *detections.TABLES),
    ),
    Experiment(
        "image-networks", "slip detection from small event images, on a part of the recipe's trajectories",
        "data/paper-recipe", 1.0, full=steps.IMAGES, small={"files": "*-000", "seed": 100, "seeds": 1, "steps": 20},
        steps=steps.image_steps, evaluations=steps.image_evaluations,
        tables=(tables.IMAGE_NETWORKS,), after=("paper-recipe",),
    ),
    Experiment(
        "tracking", "tracker presets compared on edges, slip and shear", "data/tracking", 2.0,
        full={
            "seed": 102_000, "edges": 50, "others": 5,
            "presets": ("unregularised", "paper", "paper-5-events", "official", "stable"),
        },
        small={"seed": 100, "edges": 1, "others": 1, "presets": ("paper", "stable")},
        steps=steps.tracking_steps, evaluations=steps.tracking_evaluations,
        tables=(tables.TRACKING_EDGE, tables.TRACKING_DISTANCE),
    ),
    Experiment(
        "data-rate", "bytes per second compared with an RGB sensor", "data/data-rate", 0.1,
        full={"seed": 103_100, "objects": steps.DATA_RATE_OBJECTS, "trajectories": 5},
        small={"seed": 100, "objects": ("1",), "trajectories": 1},
        steps=steps.data_rate_steps, evaluations=steps.data_rate_evaluations,
        tables=(tables.DATA_RATE,),
    ),
    Experiment(
        "vibration", "vibration frequency of the gel", "data/vibration", 1.0,
        full={"seed": 103_000, "tones": (), "randomized": 20},
        small={"seed": 100, "tones": ("200",), "randomized": 1},
        steps=steps.vibration_steps, evaluations=steps.vibration_evaluations,
        tables=(tables.VIBRATION, tables.VIBRATION_RANDOMIZED),
    ),
    Experiment(
        "force", "shear force from dots in events and in frames", "data/force", 1.0,
        full=steps.FORCE,
        small={"seed": 100, "judged": 1_000, "seeds": 1, "trials": 1, "others": ("second",)},
        steps=steps.force_steps, evaluations=steps.force_evaluations,
        tables=(tables.FORCE,),
    ),
    Experiment(
        "grasp-table", "lift and balance by feel, with all controllers", "data/grasps", 3.0,
        full={
            "seed": 104_000, "objects": "10-18", "trials": 10, "alone": 5, "settings": tuple(steps.GRASP_SETTINGS),
        },
        small={
            "seed": 100, "objects": "11", "trials": 1, "alone": 1,
            "settings": ("load-proportional",),
        },
        steps=steps.grasp_steps, evaluations=steps.grasp_evaluations,
        tables=(tables.GRASPS, tables.GRASPS_BY_OBJECT, tables.GRASP_ROBUSTNESS),
    ),
    Experiment(
        "strips", "a picture of every scene: events, forces and slip", "strips", 0.2,
        full={"seed": 0}, small={}, steps=steps.strip_steps, after=("demo",),
    ),
    Experiment(
        "film", "a short film of a catch", "film", 0.1, full={}, small={}, steps=steps.film_steps,
    ),
)  # fmt: skip
EXPERIMENTS = (*PAPER, *(experiment for study in STUDIES for experiment in study.experiments))
