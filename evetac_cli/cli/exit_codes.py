"""Exit codes: an error is printed in words on stderr, and with --json as one object on stdout.

A program that calls `evetac ... --json` can always parse what it gets: the rows of what was made, and the error.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

from evetac_cli import console
from evetac_cli.errors import INTERRUPTED, EvetacError, InputError, attached_outcome, error_dict
from evetac_cli.jobs import Outcome

UsageError: Any = typer.BadParameter.__base__  # which typer does not name; it lies in click, or in typer's own copy


class Commands(TyperGroup):
    """The group of all commands: with --json, a wrong flag too is reported as one JSON object on stdout."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Note whether --json was given before any flag is read, then read the flags of `evetac` itself."""
        ctx.meta["as_json"] = "--json" in args
        with _usage_errors_as_json(ctx):
            return list(super().parse_args(ctx, args))

    def invoke(self, ctx: Any) -> Any:
        """Find the command, read its flags, call it."""
        with _usage_errors_as_json(ctx):
            return super().invoke(ctx)


@contextmanager
def _usage_errors_as_json(ctx: Any) -> Iterator[None]:
    try:
        yield
    except UsageError as error:
        if ctx.meta["as_json"]:
            called = error.ctx.command_path if error.ctx else ctx.command_path
            title = called.removeprefix(ctx.command_path).strip()
            console.show_failure(title, [InputError(error.format_message())], [])
        raise


class CommandExit:
    """End the program with an error in words and the exit code of its kind; Ctrl-C exits 130.

    With --json the error is on stdout too, in one object with the rows of all that was made.
    """

    def __init__(self, title: str, running: dict[str, Any]) -> None:
        self.title = title
        self.as_json, self.verbose = running["as_json"], running["verbose"]
        self.results: dict[Path, Outcome | EvetacError] = {}  # of the jobs, by their outputs

    def outcomes(self) -> list[Outcome]:
        """What the jobs made, including what a job made before it failed (errors.attach_outcome)."""
        outcomes = (
            result if isinstance(result, Outcome) else attached_outcome(result) for result in self.results.values()
        )
        return [outcome for outcome in outcomes if outcome is not None]

    def errors(self) -> list[EvetacError]:
        """The errors of the jobs that failed."""
        return [result for result in self.results.values() if isinstance(result, EvetacError)]

    def __enter__(self) -> "CommandExit":
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if self.as_json and error is not None and not isinstance(error, (typer.Exit, BrokenPipeError)):
            errors = self.errors()
            known = any(error is other for other in errors)
            more = attached_outcome(error) if not known else None
            outcomes = self.outcomes() + ([more] if more is not None else [])
            console.show_failure(self.title, errors if known else [error, *errors], outcomes)
        if isinstance(error, KeyboardInterrupt):
            console.say(str(error) or INTERRUPTED)
            raise typer.Exit(130) from None
        if isinstance(error, (EvetacError, OSError)):
            if self.verbose:
                import traceback

                traceback.print_exception(error)
            data = error_dict(error)  # an OSError that no stage turned into words still names its path
            console.say(f"error: {error if isinstance(error, EvetacError) else '{where}: {message}'.format(**data)}")
            raise typer.Exit(data["exit_status"]) from None
