"""Build the page of each file kind from schemas/: datasets with dtype, shape, unit and limits, and how to read them.

A test runs the Python snippets on a file of each kind. The MATLAB and Julia snippets are marked as not run.
"""

from collections.abc import Sequence
from typing import NamedTuple

from evetac_cli.store.layout.schema import KINDS, Dataset, Limits, Schema, load
from scripts.docs.page_text import bounds, code, fenced, prose, sentence, table

FOLDER = "files"
MADE_BY = {
    "recording": "[`record`](../commands/record.md) and [`grasp`](../commands/grasp.md)",
    "labels": "[`label`](../commands/label.md)",
    "tracks": "[`track`](../commands/track.md)",
    "features": "[`featurize`](../commands/featurize.md)",
    "model": "[`train`](../commands/train.md)",
    "force-model": "[`train-force`](../commands/train-force.md)",
    "touch": "[`predict-touch`](../commands/predict-touch.md)",
    "report": "[`evaluate`](../commands/index.md#evaluate)",
}


class Snippets(NamedTuple):
    """How to read a file kind: the dataset that all languages read, and the lines that build a pandas table."""

    path: str
    pandas: str


SNIPPETS = {
    "recording": Snippets(
        "events/t",
        """names = ("t_us", "current_ma", "position_ticks")
frame = pandas.DataFrame({name: file[f"gripper/{name}"][:] for name in names}).set_index("t_us")""",
    ),
    "labels": Snippets(
        "label",
        """frame = pandas.DataFrame({name: file[name][:] for name in ("label", "relative_flow_px")})
frame.index.name = "ms" """,
    ),
    "tracks": Snippets(
        "dot_xy_px",
        """frame = pandas.DataFrame(file["events_per_dot"][:]).rename_axis(index="ms", columns="dot")""",
    ),
    "features": Snippets(
        "displacement_px",
        """frame = pandas.DataFrame(file["displacement_px"][:]).rename_axis(index="ms", columns="dot")""",
    ),
    "model": Snippets(
        "threshold",
        """frame = pandas.DataFrame({"loss": file["curve/loss"][:]}, index=file["curve/step"][:])""",
    ),
    "force-model": Snippets(
        "regression/slope_n_px",
        """frame = pandas.DataFrame({name: file[f"curve/{name}_n"][:] for name in ("learned", "held_out")})""",
    ),
    "touch": Snippets(
        "shear_n",
        """frame = pandas.DataFrame({name: file[name][:] for name in ("normal_n", "area_mm2")})
frame.index.name = "ms" """,
    ),
    "report": Snippets("rows", """frame = pandas.DataFrame(json.loads(file["rows"].asstr()[()]))"""),
}


def pages() -> dict[str, str]:
    """Return the text of every page by its path: one page per kind, and the list of all kinds."""
    return {f"{FOLDER}/index.md": _list(), **{f"{FOLDER}/{kind}.md": _page(load(kind)) for kind in KINDS}}


def _list() -> str:
    rows = [(f"[{code(kind)}]({kind}.md)", prose(load(kind).meaning), MADE_BY[kind]) for kind in KINDS]
    return "\n".join(
        (
            "# Files\n",
            "Every file is plain HDF5, compressed with gzip. No HDF5 plugin is needed. File names have the form"
            " `NAME.KIND.h5`.\n",
            table(("kind", "contents", "made by"), rows),
            "Each dataset has the attributes `units` and `long_name`. Its dimensions are named (HDF5 dimension scales),"
            " so xarray, h5netcdf, MATLAB and HDFView can label the axes. The units are `us`, `ms`, `s`, `px`, `N`,"
            " `mA`, `ticks` (of the gripper's encoder, 0.088 degrees each), and `1` for dimensionless values.\n",
            "x runs right from 0 to 639 and y runs down from 0 to 479. Coordinates are always in the order (x, y). The"
            " index of a slice is its time in ms: slice k contains the events with k ms <= t < k + 1 ms. A slice"
            " without events is kept as an empty slice.\n",
            "## Header\n",
            "The root attribute `header` is a JSON object, described by `schemas/header.v1.json`. Its `id` is a SHA-256"
            " hash of the kind, version, method, parameters, seed and the ids of the input files. The same recipe on"
            " the same type of machine produces bit-identical arrays. `simulated` is true if any file in the history"
            " was simulated.\n",
            "```python",
            "import json",
            "",
            "import h5py",
            "",
            'with h5py.File("a.labels.h5") as file:',
            '    header = json.loads(file.attrs["header"])',
            'print(header["kind"], header["method"], header["parameters"], header["simulated"])',
            "```\n",
            "[`evetac info`](../commands/info.md) prints the header and the history of a file.\n",
        )
    )


def _page(schema: Schema) -> str:
    groups: dict[str, list[Dataset]] = {"": []}  # datasets at the root come first
    for row in schema.datasets:
        groups.setdefault(row.path.partition("/")[0] if "/" in row.path else "", []).append(row)
    parts = [
        f"# {schema.kind}\n",
        sentence(prose(schema.meaning)) + f" Made by {MADE_BY[schema.kind]}. Schema version {schema.version}.\n",
        "## Datasets\n",
    ]
    if schema.optional_groups or any(row.optional for row in schema.datasets):
        parts.append(
            "Datasets marked optional may be missing. A group marked optional is either missing or contains all of its"
            " other datasets.\n"
        )
    for name, rows in groups.items():
        if not rows:
            continue
        if len(groups) > 1:
            optional = " (optional)" if name in schema.optional_groups else ""
            parts.append(f"### {name or 'At the root'}{optional}\n")
        heads = ("dataset", "dtype", "shape", "unit", "meaning")
        parts.append(table(heads, [_row(row) for row in rows]))
    parts += ["## Read it\n", _snippets(schema)]
    return "\n".join(parts)


def _row(row: Dataset) -> tuple[str, ...]:
    meaning, limits = sentence(prose(row.meaning)), _limits(row.limits, row.meaning)
    text = " ".join(part for part in (meaning, limits, "*Optional.*" if row.optional else "") if part)
    return code(row.path), "text" if row.dtype == "utf8" else code(row.dtype), _shape(row.dims), row.unit, text


def _shape(dims: Sequence[str | int] | None) -> str:
    if dims is None:
        return "any"
    return " x ".join(str(dim).replace("+", " + ").replace("_", " ") for dim in dims) or "one value"


def _limits(limits: Limits, meaning: str) -> str:
    """Describe the allowed values in words, unless the meaning already does."""
    listed = [bounds(limits.minimum, limits.maximum, limits.above)]
    listed += [f"one of {', '.join(map(str, limits.one_of))}"] if limits.one_of else []
    listed += ["may be NaN"] if limits.finite == "or NaN" else []
    listed += [f"rows of {code(limits.index_of)}"] if limits.index_of else []
    listed += [limits.increasing] if limits.increasing == "never decreasing" else []
    listed += ["strictly increasing"] if limits.increasing == "strictly" else []
    listed = [each for each in listed if each and each not in meaning]
    return sentence("; ".join(listed)) if listed else ""


def _snippets(schema: Schema) -> str:
    kind, (path, pandas_lines) = schema.kind, SNIPPETS[schema.kind]
    row = schema.find(path)
    assert row is not None
    is_text, name = row.dtype == "utf8", path.rpartition("/")[2]
    taken = f'file["{path}"]' + (".asstr()[()]" if is_text else "[:]" if row.dims else "[()]")
    json_line = "import json\n\n" if is_text else ""
    indented = "\n".join(f"    {line.rstrip()}" for line in pandas_lines.splitlines())
    group = path.rpartition("/")[0]
    inner = f'tree["/{group}"]["{name}"]' if group else f'tree["{name}"]'
    return "\n".join(
        (
            '=== "h5py"\n',
            _indented(
                fenced(
                    f'import h5py\n\nwith h5py.File("a.{kind}.h5") as file:\n    {name} = {taken}\n'
                    f'    units = file["{path}"].attrs["units"]',
                    "python",
                )
            ),
            '=== "xarray"\n',
            _indented(
                fenced(
                    f'import xarray\n\nwith xarray.open_datatree("a.{kind}.h5", engine="h5netcdf") as tree:\n'
                    f'    {name} = {inner}.load()\nprint({name}.dims, {name}.attrs["units"])',
                    "python",
                )
            ),
            '=== "pandas"\n',
            _indented(
                fenced(
                    f"{json_line}import h5py\nimport pandas\n\n"
                    f'with h5py.File("a.{kind}.h5") as file:\n{indented}\nprint(frame.describe())',
                    "python",
                )
            ),
            '=== "MATLAB (not run)"\n',
            _indented(
                fenced(
                    f'{name} = h5read("a.{kind}.h5", "/{path}");   % MATLAB reverses the order of dimensions\n'
                    f'header = jsondecode(h5readatt("a.{kind}.h5", "/", "header"));',
                    "matlab",
                )
            ),
            '=== "Julia (not run)"\n',
            _indented(
                fenced(
                    f'using HDF5\n\n{name} = h5read("a.{kind}.h5", "{path}")   # dimensions in the reverse order',
                    "julia",
                )
            ),
        )
    )


def _indented(text: str) -> str:
    return "\n".join(f"    {line}" if line else "" for line in text.splitlines()) + "\n"
