"""The table of all experiments of the paper and all additional studies; scripts/reproduce/run.py runs them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from scripts.paper import slip_tables
from scripts.reproduce import steps, tables
from scripts.reproduce.steps import Command, Sizes, evetac
from scripts.reproduce.tables import Table
from scripts.studies import plans


@dataclass(frozen=True)
class Experiment:
    """One experiment: its commands, its sizes and its results."""

    name: str
    shows: str
    folder: str  # folder of its files; experiments that build on each other share one
    hours: float  # at full size on two cores: an estimate
    full: Sizes
    small: Sizes  # the sizes that differ from full size
    steps: Callable[[Sizes], Iterator[Command]] = lambda sizes: iter(())
    evaluations: Callable[[Sizes], dict[str, Command]] = lambda sizes: {}
    measure: str = ""  # MODULE.FUNCTION in this folder, for measurements that no command makes
    tables: tuple[Table, ...] = ()
    after: tuple[str, ...] = ()  # experiments that must run first
    published: bool = True  # whether its tables go to docs/results/; otherwise they stay in its folder


EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment(
        "demo", "all steps from touch to grasp on a simulated sensor", "demo", 0.1,
        full={"seed": 0, "learn": 5, "unseen": 3, "epochs": 30},
        small={"learn": 1, "unseen": 1, "epochs": 2},
        steps=steps.demo_steps, evaluations=steps.demo_evaluations, published=False,
        tables=(tables.DEMO,),
    ),
    Experiment(
        "true-slip-share", "benefit of training on the true slipping share of the contact",
        "data/true-slip-share", 0.1,
        full={
            "seed": 8_000, "judged": 91_700, "known": "1-9", "unseen": "10-17", "train": 6, "validate": 2, "test": 5,
            "seeds": 3, "model": "fast-slow", "horizon_ms": ("0", "10"), "steps": 5_000,
        },
        small={
            "seed": 100, "judged": 1_000, "known": "3,8", "unseen": "11", "train": 1, "validate": 1, "test": 1,
            "seeds": 1, "steps": 200,
        },
        steps=steps.true_share_steps,
        evaluations=lambda sizes: {
            "true-slip-share": evetac("evaluate", "slip", "unseen/*.features.h5", "--model", "models/*/*.model.h5"),
        },
        tables=(tables.TRUE_SLIP_SHARE,),
    ),
    Experiment(
        "paper-recipe", "slip detection by the paper's recipe at full size, and with one change at a time",
        "data/paper-recipe", 6.0, full=steps.RECIPE, small=steps.SMALL_RECIPE,
        steps=steps.recipe_steps, evaluations=steps.recipe_evaluations,
        tables=(tables.PAPER_RECIPE, tables.RECIPE_CHANGES, tables.MODEL_COST, *slip_tables.TABLES),
    ),
    Experiment(
        "ship", "the pretrained slip detector, trained on many motions, sensors and objects", "data/ship", 1.0,
        full={"motions": (), "per_object": 40, "steps": 10_000},  # no motions given: all; 40: the most available
        small={"motions": ("slip", "pushes"), "per_object": 1, "steps": 200},
        steps=steps.ship_steps,
    ),
    Experiment(
        "tracking", "tracker presets compared on edges, slip and shear", "data/tracking", 2.0,
        full={"seed": 92_000, "edges": 50, "presets": ("unregularised", "paper", "official", "stable")},
        small={"seed": 100, "edges": 1, "presets": ("paper", "stable")},
        steps=steps.tracking_steps, evaluations=steps.tracking_evaluations,
        tables=(tables.TRACKING_EDGE, tables.TRACKING_DISTANCE),
    ),
    Experiment(
        "data-rate", "bytes per second compared with an RGB sensor", "data/data-rate", 0.1,
        full={"seed": 93_100, "objects": steps.DATA_RATE_OBJECTS, "trajectories": 5},
        small={"seed": 100, "objects": ("1",), "trajectories": 1},
        steps=steps.data_rate_steps, evaluations=steps.data_rate_evaluations,
        tables=(tables.DATA_RATE,),
    ),
    Experiment(
        "vibration", "vibration frequency of the gel", "data/vibration", 1.0,
        full={"seed": 93_000, "tones": (), "randomized": 20},
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
            "seed": 94_000, "objects": "10-18", "trials": 10, "alone": 5, "settings": tuple(steps.GRASP_SETTINGS),
        },
        small={
            "seed": 100, "objects": "11", "trials": 1, "alone": 1,
            "settings": ("paper-pretrained", "load-proportional"),
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
    Experiment(
        "part-effects", "effect of each part of a sensor or a scene on each stage", "data/part-effects", 1.0,
        full={"seed": 20_000, "slips": 15, "grasps": 9, "parts": ()},
        small={"slips": 3, "grasps": 0, "parts": ("leak",)},
        measure="scripts.studies.parts.effects.measure",
        tables=(plans.PART_EFFECTS,),
    ),
    Experiment(
        "blind-identification", "does identify recover unseen sensors", "data/blind-identification",
        0.8, full={"first": 20_020, "sensors": 20, "grips": 3}, small={"sensors": 1},
        measure="scripts.studies.sensors.blind.measure",
        tables=(plans.BLIND_IDENTIFICATION,),
    ),
    Experiment(
        "force-sensors", "shear and normal force from touch maps of different sensors", "data/force-sensors", 3.0,
        full={"first": 20_020, "sensors": 20, "adapt": 12}, small={"sensors": 1, "adapt": 1},
        steps=plans.force_sensor_steps, evaluations=plans.force_sensor_evaluations,
        tables=(plans.FORCE_SENSORS, plans.FORCE_OBJECTS), after=("blind-identification",),
    ),
    Experiment(
        "touch-cost", "cost of a step of the touch sensor", "data/touch-cost", 0.1,
        full={"rounds": 4, "ms": 500}, small={"rounds": 2, "ms": 50},
        measure="scripts.studies.robots.tables.touch_cost",
        tables=(plans.TOUCH_COST,),
    ),
    Experiment(
        "mujoco-grasps", "grasps in MuJoCo with evetac's touch sensor, detector and laws", "data/mujoco-grasps", 0.1,
        full={"trials": 20, "seed": 22_000}, small={"trials": 1},
        steps=plans.mujoco_steps, measure="scripts.studies.robots.tables.mujoco_grasps",
        tables=(plans.MUJOCO_GRASPS,),
    ),
    Experiment(
        "lift-baseline", "a grip law found by CMA-ES compared with fixed grips", "data/lift-baseline", 0.5,
        full={"runs": 5, "generations": 4, "candidates": 6, "episodes": 2, "judged": 20, "judged_from": 22_000},
        small={"runs": 1, "generations": 1, "candidates": 4, "episodes": 1, "judged": 1},
        steps=plans.lift_steps, measure="scripts.studies.robots.tables.lift_baseline",
        tables=(plans.LIFT_BASELINE,),
    ),
)  # fmt: skip
