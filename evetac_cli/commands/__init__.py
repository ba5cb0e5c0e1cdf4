"""The commands: a module each, with its flags, its examples and the name of the stage that it runs.

Why so: nothing of ours but names and errors is imported here, so that `--help` is light, and stages take their
parameters from here; a stage is imported when its command is chosen.
"""

from evetac_cli.commands import (
    attach,
    calibrate,
    doctor,
    evaluate,
    export,
    featurize,
    grasp,
    identify,
    label,
    predict_force,
    record,
    report,
    share,
    track,
    track_rgb,
    train,
    train_force,
    trim,
    view,
)
from evetac_cli.commands.command import Command

PIPELINE = (
    record.COMMAND,
    trim.COMMAND,
    attach.COMMAND,
    calibrate.COMMAND,
    identify.COMMAND,
    label.COMMAND,
    track.COMMAND,
    featurize.COMMAND,
    train.COMMAND,
    track_rgb.COMMAND,
    train_force.COMMAND,
    predict_force.COMMAND,
    grasp.COMMAND,
)
EVALUATE = evaluate.COMMANDS
# For people, made again whenever asked for.
VIEW = view.COMMAND
EXPORT = export.COMMAND
DOCTOR = doctor.COMMAND
SHARE = share.COMMAND
REPORT = report.COMMAND

# A table of a config file for each: [track], [evaluate.slip].
WITH_CONFIG: dict[str, Command] = {command.name: command for command in PIPELINE}
WITH_CONFIG |= {f"evaluate {command.name}": command for command in EVALUATE}
