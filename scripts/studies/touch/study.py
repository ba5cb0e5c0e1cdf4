"""How the tables of touch maps are checked; their scripts compute on one thread, so they are not imported here."""

from scripts.reproduce.experiment import Check, Figure, ScriptCheck, Study
from scripts.reproduce.steps import script

STUDY = Study(
    scripts={
        **{
            name: ScriptCheck(
                (script("studies/touch/contacts.py", "--seeds", "107000-107024", "--out", "tables"),),
                2.0,
                Check(("what",)),
                whole=True,
            )
            for name in ("touch-contacts", "touch-coverage")
        },
        "touch-wrong-injected": ScriptCheck(
            (script("studies/touch/wrong_dots.py", "--seeds", "107700-107703", "--out", "tables"),),
            2.0,
            Check(("wrong", "off_px"), (Figure("found", count="n"),)),
            whole=True,
        ),
    },
)  # fmt: skip
