"""Run a command of an experiment in its folder; Ctrl-C waits until the command has removed its unfinished files."""

import signal
import subprocess
import sys
from pathlib import Path

from evetac_cli import interrupts
from scripts.reproduce.steps import Command

ROOT = Path(__file__).resolve().parents[2]
INTERRUPTS_TO_KILL = 3  # after this many Ctrl-C, a command that does not end is killed


def run_command(words: Command, folder: Path) -> tuple[int, str]:
    """Run evetac or a script of this folder; progress and messages go straight to the terminal."""
    first, *rest = words
    ours = first == "evetac"
    program = ["-P", "-m", "evetac_cli", *rest] if ours else [str(ROOT / rest[0]), *rest[1:]]
    with interrupts.signals_blocked(interrupts.CTRL_C):
        # Ctrl-C is blocked until evetac handles it, because during Python's start it would end in a traceback. A script
        # does not unblock it, so it inherits an unblocked signal. In both cases the handler of this process waits for
        # the command.
        if not ours:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, interrupts.CTRL_C)
        process = subprocess.Popen([sys.executable, *program], cwd=folder, stdout=subprocess.PIPE, text=True)
        printed = wait_for(process)
    return process.returncode, printed


def wait_for(process: "subprocess.Popen[str]") -> str:
    """Return a command's stdout once it has ended. KeyboardInterrupt, also after that, if Ctrl-C was pressed.

    A terminal sends Ctrl-C to the command too, which needs a moment to remove its unfinished files. subprocess.run
    would kill it after a quarter of a second.
    """
    times = 0
    while True:
        try:
            with interrupts.SignalsLetThrough(interrupts.CTRL_C):
                printed, _ = process.communicate()
            break
        except KeyboardInterrupt:
            times += 1
            if times == INTERRUPTS_TO_KILL:
                process.kill()
    if times:
        raise KeyboardInterrupt
    return printed


def expand(words: Command, folder: Path) -> Command:
    """Replace the globs of a command by the matching files, sorted; those in --flag=GLOB stay."""
    expanded: Command = []
    for word in words:
        is_glob = "*" in word and not word.startswith("--")
        expanded += sorted(str(path.relative_to(folder)) for path in folder.glob(word)) if is_glob else [word]
    return expanded
