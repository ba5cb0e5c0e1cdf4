"""Plug-ins: cameras, formats, controllers and so on that other packages add by entry points, under new names.

Entry points are read only for names that are not evetac's own (names.py), and by `evetac doctor`, which lists them
all: reading them takes longer than the rest of `evetac --help`. So a plug-in cannot replace one of evetac's names. A
plug-in that does not load is refused when it is requested, and affects nothing else.
"""

import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

from evetac_cli import names
from evetac_cli.errors import InputError

T = TypeVar("T")

CAMERAS, GRIPPERS = "evetac.cameras", "evetac.grippers"
IMPORTERS, EXPORTERS = "evetac.importers", "evetac.exporters"
CONTROLLERS, NETWORKS = "evetac.controllers", "evetac.networks"
SCENES, SENSORS, OBJECTS = "evetac.scenes", "evetac.sensors", "evetac.objects"
# Evetac's own names in each group.
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
CLASSES = (CAMERAS, GRIPPERS)  # groups in which a plug-in adds a class; in others it adds an instance
NUMBERED = (CONTROLLERS, NETWORKS)  # groups in which `method` is the version of the computed numbers
NAME = re.compile("[a-z][a-z0-9-]{0,39}")
_used: dict[tuple[str, str], "Plugin"] = {}  # by group and name


class Plugin(NamedTuple):
    """An entry point of a package: its group and name, and its value, `module:attribute`. Processes can send it."""

    group: str
    name: str
    package: str
    version: str
    value: str

    @property
    def what(self) -> str:
        """`camera toy`, for a sentence."""
        return f"{self.group.removeprefix('evetac.').removesuffix('s')} {self.name}"

    @property
    def module(self) -> str:
        """Name of the module that it is in."""
        return self.value.partition(":")[0].strip()

    def fault(self) -> str:
        """Return the reason why its name cannot be used; empty if it can."""
        if self.name in OURS[self.group]:
            return f"{self.name} is one of evetac's own names"
        if not NAME.fullmatch(self.name):
            return "a name has lower-case letters, digits and -, e.g. lab-3"
        others = [each.package for each in installed(self.group) if each.name == self.name and each != self]
        return f"{' and '.join(others)} has one of this name too" if others else ""

    def load(self, wanted: type[T]) -> T:
        """Return the plug-in's object: in CLASSES a subclass of `wanted`, otherwise an instance.

        InputError if it is something else, or if loading fails.
        """
        from importlib import metadata

        if fault := self.fault():
            raise self.error(fault)
        try:
            with redirect_stdout(sys.stderr):  # its output must not mix with a table or JSON
                loaded = metadata.EntryPoint(self.name, self.value, self.group).load()
        except (Exception, SystemExit) as error:  # third-party code may raise anything
            raise self.error(f"{type(error).__name__}: {error}") from error
        self._require(loaded, wanted)
        plugin: T = loaded  # or its class
        return plugin

    def _require(self, loaded: Any, wanted: type) -> None:
        """Raise InputError unless the loaded object is of the right kind for its group."""
        value, kind = self.value, f"{wanted.__module__}.{wanted.__qualname__}"
        is_class = isinstance(loaded, type)
        if not issubclass(loaded if is_class else type(loaded), wanted):
            raise self.error(f"{value} is no {kind}")
        if self.group in CLASSES and not is_class:
            raise self.error(f"{value} is an instance, but a subclass of {kind} is required")
        if self.group not in CLASSES and is_class:
            raise self.error(f"{value} is a class, but an instance of {kind} is required")
        method = getattr(loaded, "method", None)
        if self.group in NUMBERED and (type(method) is not int or method < 1):
            raise self.error(f"{value} has no `method`: set it to 1, and raise it by 1 whenever its numbers change")

    def use(self) -> None:
        """Record that the plug-in is used, so that headers name its package."""
        _used[self.group, self.name] = self

    def error(self, why: str) -> InputError:
        """Return the error that this plug-in cannot be used, with the reason."""
        hint = f"evetac doctor lists all plug-ins; its package is {self.package}"
        return InputError(f"the plug-in {self.what} cannot be used", where=self.package, found=why, hint=hint)


@cache
def installed(group: str) -> tuple[Plugin, ...]:
    """Return all plug-ins of a group, sorted by name, without loading them."""
    from importlib import metadata

    plugins = []
    for entry in metadata.entry_points(group=group):
        package, version = (entry.dist.name, entry.dist.version) if entry.dist is not None else ("?", "?")
        plugins.append(Plugin(group, entry.name, package, version, entry.value))
    return tuple(sorted(plugins, key=lambda each: (each.name, each.package)))


def usable(group: str) -> tuple[str, ...]:
    """Return the names that plug-ins add to a group."""
    return tuple(each.name for each in installed(group) if each.name not in OURS[group])


def by_name(group: str, name: str) -> Plugin | None:
    """Return the plug-in of a name; None if the name is evetac's own or no plug-in has it."""
    if name in OURS[group] or not NAME.fullmatch(name):
        return None
    return next((each for each in installed(group) if each.name == name), None)


def find(group: str, name: str, wanted: type[T]) -> T | None:
    """Load and return the plug-in's object under a name; None if the name is evetac's own or no plug-in has it.

    The plug-in is recorded as used. InputError as for `Plugin.load`.
    """
    plugin = by_name(group, name)
    if plugin is None:
        return None
    adds = plugin.load(wanted)
    plugin.use()
    return adds


def find_file(group: str, name: str) -> Path | None:
    """Return the file NAME.toml in the folder of the module named by a plug-in; None and InputError as for `find`."""
    plugin = by_name(group, name)
    if plugin is None:
        return None
    module = plugin.load(ModuleType)
    file = getattr(module, "__file__", None)
    folder = next(iter(getattr(module, "__path__", None) or ()), None) or (file and Path(file).parent)
    if not folder:
        raise plugin.error(f"{plugin.value} has no folder")
    path = Path(folder) / f"{name}.toml"
    if not path.is_file():
        raise plugin.error(f"no file {path}")
    plugin.use()
    return path


def parts() -> tuple[Plugin, ...]:
    """Return the plug-ins that this process has used so far, for `take_part` in another process."""
    return tuple(_used.values())


def take_part(others: Iterable[Plugin]) -> None:
    """Record these plug-ins as used, because the process that sends the jobs uses them."""
    _used.update({part[:2]: part for part in others})


def used() -> dict[str, str]:
    """Return the packages whose plug-ins have been used so far, with their versions."""
    return {part.package: part.version for part in _used.values()}


@contextmanager
def only_looked_at() -> Iterator[None]:
    """Do not record plug-ins as used that are only looked up within this block."""
    before = dict(_used)
    try:
        yield
    finally:
        _used.clear()
        _used.update(before)


def lacking(wanted: Iterable[Plugin]) -> str:
    """Return the reason why this process cannot use plug-ins that another one uses; empty if it can."""
    for part in wanted:
        here = by_name(part.group, part.name)
        if here is None or here.package != part.package:
            return f"lacks the package {part.package} with the plug-in {part.what}"
        if here.version != part.version:
            return f"has {part.package} {here.version}, but the command has {part.package} {part.version}"
        try:
            here.load(object)
        except InputError as error:
            return f"cannot use the plug-in {part.what} of {part.package}: {error.found}"
    return ""
