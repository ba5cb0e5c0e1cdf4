"""The sections of cards on provenance: how to cite, and the versions of evetac and of the file formats.

No author is invented: the authors of the paper are those of CITATION.cff, and those of a data set or model are given by
the person who shares it, or not named.
"""

import re
import shlex
from collections.abc import Collection, Mapping
from pathlib import Path

from evetac_cli import __version__
from evetac_cli.commands.share import Share
from evetac_cli.resources import PACKAGE

# Copied from CITATION.cff, which is not part of an installation.
PAPER = """@article{funk2024evetac,
  title = {{Evetac: An Event-based Optical Tactile Sensor for Robotic Manipulation}},
  author = {Funk, Niklas and Helmut, Erik and Chalvatzaki, Georgia and Calandra, Roberto and Peters, Jan},
  journal = {IEEE Transactions on Robotics},
  year = {2024}
}"""
MOST_LETTERS = 300  # of a name or title
SPECIAL = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
REFERENCE = re.compile(r"[0-9a-f]{40}(?:[0-9a-f]{24})?")


def citation(params: Share, title: str, what: str, year: str | None) -> list[str]:
    """Return the section Citation of a card: the paper on sensor and methods, and the data set or model itself.

    The latter only if authors are given. year: of the newest file, if it is known.
    """
    page = ["## Citation", "The paper on the sensor and the methods:", _block(PAPER)]
    if params.author is None:
        return [*page, f"The authors of this {what} are not named; `evetac share --author` adds an entry."]
    lines = [
        f"@misc{{{slug(title)}{year or ''},",
        f"  title = {{{{{_bibtex(title)}}}}},",
        f"  author = {{{_bibtex(params.author)}}},",
        *([f"  year = {{{year}}},"] if year else []),
        f"  note = {{{what.capitalize()}, made with evetac {__version__}}}",
        "}",
    ]
    return [*page, f"This {what}:", _block("\n".join(lines))]


def made_with(title: str, what: str, versions: Collection[str], formats: Mapping[str, Collection[str]]) -> list[str]:
    """Return the section Version of a card: evetac versions of card and files, format numbers, how to upload."""
    at = commit()
    card_version = f"Card written by evetac {__version__}" + (f" (commit {at})" if at else "")
    file_versions = f", files by evetac {', '.join(sorted(versions))}" if versions else ""
    kinds = ", ".join(f"{kind} {' and '.join(sorted(of))}" for kind, of in sorted(formats.items()))
    listed = f" Format numbers of the files (`schemas/` in evetac): {kinds}." if kinds else ""
    how = f"To upload this folder, run `{upload(Path('.'), title, what)}` in it; replace NAME by your account."
    return ["## Version", f"{card_version}{file_versions}.{listed}", how]


def upload(target: Path, title: str, what: str) -> str:
    """Return the command of the Hub's own tool that uploads a folder; NAME is the account."""
    kind = " --repo-type dataset" if what == "data set" else ""
    return f"hf upload NAME/{slug(title)} {shlex.quote(str(target))}{kind}"


def slug(title: str) -> str:
    """Return a title as a name of lower-case letters, digits and dashes."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")[:60] or "evetac"


def commit() -> str | None:
    """Return the commit of the clone that this program runs from, read from git's files; None without a clone.

    git itself is not run, because PATH might name any program as git.
    """
    root = PACKAGE.parent
    if not (root / "pyproject.toml").is_file():
        return None
    try:
        git = root / ".git"
        if git.is_file():  # a linked work tree
            git = root / git.read_text().removeprefix("gitdir:").strip()
        head = (git / "HEAD").read_text().strip()
        if not head.startswith("ref:"):
            return _reference(head)
        name = head.removeprefix("ref:").strip()
        common = git / (git / "commondir").read_text().strip() if (git / "commondir").is_file() else git
        if (common / name).is_file():
            return _reference((common / name).read_text().strip())
        packed = (line.split() for line in (common / "packed-refs").read_text().splitlines())
        return next((_reference(line[0]) for line in packed if line[1:] == [name]), None)
    except (OSError, UnicodeDecodeError):
        return None


def _reference(text: str) -> str | None:
    return text if REFERENCE.fullmatch(text) else None


def _bibtex(text: str) -> str:
    """Return a text from the command line escaped for BibTeX, on one line."""
    line = "".join(letter if letter.isprintable() else " " for letter in " ".join(text.split())[:MOST_LETTERS])
    return "".join(SPECIAL.get(letter, f"\\{letter}" if letter in "{}$&#%_" else letter) for letter in line)


def _block(text: str) -> str:
    return f"```bibtex\n{text}\n```"
