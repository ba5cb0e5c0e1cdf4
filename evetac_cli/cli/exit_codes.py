"""Exit codes: an error is printed as a message on stderr, and with --json also as one object on stdout.

A program that calls `evetac ... --json` can always parse the output: the rows of what was made, and the error. An
unexpected exception passes through all of this unchanged, so that tests see it as raised; only `run` reports it as a
defect.

A result that cannot be written to standard output ends the program; a message that cannot be written does not.
SIGPIPE's usual effect is not used: it would also end a process that lost its gripper, camera or worker, before it could
release the gripper. So only a failed write to standard output ends the program, in the end as SIGPIPE would.
"""

import gc
import io
import os
import select
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

import typer

from evetac_cli import console, interrupts, plugins
from evetac_cli.cli.flags import Group, Running
from evetac_cli.errors import (
    INTERNAL_ERROR,
    INTERRUPTED,
    EvetacError,
    InputError,
    attached_outcome,
    error_dict,
    missing_library,
    shortened,
)
from evetac_cli.jobs import Outcome
from evetac_cli.kernels import kernel_cache
from evetac_cli.names import __version__


class OutputClosed(BaseException):
    """The reader of the standard output is gone. This is not an error, and only the program's end catches it."""


class OutputError(EvetacError):
    """The result could not be written to the standard output (exit code 1)."""


class _Output(io.FileIO):
    """The standard output; after the first error, all bytes are dropped."""

    def write(self, data: Any) -> int:
        """Write some of the bytes; raise OutputClosed or OutputError on failure."""
        try:
            while (written := super().write(data)) is None:  # another process made it non-blocking
                select.select([], [self], [])
            return written
        except BrokenPipeError:
            self._drop_all()
            raise OutputClosed from None
        except OSError as error:
            self._drop_all()
            raise OutputError(f"cannot be written: {error.strerror or error}", where="the output") from None

    def _drop_all(self) -> None:
        """Discard what is still in buffers; otherwise the interpreter would try to write it again when it ends."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.fileno())
        os.close(nowhere)


class _Messages(io.FileIO):
    """The standard error. It never fails: messages that cannot be written are dropped."""

    def write(self, data: Any) -> int:
        """Write some of the bytes, or drop all of them silently."""
        try:
            written = super().write(data)
        except OSError:
            written = None
        return len(memoryview(data).cast("B")) if written is None else written


def open_streams() -> None:
    """Replace sys.stdout and sys.stderr; characters missing in their encoding are written as escapes."""
    # a copy of 1: the file of this number is another one while stdout is kept for JSON (console.stdout_for_json)
    output, messages = _Output(os.dup(1), "w"), _Messages(2, "w", closefd=False)
    sys.stdout = _text(output, sys.stdout, line_buffering=output.isatty())
    sys.stderr = _text(messages, sys.stderr, line_buffering=True)


def _text(raw: io.FileIO, before: Any, *, line_buffering: bool) -> io.TextIOWrapper:
    encoding = getattr(before, "encoding", None) or "utf-8"
    buffered = io.BufferedWriter(raw)
    return io.TextIOWrapper(buffered, encoding, errors="backslashreplace", line_buffering=line_buffering)


def end_as_by_sigpipe() -> NoReturn:
    """End this process like one that wrote to a closed pipe: shells report 141."""
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGPIPE})
    os.kill(os.getpid(), signal.SIGPIPE)
    os._exit(128 + signal.SIGPIPE)


INTERRUPTED_CODE = 130
UsageError: Any = typer.BadParameter.__base__  # not exported by typer; defined in click, or in typer's own copy of it


class Commands(Group):
    """The group of all commands. With --json, a wrong flag is also reported as one JSON object on stdout."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Note whether --json was given, before any flag is read, then read the flags of `evetac` itself."""
        ctx.meta["as_json"] = "--json" in args
        with _outside_a_command(ctx):
            return list(super().parse_args(ctx, args))

    def invoke(self, ctx: Any) -> Any:
        """Find the command, read its flags, call it."""
        with _outside_a_command(ctx):
            return super().invoke(ctx)


@contextmanager
def _outside_a_command(ctx: Any) -> Iterator[None]:
    """Handle wrong flags, and Ctrl-C while flags are read; typer's own message is made safe to print."""
    try:
        yield
    except UsageError as error:
        error.message = console.safe(shortened(error.message))
        if ctx.meta["as_json"]:
            called = error.ctx.command_path if error.ctx else ctx.command_path
            title = called.removeprefix(ctx.command_path).strip()
            console.show_failure(title, [InputError(error.format_message())], [])
        raise
    except KeyboardInterrupt as error:
        if ctx.meta["as_json"]:
            console.show_failure("", [error], [])
        console.say(str(error) or INTERRUPTED)
        raise typer.Exit(INTERRUPTED_CODE) from None


class CommandExit:
    """Context that ends the program with an error message and the exit code of the error's kind; 130 for Ctrl-C.

    With --json the error is also printed on stdout, in one object with the rows of everything that was made.
    """

    def __init__(self, title: str, running: Running) -> None:
        self.title = title
        self.as_json, self.verbose = running.as_json, running.verbose
        self.results: dict[Path, Outcome | EvetacError] = {}  # of the jobs, by output
        self._kept = ExitStack()

    def outcomes(self) -> list[Outcome]:
        """Return the outcomes of the jobs, including those of jobs that failed later (errors.attach_outcome)."""
        outcomes = (
            result if isinstance(result, Outcome) else attached_outcome(result) for result in self.results.values()
        )
        return [outcome for outcome in outcomes if outcome is not None]

    def errors(self) -> list[EvetacError]:
        """Return the errors of the jobs that failed."""
        return [result for result in self.results.values() if isinstance(result, EvetacError)]

    def __enter__(self) -> "CommandExit":
        if self.as_json:
            self._kept.enter_context(console.stdout_for_json())
        try:
            kernel_cache.refuse_settings_in_the_working_folder()
        except InputError as error:
            self.__exit__(InputError, error, None)
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        with self._kept:
            self._end(error)

    def _end(self, error: BaseException | None) -> None:
        error = missing_library(error) or error
        if self.as_json and error is not None and not isinstance(error, (typer.Exit, OutputClosed, OutputError)):
            errors = self.errors()
            is_known = any(error is other for other in errors)
            more = attached_outcome(error) if not is_known else None
            outcomes = self.outcomes() + ([more] if more is not None else [])
            console.show_failure(self.title, errors if is_known else [error, *errors], outcomes)
        if isinstance(error, KeyboardInterrupt):
            console.say(str(error) or INTERRUPTED)
            raise typer.Exit(INTERRUPTED_CODE) from None
        if isinstance(error, (EvetacError, OSError, MemoryError, RecursionError)):
            if self.verbose:
                console.say("".join(traceback.format_exception(error)).rstrip())
            data = error_dict(error)  # an OSError that no stage handled still names its path
            words = f"{data['where']}: {data['message']}" if "where" in data else data["message"]
            console.say(f"error: {error if isinstance(error, EvetacError) else words}")
            raise typer.Exit(data["exit_status"]) from None


def run(program: Callable[[], Any]) -> NoReturn:
    """Run the program and end this process with its exit code; no exception ends as a traceback."""
    open_streams()
    warnings.showwarning = _show_warning
    try:
        code = _exit_code(program)
        sys.stdout.flush()
    except OutputClosed:
        end_as_by_sigpipe()
    except OutputError as error:
        console.say(f"error: {error}")
        code = error.exit_code
    interrupts.stop_catching()  # everything is done and printed: interrupts may now end the process
    if code == INTERRUPTED_CODE and not _children():
        sys.stderr.flush()
        os._exit(code)  # Python takes a second to unload torch, several on a busy computer
    gc.freeze()  # otherwise Python scans all objects once more, although they end with the process
    exec("")  # Python ends by SIGINT if Ctrl-C left the last `exec`, which happens while modules are loaded
    sys.exit(code)


def _children() -> list[Any]:
    """Return the child processes to wait for; none if multiprocessing was not loaded."""
    library = sys.modules.get("multiprocessing.process")
    return list(library.active_children()) if library is not None else []


def _exit_code(program: Callable[[], Any]) -> int:
    try:
        program()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except KeyboardInterrupt as error:
        console.say(str(error) or INTERRUPTED)
        return INTERRUPTED_CODE
    except OutputError:
        raise
    except Exception as error:
        _say_internal_error(error, verbose=not {"-v", "--verbose"}.isdisjoint(sys.argv))
        return 1
    return 0


def _say_internal_error(error: Exception, *, verbose: bool) -> None:
    """Report an unexpected exception, with its traceback in a file or, with `verbose`, on stderr."""
    trace = "".join(traceback.format_exception(error))
    used = " and ".join(f"{package} {version}" for package, version in plugins.used().items())
    whose = f"evetac {__version__}" + (f", or of a plug-in of {used} if the traceback shows it" if used else "")
    console.say(INTERNAL_ERROR)
    console.say(f"  {type(error).__name__}: {shortened(str(error))}")
    console.say(f"  this is a defect of {whose}: please report it with the command and the traceback")
    if verbose:
        console.say(trace.rstrip())
        return
    with suppress(OSError):
        number, name = tempfile.mkstemp(prefix="evetac-internal-error-", suffix=".txt")
        with os.fdopen(number, "w", errors="backslashreplace") as file:
            file.write(trace)
        console.say(f"  traceback: {name}")


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, file: Any = None, line: Any = None
) -> None:
    console.say(warnings.formatwarning(message, category, filename, lineno, line).rstrip())
