"""Plug-ins: cameras, formats, controllers and the like that other packages add by entry points, under new names.

Entry points are read only where a name is none of ours (names.py), and by `evetac doctor`, which lists all of them: it
takes longer than the rest of `evetac --help`. So nothing can take the place of a name of ours. A plug-in that does not
load is refused where it is asked for, and keeps nothing else from working.
"""

import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

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
CLASSES = (CAMERAS, GRIPPERS)  # where a plug-in adds a class; elsewhere it adds an instance
NUMBERED = (CONTROLLERS, NETWORKS)  # where it says by `method` when its numbers change
NAME = re.compile("[a-z][a-z0-9-]{0,39}")
_used: dict[tuple[str, str], "Part"] = {}  # by group and name


class Part(NamedTuple):
    """A plug-in that has a part in what is made, as other processes are told of it; module: of its entry point."""

    group: str
    name: str
    package: str
    version: str
    module: str

    @property
    def what(self) -> str:
        """`camera toy`, for a sentence."""
        return _what(self.group, self.name)


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
        return _what(self.group, self.name)

    @property
    def part(self) -> Part:
        """The same for other processes."""
        return Part(self.group, self.name, self.package, self.version, self.entry.module)

    def fault(self) -> str:
        """Why its name cannot be used, in words; empty if it can."""
        if self.name in OURS[self.group]:
            return f"{self.name} is a name of evetac's own"
        if not NAME.fullmatch(self.name):
            return "a name has small letters, digits and -, as in lab-3"
        others = [each.package for each in installed(self.group) if each.name == self.name and each != self]
        return f"{' and '.join(others)} has one of this name, too" if others else ""

    def load(self, wanted: type[T]) -> T:
        """What it adds: in CLASSES a class below `wanted`, else an instance; InputError where it is not, or fails."""
        if fault := self.fault():
            raise self.error(fault)
        try:
            with redirect_stdout(sys.stderr):  # what it prints is no part of a table or of JSON
                loaded = self.entry.load()
        except (Exception, SystemExit) as error:  # code of somebody else's
            raise self.error(f"{type(error).__name__}: {error}") from error
        self._require(loaded, wanted)
        plugin: T = loaded  # or its class
        return plugin

    def _require(self, loaded: Any, wanted: type) -> None:
        """InputError unless it is what its group adds."""
        value, kind = self.entry.value, f"{wanted.__module__}.{wanted.__qualname__}"
        is_class = isinstance(loaded, type)
        if not issubclass(loaded if is_class else type(loaded), wanted):
            raise self.error(f"{value} is no {kind}")
        if self.group in CLASSES and not is_class:
            raise self.error(f"{value} is an instance, and a class below {kind} is wanted")
        if self.group not in CLASSES and is_class:
            raise self.error(f"{value} is a class, and an instance of {kind} is wanted")
        method = getattr(loaded, "method", None)
        if self.group in NUMBERED and (type(method) is not int or method < 1):
            raise self.error(f"{value} has no `method`: 1, and one more whenever its numbers change")

    def use(self) -> None:
        """From now on it has a part in what is made: headers name its package."""
        _used[self.group, self.name] = self.part

    def error(self, why: str) -> InputError:
        """That this plug-in cannot be used, and why."""
        hint = f"evetac doctor lists all plug-ins; its package is {self.package}"
        return InputError(f"the plug-in {self.what} cannot be used", where=self.package, found=why, hint=hint)


def _what(group: str, name: str) -> str:
    return f"{group.removeprefix('evetac.').removesuffix('s')} {name}"


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
    """What a plug-in adds under a name, as `load`; None where the name is ours, or no plug-in has it.

    It has a part in what is made from now on.
    """
    plugin = named(group, name)
    if plugin is None:
        return None
    adds = plugin.load(wanted)
    plugin.use()
    return adds


def find_file(group: str, name: str) -> Path | None:
    """The file NAME.toml in the folder of the module that a plug-in names; None and InputError as `find`."""
    plugin = named(group, name)
    if plugin is None:
        return None
    module = plugin.load(ModuleType)
    file = getattr(module, "__file__", None)
    folder = next(iter(getattr(module, "__path__", None) or ()), None) or (file and Path(file).parent)
    if not folder:
        raise plugin.error(f"{plugin.entry.value} has no folder")
    path = Path(folder) / f"{name}.toml"
    if not path.is_file():
        raise plugin.error(f"no file {path}")
    plugin.use()
    return path


def parts() -> tuple[Part, ...]:
    """The plug-ins that had a part so far in what this process makes, for `take_part` in another one."""
    return tuple(_used.values())


def take_part(others: Iterable[Part]) -> None:
    """These have a part in what this process makes, since another one that uses them gives it its work."""
    _used.update({part[:2]: part for part in others})


def used() -> dict[str, str]:
    """The packages whose plug-ins had a part so far, and their versions."""
    return {part.package: part.version for part in _used.values()}


@contextmanager
def only_looked_at() -> Iterator[None]:
    """Plug-ins that are found in this block have no part in what is made."""
    before = dict(_used)
    try:
        yield
    finally:
        _used.clear()
        _used.update(before)


def lacking(wanted: Iterable[Part]) -> str:
    """Why this process cannot use plug-ins that another one uses, in words; empty if it can."""
    for part in wanted:
        here = named(part.group, part.name)
        if here is None or here.package != part.package:
            return f"has no package {part.package}, of which is the plug-in {part.what}"
        if here.version != part.version:
            return f"has {part.package} {here.version}, and this is {part.package} {part.version}"
        try:
            here.load(object)
        except InputError as error:
            return f"cannot use the plug-in {part.what} of {part.package}: {error.found}"
    return ""


def culprits(error: BaseException) -> tuple[Part, ...]:
    """The plug-ins in whose code an error was raised, or passed through; those of one package, none where it was ours.

    Where the code is of no module that an entry point names, they are all of its package that have a part.
    """
    noted: tuple[Part, ...] = getattr(error, "evetac_plugins", ())
    if noted:
        return noted
    modules: list[str] = []  # the innermost first
    at = error.__traceback__
    while at is not None:
        modules.insert(0, str(at.tb_frame.f_globals.get("__name__", "")))
        at = at.tb_next
    for depth in (None, 1):  # the module itself, then its whole package
        for module in modules:
            found = tuple(part for part in parts() if part.module.split(".")[:depth] == module.split(".")[:depth])
            if found and not module.startswith("evetac_cli."):
                return found
    return ()


def note_culprits(error: BaseException) -> None:
    """Make the error say on its way to another process, which it reaches without a traceback, whose it is."""
    if found := culprits(error):
        error.evetac_plugins = found  # type: ignore[attr-defined]
