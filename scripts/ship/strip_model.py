"""Reduce trained models to what judging needs, and pack those of a folder into one small archive.

    python scripts/ship/strip_model.py data/paper-recipe/models docs/results/models/paper-recipe

packs models/nothing/*.model.h5 into docs/results/models/paper-recipe/nothing.tar.xz, and so on for each folder.

A stripped model has the chosen checkpoint alone. Recipe id, weights, graph, thresholds, calibration and warnings are
the same, so `evaluate slip` and `grasp` give the same results, bit for bit. Models of one training set share their
tables of hundreds of recordings, which an archive stores once.
"""

import argparse
import io
import sys
import tarfile
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import h5py

from evetac_cli.store.files import StageFile, put_header, replacing
from evetac_cli.store.hdf5.disk import taking_the_place_of
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.ancestry import ANCESTORS, TRAJECTORIES, stored_tables
from evetac_cli.store.layout.provenance import content_digest

# The graphs of all stored checkpoints, as that of the chosen one is `onnx`; and the tables, which the header has too.
LEFT_OUT = ("checkpoint/onnx", TRAJECTORIES, ANCESTORS)
SUFFIXES = (".model.h5", ".force-model.h5")
DIGITS = 16  # hexadecimal digits of a digest that tables show


def arrays_of(path: Path) -> dict[str, Any]:
    """Return the datasets of a model that a stripped one keeps."""
    with StageFile(path, ("model", "force-model")) as file:
        return {name: file.read(name) for name in file.contents() if name not in LEFT_OUT}


def digest(path: Path) -> str:
    """Return the SHA-256 of the kept datasets, equal for a model before and after it is stripped.

    It does not depend on the time and the computer, which are in the header.
    """
    return content_digest(arrays_of(path))


def strip(source: Path, target: Path) -> None:
    """Write the stripped model, uncompressed, since archives compress better; InputError if `source` is no model."""
    arrays = arrays_of(source)
    with StageFile(source) as file:
        header = {**file.header, "version": schema.load(file.kind).version}
    with replacing(target) as h5:
        for name, value in (arrays | stored_tables(header)).items():
            dtype = h5py.string_dtype() if isinstance(value, str) else None
            h5.create_dataset(name, data=value, dtype=dtype, track_times=False)
        put_header(h5, header)


def models_in(folder: Path) -> list[Path]:
    """Return the models in a folder, sorted."""
    return sorted(path for path in folder.iterdir() if path.name.endswith(SUFFIXES)) if folder.is_dir() else []


def pack(models: Iterable[Path], archive: Path) -> None:
    """Strip models and pack them into an archive, whose bytes depend on nothing else."""
    archive.parent.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as folder,
        taking_the_place_of(archive) as temporary,
        tarfile.open(temporary, "w:xz", preset=9) as tar,
    ):
        for model in sorted(models):
            stripped = Path(folder) / model.name
            strip(model, stripped)
            content = stripped.read_bytes()
            entry = tarfile.TarInfo(model.name)
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))


def unpack(archive: Path, folder: Path) -> list[Path]:
    """Write the models of an archive into a folder, except those that it has, and return the paths of all of them."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    with tarfile.open(archive) as tar:
        for entry in tar:
            path = folder / Path(entry.name).name
            content = tar.extractfile(entry)
            if content is not None and not path.exists():
                with taking_the_place_of(path) as temporary:
                    temporary.write_bytes(content.read())
            paths.append(path)
    return paths


def names_in(folder: Path) -> set[str]:
    """Return the names of the models in a folder's archives, ARCHIVE/NAME, as tables name them."""
    names = set()
    for archive in folder.glob("*.tar.xz"):
        with tarfile.open(archive) as tar:
            files = tar.getnames()
        names |= {f"{archive.name.removesuffix('.tar.xz')}/{short_name(name)}" for name in files}
    return names


def short_name(name: str) -> str:
    """Return the name of a model's file without its suffix."""
    return next((name.removesuffix(suffix) for suffix in SUFFIXES if name.endswith(suffix)), name)


def unpack_all(folder: Path) -> None:
    """Put the models of a folder's archives next to these, in a folder per archive, for commands that name them."""
    for archive in sorted(folder.glob("*.tar.xz")):
        unpack(archive, folder / archive.name.removesuffix(".tar.xz"))


def main() -> None:
    """Pack each folder of models given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, help="folder with folders of models, or with models")
    parser.add_argument("out", type=Path, help="folder of the archives")
    chosen = parser.parse_args()
    for folder in (chosen.models, *sorted(path for path in chosen.models.iterdir() if path.is_dir())):
        if models := models_in(folder):
            archive = chosen.out / f"{folder.name}.tar.xz"
            pack(models, archive)
            sys.stdout.write(f"{archive}: {len(models)} models, {archive.stat().st_size / 1e3:.0f} kB\n")


if __name__ == "__main__":
    main()
