"""doctor's check of plug-ins: all installed plug-ins with their packages, and why one cannot be used."""

from collections.abc import Callable, Iterator
from typing import Any

from evetac_cli import plugins
from evetac_cli.devices.cameras import NamedCamera
from evetac_cli.devices.grippers import NamedGripper
from evetac_cli.errors import InputError
from evetac_cli.formats import exports, imports
from evetac_cli.kernels.grip.control import PluginLaw
from evetac_cli.kernels.slip.architectures import PluginLayers
from evetac_cli.plugins import Plugin
from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.plan import named_objects, one_sensor

# The function that loads the plug-ins of each group, as a command that uses one does.
LOADED: dict[str, Callable[[Plugin], object]] = {
    plugins.CAMERAS: lambda plugin: plugin.load(NamedCamera),
    plugins.GRIPPERS: lambda plugin: plugin.load(NamedGripper),
    plugins.IMPORTERS: imports.format_of_plugin,
    plugins.EXPORTERS: exports.format_of_plugin,
    plugins.CONTROLLERS: lambda plugin: plugin.load(PluginLaw),
    plugins.NETWORKS: lambda plugin: plugin.load(PluginLayers),
    plugins.SCENES: lambda plugin: scene_file.load(plugin.name),
    plugins.SENSORS: lambda plugin: one_sensor(plugin.name),
    plugins.OBJECTS: lambda plugin: named_objects(plugin.name),
}


def rows() -> Iterator[dict[str, Any]]:
    """Yield a row for every plug-in, grouped by package: device, check, ok, found, expected, fix."""
    every = [plugin for group in LOADED for plugin in plugins.installed(group)]
    for plugin in sorted(every, key=lambda each: each.package):
        fault = why_not(plugin)
        yield {
            "device": f"plug-ins of {plugin.package} {plugin.version}",
            "check": plugin.what,
            "ok": not fault,
            "found": fault or "loads",
            "expected": None,
            "fix": "install a version that fits this evetac, or uninstall it" if fault else None,
        }


def why_not(plugin: Plugin) -> str:
    """Return a text on why a plug-in cannot be used; empty if it can."""
    if fault := plugin.fault():
        return fault
    try:
        with plugins.only_looked_at():
            LOADED[plugin.group](plugin)
    except InputError as error:
        return error.found or error.message
    except Exception as error:  # the plug-in's code may raise anything, and the others must still be checked
        return f"{type(error).__name__}: {error}"
    return ""
