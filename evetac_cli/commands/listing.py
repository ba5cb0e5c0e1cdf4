"""list: what it lists, its examples, and the module that answers it."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import LOOK, Command, parameter

LISTS = ("scenes", "objects", "sensors", "networks", "controllers", "keys")


@dataclass(frozen=True)
class Listing:
    """List what a flag can name: scenes, objects, sensors, networks or controllers, those of plug-ins included.

    `keys` lists the keys of your own scene, sensor and object files.
    """

    what: str = parameter("scenes", "What to list.", choices=LISTS, flag="WHAT", recipe=False)


COMMAND = Command(
    "list",
    Listing,
    "inspect.listing",
    "",
    unit="",
    examples=("evetac list scenes", "evetac list keys --json"),
    does=LOOK,
)
