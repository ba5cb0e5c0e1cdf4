"""Run the experiments and studies (scripts/reproduce/plan.py) and store their tables, one small JSON each.

    python scripts/reproduce/run.py --list
    python scripts/reproduce/run.py --only tracking [--small] [--size edges=5] [--jobs 4] [--dry-run]
    python scripts/reproduce/run.py --table data-rate --out EMPTY  # one table again, compared with docs/results
    python scripts/reproduce/run.py --check [--only data-rate]  # every table on a tenth of its trials

Each command skips files that are up to date, so an experiment continues where it was stopped. Its files are in a folder
of their own (demo/, data/slip/, ...), those of `--small` in small/.

Tables go to docs/results/NAME.json, those of small runs to small/results/. They contain rows, layout, commands, recipe
ids of the reports, seeds, sizes, and the commit, all from the headers of the reports, so a table always documents its
own run. They also contain the computer, the core hours of all runs, and the digest of each model (facts.py). A
table of more trajectories, objects or models is not replaced by a smaller one unless --replace is given. Other
experiments' tables are not changed.

Ctrl-C ends the running command, which removes its unfinished files, and then this program, with exit code 130.
"""

import argparse
import sys
from pathlib import Path

from evetac_cli.errors import EvetacError
from scripts.reproduce import check_tables
from scripts.reproduce.experiment import Experiment
from scripts.reproduce.facts import RESULTS, ROOT, Refusal
from scripts.reproduce.perform import Running, as_text, in_order, perform, sizes_for
from scripts.reproduce.plan import EXPERIMENTS
from scripts.reproduce.steps import Sizes


def print_list() -> None:
    for experiment in EXPERIMENTS:
        names = ", ".join(table.name for table in experiment.tables)
        print(
            f"{experiment.name:12} {experiment.shows}; estimated {experiment.hours:g} h at full size"
            + (f"; {names}" * bool(names))
        )
        print(f"{'':12} " + " ".join(f"{name}={as_text(value)}" for name, value in experiment.full.items()))


def print_commands(experiment: Experiment, sizes: Sizes, out: Path, running: Running) -> None:
    print(f"mkdir -p {out / experiment.folder}; cd {out / experiment.folder}")
    for step in experiment.steps(sizes):
        print(*running.parallel(step))
    for name, words in experiment.evaluations(sizes).items():
        print(*running.parallel(words), "--out", f"{name}.report.h5", "--json")
    if experiment.measure:
        measure = experiment.measure
        print(f"# {measure.__module__}.{measure.__qualname__} measures the rest")


def make_or_check(chosen: argparse.Namespace, given: dict[str, str]) -> None:
    """Carry out --table, with the given sizes, or --check; Refusal for a table that neither knows.

    Without --out, files go to data/again/.
    """
    out = ROOT / "data" / "again" / ("check" if chosen.check else "whole") if chosen.out == ROOT else chosen.out
    running = Running(chosen.jobs, chosen.engine)
    if chosen.table:
        check_tables.make(chosen.table, out, chosen.results or out / "tables", running, given)
    else:
        check_tables.check(chosen.only, out, running, dry_run=chosen.dry_run, as_json=chosen.json)


def main(arguments: list[str] | None = None) -> None:
    """Read the flags and run the experiments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", action="append", default=[], metavar="NAME", help="this experiment and those that it builds on"
    )
    parser.add_argument("--small", action="store_true", help="sizes that take minutes, in separate folders")
    parser.add_argument(
        "--size", action="append", default=[], metavar="NAME=VALUE", help="change a size; lists are comma-separated"
    )
    parser.add_argument("--jobs", type=int, default=1, help="files worked on at the same time")
    parser.add_argument(
        "--engine", default="local", help="local, or dask:tls://ADDRESS, as for evetac (docs/cluster.md)"
    )
    parser.add_argument("--out", type=Path, default=ROOT, help="folder of the experiments' folders")
    parser.add_argument("--results", type=Path, default=None, help="folder of the tables")
    parser.add_argument("--replace", action="store_true", help="replace tables of larger runs too")
    parser.add_argument("--list", action="store_true", help="print the experiments with their sizes")
    parser.add_argument("--dry-run", action="store_true", help="print the commands without running them")
    parser.add_argument("--table", metavar="NAME", help="make one table whole, and compare it with docs/results")
    parser.add_argument(
        "--check", action="store_true", help="check all tables, or those of --only, on a tenth of their trials"
    )
    parser.add_argument("--json", action="store_true", help="with --check: print the results as JSON")
    chosen = parser.parse_args(arguments)
    if chosen.list:
        print_list()
        return
    try:
        given = dict(entry.split("=", 1) for entry in chosen.size)
    except ValueError:
        parser.error("--size takes NAME=VALUE, for example --size each=2")
    try:
        if chosen.table or chosen.check:
            make_or_check(chosen, given)
            return
        experiments = in_order(chosen.only or [experiment.name for experiment in EXPERIMENTS])
        unknown = [name for name in given if not any(name in experiment.full for experiment in experiments)]
        if unknown:
            raise Refusal(f"no chosen experiment has the size {', '.join(unknown)}; --list prints all sizes")
        out = chosen.out / "small" if chosen.small else chosen.out
        results = out / "results" if chosen.small else RESULTS
        running = Running(chosen.jobs, chosen.engine)
        for experiment in experiments:
            sizes = sizes_for(experiment, small=chosen.small, given=given)
            if chosen.dry_run:
                print_commands(experiment, sizes, out, running)
            else:
                usual = results if experiment.published else out / experiment.folder
                perform(experiment, sizes, out, chosen.results or usual, running, replace=chosen.replace)
    except (Refusal, EvetacError) as refusal:
        raise SystemExit(f"error: {refusal}") from None
    except KeyboardInterrupt:
        print("interrupted: complete files are kept; run the same command to continue", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
