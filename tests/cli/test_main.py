"""The command line: help, flags, exit codes, --json, outputs. Stages are stand-ins, so that only main is tested."""

import dataclasses
import json
import os
import pickle
import pty
import re
import shutil
import sys
import tty
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from evetac_cli import __version__
from evetac_cli.cli import execution
from evetac_cli.cli.flags import Running
from evetac_cli.cli.main import app
from evetac_cli.commands import pipeline
from evetac_cli.commands.label import Label
from evetac_cli.commands.parameter import Command, flag_of
from evetac_cli.errors import (
    DeviceError,
    DeviceTimeout,
    EvetacError,
    InputError,
    SceneError,
    SchemaError,
    attach_outcome,
    attached_outcome,
    error_dict,
    install_hint,
)
from evetac_cli.evaluate import SUBJECTS
from evetac_cli.jobs import Job, Outcome, Progress, Stage, outcome, silent
from evetac_cli.stages import per_file
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Recipe

COMMANDS = [([command.name], command) for command in pipeline()]
COMMANDS += [(["evaluate", command.name], command) for command in SUBJECTS]


def evetac(*arguments: str | Path) -> Result:
    """Run the program in this process, on a wide terminal without colours."""
    wide = {"COLUMNS": "400", "TERM": "dumb", "NO_COLOR": "1"}
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env=wide)


def plain_text(text: str) -> str:
    """Without colours, frames and runs of blanks."""
    return re.sub(r"\s+", " ", re.sub(r"\x1b\[[0-9;]*m|[│╭╮╰╯─]", " ", text))


Act = Callable[[Job, Any], Outcome]


def module_of(jobs: Any, run: Any, **more: Any) -> SimpleNamespace:
    """A stage's module, as the command line and its workers see it."""
    return SimpleNamespace(run=run, STAGE=Stage(jobs, run, **more))


@pytest.fixture
def label_is(monkeypatch: pytest.MonkeyPatch) -> Callable[[Act], None]:
    """Let a function stand in for what `evetac label` does to each file."""

    def put(act: Act) -> None:
        def run(job: Job, chosen: Any, *, force: bool = False, progress: Progress = silent) -> Outcome:
            progress(0, 1)
            return act(job, chosen)

        stage = module_of(lambda files, chosen, out: per_file(files, "labels", out), run)
        monkeypatch.setitem(sys.modules, "evetac_cli.stages.label", stage)

    return put


def made(job: Job, chosen: Any) -> Outcome:
    """A stage that makes its output."""
    job.output.parent.mkdir(parents=True, exist_ok=True)
    job.output.write_text("made")
    return outcome(job, made=True, simulated=True, slices=3, confidence=float("nan"))


def skipped(job: Job, chosen: Any) -> Outcome:
    """A stage whose output is up to date."""
    return outcome(job, made=False, simulated=False)


def raising(error: BaseException) -> Act:
    """A stage that fails."""

    def act(job: Job, chosen: Any) -> Outcome:
        raise error

    return act


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Three inputs in the present folder."""
    monkeypatch.chdir(tmp_path)
    names = [f"{letter}.recording.h5" for letter in "abc"]
    for name in names:
        Path(name).write_text(name)
    return names


def test_version() -> None:
    """Assert that the version is that of the package, on stdout alone."""
    result = evetac("--version")
    assert (result.exit_code, result.stdout, result.stderr) == (0, f"evetac {__version__}\n", "")


@pytest.mark.parametrize("arguments", [[], ["evaluate"]])
def test_without_a_command(arguments: list[str]) -> None:
    """Assert that without a command there is help, listing all there are."""
    text = plain_text(evetac(*arguments).output)
    assert "Usage:" in text
    for path, _ in COMMANDS:
        if path[: len(arguments)] == arguments:
            assert path[len(arguments)] in text


@pytest.mark.parametrize(("path", "command"), COMMANDS, ids=[" ".join(path) for path, _ in COMMANDS])
def test_help_says_everything(path: list[str], command: Command) -> None:
    """Assert that the help of a command has each flag with help, choices, unit and default, also where that is 0."""
    result = evetac(*path, "--help-all")
    text = plain_text(result.output)
    assert result.exit_code == 0
    assert " ".join(command.params.__doc__.split()) in text
    for item in dataclasses.fields(command.params):
        about = item.metadata
        flag = flag_of(item)
        panels = text.index(" Options " if flag.startswith("-") else " Arguments ")  # behind the examples
        start = text.index(f" {flag} ", panels)
        entry = text[start : start + 600]
        said = plain_text(about["help"])
        assert said in entry, item.name
        tail = entry[entry.index(said) + len(said) :].split(" --")[0]
        if len(about["choices"]) > 1:
            assert f"({', '.join(about['choices'])})" in tail
        if about["unit"]:
            assert f"[{about['unit']}]" in tail
        if item.default is None or item.default is False or item.default == "":
            assert "[default" not in tail
        else:
            assert f"[default: {item.default}]" in tail
    for flag in ("--out -o", "--force -f", "--jobs -j", "--config", "--json", "--quiet -q", "--verbose -v"):
        assert flag in text


ERRORS = [
    (EvetacError("m"), 1),
    (InputError("m"), 2),
    (SchemaError("m"), 2),
    (SceneError("m"), 2),
    (DeviceError("m"), 3),
    (DeviceTimeout("m"), 3),
]


def test_verbose_has_the_traceback(label_is: Any, files: list[str]) -> None:
    """Assert that -v shows where an error was raised."""
    label_is(raising(InputError("m")))
    result = evetac("label", files[0], "-v")
    assert result.exit_code == 2
    assert "Traceback" in result.stderr
    assert result.stderr.endswith("error: m\n")
    label_is(raising(PermissionError(13, "Permission denied", "x.h5")))
    result = evetac("label", files[0], "-v")
    assert (result.exit_code, result.stderr.splitlines()[-1]) == (2, "error: x.h5: Permission denied")
    assert "Traceback" in result.stderr


def test_an_error_does_not_stop_the_others(label_is: Any, files: list[str]) -> None:
    """Assert that the other files are made, every error is printed, and the first one gives the exit code."""

    def act(job: Job, chosen: Any) -> Outcome:
        if job.output.name != "b.labels.h5":
            raise (DeviceError if job.output.name.startswith("a") else InputError)(f"bad {job.output.name}")
        return made(job, chosen)

    label_is(act)
    result = evetac("label", *files, "--json")
    assert result.exit_code == 3
    assert [row["output"] for row in json.loads(result.stdout)["rows"]] == ["b.labels.h5"]
    assert "error: bad a.labels.h5" in result.stderr
    assert "error: bad c.labels.h5" in result.stderr
    assert Path("b.labels.h5").exists()


def test_json_shape(label_is: Any, files: list[str]) -> None:
    """Assert that --json prints one object of four keys with a row for each file, null for NaN, and messages apart."""
    label_is(made)
    result = evetac("label", *files, "--json")
    assert result.exit_code == 0
    assert result.stdout.count("\n") == 1
    shown = json.loads(result.stdout)
    assert list(shown) == ["command", "simulated", "rows", "summary"]
    assert shown["command"] == "label"
    assert shown["simulated"] is True
    assert shown["rows"] == [
        {"output": f"{name}.labels.h5", "status": "made", "slices": 3, "confidence": None} for name in "abc"
    ]
    assert shown["summary"] == {"made": 3, "up_to_date": 0}
    assert result.stderr.startswith("label: ")
    assert evetac("label", *files, "--json", "-q").stderr == ""


PARTS = {"message": "m", "where": "w", "expected": "e", "found": "f", "hint": "h", "kept": "k"}
ENDINGS: list[tuple[BaseException, int, dict[str, str]]] = [
    (error, code, {"kind": type(error).__name__, "message": "m"}) for error, code in ERRORS
]
ENDINGS += [
    (DeviceError(**PARTS), 3, {"kind": "DeviceError", **PARTS}),
    (KeyboardInterrupt("interrupted: 7 slices"), 130, {"kind": "Interrupted", "message": "interrupted: 7 slices"}),
    (
        PermissionError(13, "Permission denied", "x.h5"),
        2,
        {"kind": "PermissionError", "message": "Permission denied", "where": "x.h5"},
    ),
    (
        ModuleNotFoundError("No module named 'bokeh.embed'", name="bokeh.embed"),
        1,
        {
            "kind": "MissingLibrary",
            "message": "the library bokeh is not installed",
        },
    ),
    (ZeroDivisionError("bug"), 1, {"kind": "InternalError", "message": "internal error: ZeroDivisionError: bug"}),
]


@pytest.mark.parametrize(("error", "code", "expected"), ENDINGS, ids=lambda value: type(value).__name__)
def test_json_says_how_it_ended(
    label_is: Any, files: list[str], error: BaseException, code: int, expected: dict[str, str]
) -> None:
    """Assert that whatever ends a command, --json is one object with the error, the exit status and what was made."""
    label_is(lambda job, chosen: made(job, chosen) if job.output.name.startswith("a") else raising(error)(job, chosen))
    result = evetac("label", *files[:2], "--json")
    assert result.exit_code == code
    assert result.stdout.count("\n") == 1
    shown = json.loads(result.stdout)
    if expected["kind"] == "MissingLibrary":
        expected = {**expected, "hint": install_hint("plot")}  # which names the working folder where that is the clone
    assert shown["error"] == {**expected, "exit_status": code}
    assert [row["output"] for row in shown["rows"]] == ["a.labels.h5"]
    assert (shown["command"], shown["simulated"], shown["summary"]) == ("label", True, {"made": 1, "up_to_date": 0})


@pytest.mark.parametrize("error", [DeviceError("gone"), KeyboardInterrupt("interrupted: 7 slices in a.labels.h5")])
def test_json_has_the_rows_of_what_was_kept(label_is: Any, files: list[str], error: BaseException) -> None:
    """Assert that the file of a recording that was interrupted, or whose device failed, has its row."""

    def act(job: Job, chosen: Any) -> Outcome:
        raise attach_outcome(error, outcome(job, made=True, simulated=True, slices=7))

    label_is(act)
    shown = json.loads(evetac("label", files[0], "--json").stdout)
    assert shown["rows"] == [{"output": "a.labels.h5", "status": "made", "slices": 7}]
    assert (shown["simulated"], shown["summary"]["made"]) == (True, 1)
    assert shown["error"]["message"] == str(error)


@pytest.mark.parametrize(
    ("arguments", "command", "words"),
    [
        (["label", "a.recording.h5", "--confirm-ms", "2.5"], "label", "--confirm-ms"),
        (["label", "a.recording.h5", "--nonsense"], "label", "--nonsense"),
        (["label"], "label", "Missing argument"),
        (["evaluate", "slip", "--nonsense"], "evaluate slip", "--nonsense"),
        (["--nonsense", "label"], "", "--nonsense"),
        (["info"], "info", "Missing argument"),
    ],
)
def test_json_of_usage_errors(files: list[str], arguments: list[str], command: str, words: str) -> None:
    """Assert that a command line that is not understood is one object too, and nothing on stdout without --json."""
    result = evetac(*arguments, "--json")
    assert result.exit_code == 2
    shown = json.loads(result.stdout)
    assert (shown["command"], shown["rows"], shown["error"]["exit_status"]) == (command, [], 2)
    assert words in shown["error"]["message"]
    assert words in plain_text(result.stderr)
    assert evetac(*arguments).stdout == ""


@pytest.mark.parametrize("error", [DeviceTimeout(**PARTS), SchemaError(**PARTS)])
def test_errors_come_whole_from_worker_processes(error: EvetacError) -> None:
    """Assert that an error that was pickled has its words and parts."""
    back = pickle.loads(pickle.dumps(attach_outcome(error, outcome(Job((), Path("x.h5")), made=True, simulated=True))))
    assert (type(back), str(back), error_dict(back)) == (type(error), str(error), error_dict(error))
    assert attached_outcome(back).rows == attached_outcome(error).rows
    assert str(back).splitlines() == [
        "w: m",
        "  expected: e",
        "  found:    f",
        "  try:      h",
        "  kept:     k",
    ]


def test_what_was_made_is_the_last_line(label_is: Any, files: list[str]) -> None:
    """Assert that the last line of stdout names the files that were made, quoted for a shell; many by their folder."""
    label_is(made)
    assert evetac("label", *files).stdout.splitlines()[-1] == "a.labels.h5 b.labels.h5 c.labels.h5"
    assert evetac("label", files[0], "-o", "two words").stdout.splitlines()[-1] == "'two words/a.labels.h5'"
    Path("d.recording.h5").touch()
    assert evetac("label", *files, "d.recording.h5", "-o", "out").stdout.splitlines()[-1] == "out"
    label_is(skipped)
    assert evetac("label", files[0]).stdout.splitlines()[-1] == "a.labels.h5"


def test_what_people_see_and_its_verdict(monkeypatch: pytest.MonkeyPatch, files: list[str]) -> None:
    """Assert that a stage can choose rows for people, say what they amount to, and warn; -v and --json have more."""
    answer = Outcome([{"a": 1}, {"b": 2, "steps_a_slice": 3}], True, {"count": 2})
    stage = module_of(
        lambda files, chosen, out: [Job(tuple(files), Path("x.report.h5"))],
        lambda *_, **__: answer,
        for_people=lambda rows, chosen: (rows[1:], ["early in 1 of 2"]),
        details=frozenset({"steps_a_slice"}),
        cautions=lambda jobs, chosen: ["few files"],
        warnings=lambda rows: [f"too coarse in {len(rows)}"],
    )
    monkeypatch.setitem(sys.modules, "evetac_cli.evaluate.slip.measure", stage)
    result = evetac("evaluate", "slip", *files)
    assert result.stdout.splitlines()[-2:] == ["count: 2", "early in 1 of 2"]
    assert result.stderr.splitlines()[0] == "note: few files"
    assert result.stderr.splitlines()[-1] == "warning: too coarse in 2"
    assert " a " not in result.stdout and "steps_a_slice" not in result.stdout
    assert "steps_a_slice" in evetac("evaluate", "slip", *files, "-v").stdout
    shown = evetac("evaluate", "slip", *files, "--json", "-q")
    assert (json.loads(shown.stdout)["rows"], shown.stderr) == (answer.rows, "")


def test_quiet(label_is: Any, files: list[str]) -> None:
    """Assert that -q prints nothing but errors."""
    label_is(made)
    result = evetac("label", *files, "-q")
    assert (result.exit_code, result.output) == (0, "")
    label_is(raising(InputError("m")))
    result = evetac("label", files[0], "-q")
    assert (result.exit_code, result.output) == (2, "error: m\n")


def test_out_is_a_folder_or_a_file(label_is: Any, files: list[str]) -> None:
    """Assert that -o takes a folder for many, a file for one, and refuses one file for many before any work."""
    label_is(made)
    assert evetac("label", *files, "-o", "new/folder").exit_code == 0
    assert sorted(os.listdir("new/folder")) == ["a.labels.h5", "b.labels.h5", "c.labels.h5"]
    assert evetac("label", files[0], "-o", "one.h5").exit_code == 0
    assert Path("one.h5").exists()
    Path("z.txt").mkdir()
    assert evetac("label", files[0], "-o", "z.txt").exit_code == 0
    assert evetac("label", files[0], "-o", "run-0.5").exit_code == 0
    assert evetac("label", files[0], "-o", "b.labels.h5", "--force", "--jobs", "8").exit_code == 0


def test_a_folder_stands_for_its_files(label_is: Any, files: list[str]) -> None:
    """Assert that a folder is as good as the files of the right kind in it, and one without any is refused."""
    label_is(made)
    Path("data").mkdir()
    for name in ("b.recording.h5", "a.recording.h5", "a.labels.h5", "notes.txt"):
        (Path("data") / name).write_text(name)
    rows = json.loads(evetac("label", "data", files[2], "--json").stdout)["rows"]
    assert [row["output"] for row in rows] == ["data/a.labels.h5", "data/b.labels.h5", "c.labels.h5"]


REFUSED = {
    "one file for many": ("a.recording.h5 b.recording.h5 -o all.h5", "--out"),
    "another kind of file": ("a.recording.h5 -o z.txt", "--out"),
    "a folder with none": ("above", "above/below"),
    "one output twice": ("a.recording.h5 sub/a.recording.h5 -o out", "out/a.labels.h5"),
    "one input twice": ("a.recording.h5 ./a.recording.h5", "a.labels.h5"),
    "over an input": ("a.recording.h5 -o a.recording.h5 --force", "a.recording.h5"),
    "over an input by its link": ("a.recording.h5 -o link.h5 --force", "link.h5"),
    "over the file of a link": ("link.h5 -o a.recording.h5 --force", "a.recording.h5"),
    "no jobs": ("a.recording.h5 --jobs 0", "--jobs"),
    "jobs that are no number": ("a.recording.h5 --jobs two", "--jobs"),
    "below the range": ("a.recording.h5 --confirm-ms 0", "--confirm-ms"),
    "not finite": ("a.recording.h5 --threshold-px nan", "--threshold-px"),
    "not whole": ("a.recording.h5 --confirm-ms 2.5", "--confirm-ms"),
    "no config": ("a.recording.h5 --config none.toml", "none.toml"),
    "config with an unknown name": ("a.recording.h5 --config c.toml", "did you mean confirm_ms?"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_before_the_stage_runs(label_is: Any, files: list[str], case: str) -> None:
    """Assert that it ends with exit code 2, names the place, and makes and changes nothing."""
    label_is(lambda job, chosen: pytest.fail("ran"))
    Path("sub").mkdir()
    Path("above/below").mkdir(parents=True)
    Path("above/below/a.recording.h5").touch()
    Path("link.h5").symlink_to("a.recording.h5")
    Path("c.toml").write_text("[label]\nconfirm = 9\n")
    before = sorted(Path().rglob("*"))
    words, place = REFUSED[case]
    result = evetac("label", *words.split())
    assert (result.exit_code, result.stdout) == (2, "")
    assert place in plain_text(result.stderr)
    assert sorted(Path().rglob("*")) == before
    assert Path("a.recording.h5").read_text() == "a.recording.h5"


def test_force_never_replaces_a_file_named_by_a_flag(monkeypatch: pytest.MonkeyPatch, files: list[str]) -> None:
    """Assert that a file given by a flag, such as a model, is an input too."""
    stage = module_of(lambda files, chosen, out: [Job((), out)], lambda *_, **__: pytest.fail("ran"))
    monkeypatch.setitem(sys.modules, "evetac_cli.trials.grasp", stage)
    result = evetac("grasp", "--model", "a.recording.h5", "-o", "a.recording.h5", "--force")
    assert result.exit_code == 2
    assert "the output would replace an input" in result.stderr


def parameters(job: Job, chosen: Any) -> Outcome:
    """A stage that shows what it was given."""
    return outcome(job, made=True, simulated=False, **dataclasses.asdict(chosen))


def test_flags_and_config_reach_the_stage(label_is: Any, files: list[str]) -> None:
    """Assert that flags, config file and defaults arrive in the stage, in this order of priority."""
    label_is(parameters)
    Path("c.toml").write_text("[label]\nconfirm_ms = 9\nthreshold_px = 0.25\n")

    def row(*arguments: str) -> dict[str, Any]:
        return dict(json.loads(evetac("label", files[0], "--json", *arguments).stdout)["rows"][0])

    assert row().items() >= dataclasses.asdict(Label()).items()
    assert row("--config", "c.toml").items() >= {"confirm_ms": 9, "threshold_px": 0.25}.items()
    flags = row("--config", "c.toml", "--confirm-ms", "3", "--after-ms", "0")
    assert flags.items() >= {"confirm_ms": 3, "threshold_px": 0.25, "after_ms": 0}.items()


@pytest.mark.parametrize("given", [[], ["--sort"], ["--no-sort"]])
def test_switches_can_be_set_and_unset(monkeypatch: pytest.MonkeyPatch, files: list[str], given: list[str]) -> None:
    """Assert that a switch of a config file can be turned off again by a flag."""
    stage = module_of(
        lambda files, chosen, out: [Job((), Path("x.h5"))], lambda job, chosen, **_: parameters(job, chosen)
    )
    monkeypatch.setitem(sys.modules, "evetac_cli.trials.record", stage)
    Path("c.toml").write_text("[record]\nsort = true\n")
    result = evetac("record", "--config", "c.toml", "--json", *given) if given else evetac("record", "--json")
    (row,) = json.loads(result.stdout, parse_constant=pytest.fail)["rows"] if result.exit_code == 0 else [{}]
    assert row["sort"] is (given == ["--sort"])


WITHOUT_CONSENT = {
    "record, no flag": ["record", "--camera", "virtual:prepared", "--gripper", "PORT"],
    "record, config": ["record", "--config", "c.toml", "--camera", "virtual:prepared", "--gripper", "PORT"],
    "record, config of all": ["record", "--config", "all.toml"],
    "record, replay": ["record", "--camera", "replay:a.h5", "--gripper", "PORT"],
    "grasp, config": ["grasp", "--config", "c.toml", "--camera", "virtual:prepared", "--gripper", "PORT"],
    "grasp, rate and id": ["grasp", "--camera", "dvxplorer", "--gripper", "PORT:5@57600"],
    "doctor, yes": ["doctor", "hardware", "--yes", "--gripper", "PORT"],
}


@pytest.mark.parametrize("case", WITHOUT_CONSENT)
def test_no_byte_goes_to_a_gripper_without_typed_consent(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a real port gets nothing where --arm was not typed, whatever files and the environment say."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    os.set_blocking(ours, False)
    port = os.ttyname(theirs)
    monkeypatch.chdir(tmp_path)
    for name in ("ARM", "EVETAC_ARM", "EVETAC_RECORD_ARM", "RECORD_ARM"):
        monkeypatch.setenv(name, "1")
    Path("c.toml").write_text("[record]\narm = true\n[grasp]\narm = true\n")
    Path("all.toml").write_text(f'[record]\ncamera = "virtual:prepared"\ngripper = "{port}"\narm = true\n')
    result = evetac(*(text.replace("PORT", port) for text in WITHOUT_CONSENT[case]))
    assert result.exit_code == 2
    assert "--arm" in plain_text(result.stderr)
    with pytest.raises(BlockingIOError):
        os.read(ours, 1)
    for end in (ours, theirs):
        os.close(end)


@pytest.fixture
def report(files: list[str]) -> Path:
    """A real report in the present folder."""
    rows = {"command": "evaluate slip", "rows": "[]", "summary": '{"f1": 0.5}'}
    write_stage(Path("a.slip.report.h5"), Recipe("report", 1, {}), rows)
    return Path("a.slip.report.h5")


def test_info_of_files_of_which_some_are_foreign(report: Path, files: list[str]) -> None:
    """Assert that a foreign file hides no other, in words and in JSON, and gives the exit code."""
    given = (files[0], report, files[1])
    result = evetac("info", *given)
    assert result.exit_code == 2
    assert "a.slip.report.h5" in result.stdout
    said = [line.split(": ")[1] for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert sorted(said) == files[:2]
    shown = json.loads(evetac("info", *given, "--json").stdout)
    assert [row["file"] for row in shown["rows"]] == [str(report)]
    assert [shown["error"]["where"], *(error["where"] for error in shown["more_errors"])] == files[:2]
    Path("mixed").mkdir()
    shutil.copy(report, "mixed")
    assert json.loads(evetac("info", "mixed", report, "--json").stdout)["summary"] == {"files": 2}


def test_parts_of_a_job_come_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that with --jobs the parts of all jobs are run before them, and one that fails is its job's error."""
    begun: list[list[str]] = []

    def run_parallel(module: str, jobs: list[Job], *given: Any, quiet: bool) -> None:
        into = given[-1]
        begun.append([job.output.name for job in jobs])
        for job in jobs:
            failed = EvetacError("no memory") if job.output.name == "b-1" else Outcome([], simulated=False)
            into[job.output] = failed

    stage = Stage[Any](
        lambda files, chosen, out: [],
        lambda job, chosen, **_: Outcome([{"alone": job.output.name}], simulated=False),
        parts=lambda job, chosen: [Job((), Path(f"{job.output}-{number}")) for number in range(2)],
    )
    monkeypatch.setattr(execution.workers.importlib, "import_module", lambda name: stage)
    monkeypatch.setattr(execution.workers, "run_parallel", run_parallel)
    jobs = [Job((), tmp_path / name) for name in ("a", "b", "c", "there")]
    (tmp_path / "there").touch()
    running = Running(quiet=True, number_of_jobs=2)

    results: dict[Path, Outcome | EvetacError] = {}
    execution.run_jobs(Command("of parts", object, "", ""), stage, jobs, None, running, results)
    assert begun == [["a-0", "a-1", "b-0", "b-1", "c-0", "c-1"], ["a", "c"]]
    assert isinstance(results[tmp_path / "b"], EvetacError)
    assert set(results) == {job.output for job in jobs}

    begun.clear()
    results.clear()
    execution.run_jobs(Command("of parts", object, "", ""), stage, jobs, None, Running(quiet=True), results)
    assert begun == []
    assert [result.rows[0]["alone"] for result in results.values() if isinstance(result, Outcome)] == [
        "a", "b", "c", "there",
    ]  # fmt: skip
