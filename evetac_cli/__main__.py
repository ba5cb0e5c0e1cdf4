"""The command `evetac`, and `python -m evetac_cli`.

Loading the commands takes half a second, in which Ctrl-C would end in a traceback. So signals are looked after first.
"""

import gc
import os
import signal
import sys
from typing import NoReturn

from evetac_cli import interrupts

# New objects after which Python looks for garbage; its own 700 make it look a hundred times while modules are loaded,
# which hold on to all that they make: a seventh of a command's time.
GARBAGE_AFTER = 10_000


def main() -> None:
    """Load the commands and run the one that was asked for."""
    gc.set_threshold(GARBAGE_AFTER)
    try:
        interrupts.catch_interrupts()
        # Whoever started this may have held it back till now.
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        from evetac_cli.cli.main import main as run

        if interrupts.interrupt_came():  # an import may swallow what a signal raises
            _end()
    except KeyboardInterrupt:
        _end()
    run()


def _end() -> NoReturn:
    """Nothing was begun: say so, and leave at once."""
    from evetac_cli import console

    error = KeyboardInterrupt("interrupted: nothing was begun")
    console.say(str(error))
    if "--json" in sys.argv:
        console.show_failure("", [error], [])
        sys.stdout.flush()
    os._exit(130)


if __name__ == "__main__":
    main()
