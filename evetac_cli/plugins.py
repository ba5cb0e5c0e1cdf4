"""Plug-ins: cameras, formats, controllers and the like that other packages add by entry points, under new names.

Entry points are read only where a name is none of ours (names.py), and by `evetac doctor`, which lists all of them: it
takes longer than the rest of `evetac --help`. So nothing can take the place of a name of ours. A plug-in that does not
load is refused where it is asked for, and keeps nothing else from working.
"""

import re
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from evetac_cli import names
from evetac_cli.errors import InputError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")

CAMERAS, GRIPPERS = "evetac.cameras", "evetac.grippers"
IMPORTERS, EXPORTERS = "evetac.importers", "evetac.exporters"
CONTROLLERS, NETWORKS = "evetac.controllers", "evetac.networks"
SCENES, SENSORS, OBJECTS = "evetac.scenes", "evetac.sensors", "evetac.objects"
# The names of each group that are ours.
OURS: dict[str, tuple[str, ...]] = {
    CAMERAS: names.without_placeholders(names.CAMERAS),
    GRIPPERS: names.without_placeholders(names.GRIPPERS),
    IMPORTERS: tuple(names.IMPORTS),
    EXPORTERS: tuple(names.EXPORTS),
    CONTROLLERS: names.without_placeholders(names.CONTROLLERS),
    NETWORKS: names.NETWORKS,
    SCENES: (*names.RECORDED_SCENES, *names.GRASPED_SCENES),
    SENSORS: names.SENSORS,
    OBJECTS: (),
}
NAME = re.compile("[a-z][a-z0-9-]{0,39}")
_used: dict[str, str] = {}


class Plugin(NamedTuple):
    """An entry point of a package: what it adds to which group, under which name."""

    group: str
    name: str
    package: str
    version: str
    entry: "EntryPoint"

    @property
    def what(self) -> str:
        """`camera toy`, for a sentence."""
        return f"{self.group.removeprefix('evetac.').removesuffix('s')} {self.name}"

    def fault(self) -> str:
        """Why its name cannot be used, in words; empty if it can."""
        if self.name in OURS[self.group]:
            return f"{self.name} is a name of evetac's own"
        if not NAME.fullmatch(self.name):
            return "a name has small letters, digits and -, as in lab-3"
        others = [each.package for each in installed(self.group) if each.name == self.name and each != self]
        return f"{' and '.join(others)} has one of this name, too" if others else ""

    def load(self, wanted: type[T]) -> T:
        """What it adds, which is of the class `wanted` or a class below it; InputError if it is not, or fails to load.

        Its package is from then on among those that headers name.
        """
        if fault := self.fault():
            raise self.error(fault)
        try:
            loaded = self.entry.load()
        except (Exception, SystemExit) as error:  # code of somebody else's
            raise self.error(f"{type(error).__name__}: {error}") from error
        if not issubclass(loaded if isinstance(loaded, type) else type(loaded), wanted):
            kind = f"{wanted.__module__}.{wanted.__qualname__}"
            raise self.error(f"{self.entry.value} is no {kind}")
        _used[self.package] = self.version
        plugin: T = loaded  # or its class
        return plugin

    def error(self, why: str) -> InputError:
        """That this plug-in cannot be used, and why."""
        hint = f"evetac doctor lists all plug-ins; its package is {self.package}"
        return InputError(f"the plug-in {self.what} cannot be used", where=self.package, found=why, hint=hint)


@cache
def installed(group: str) -> tuple[Plugin, ...]:
    """All plug-ins of a group, by name; none of them is loaded."""
    from importlib import metadata

    plugins = []
    for entry in metadata.entry_points(group=group):
        package, version = (entry.dist.name, entry.dist.version) if entry.dist is not None else ("?", "?")
        plugins.append(Plugin(group, entry.name, package, version, entry))
    return tuple(sorted(plugins, key=lambda each: (each.name, each.package)))


def usable(group: str) -> tuple[str, ...]:
    """The names that plug-ins add to a group."""
    return tuple(each.name for each in installed(group) if each.name not in OURS[group])


def named(group: str, name: str) -> Plugin | None:
    """The plug-in of a name; None where the name is ours, or no plug-in has it."""
    if name in OURS[group] or not NAME.fullmatch(name):
        return None
    return next((each for each in installed(group) if each.name == name), None)


def find(group: str, name: str, wanted: type[T]) -> T | None:
    """What a plug-in adds under a name, as `load`; None where the name is ours, or no plug-in has it."""
    plugin = named(group, name)
    return None if plugin is None else plugin.load(wanted)


def find_file(group: str, name: str) -> Path | None:
    """The file NAME.toml in the folder of the module that a plug-in names; None and InputError as `find`."""
    plugin = named(group, name)
    if plugin is None:
        return None
    module = plugin.load(ModuleType)
    folder = next(iter(getattr(module, "__path__", ())), None) or Path(str(module.__file__)).parent
    path = Path(folder) / f"{name}.toml"
    if not path.is_file():
        raise plugin.error(f"no file {path}")
    return path


def used() -> dict[str, str]:
    """The packages whose plug-ins were loaded so far, and their versions."""
    return dict(_used)
