"""Check CITATION.cff against the schema of the Citation File Format 1.2.0; exits with 1 and says what is wrong.

The schema beside this file is that of the format's authors, https://github.com/citation-file-format, CC-BY-4.0.
"""

import json
import sys
from pathlib import Path

import yaml
from jsonschema import Draft7Validator

HERE = Path(__file__).parent


def faults(citation: str) -> list[str]:
    """Return what the schema objects to in a citation file's text, with the place of each."""
    schema = json.loads((HERE / "cff-1.2.0.schema.json").read_text("utf-8"))
    content = yaml.load(citation, yaml.BaseLoader)  # a date stays the text that is written
    found = sorted(Draft7Validator(schema).iter_errors(content), key=lambda fault: str(fault.json_path))
    return [f"CITATION.cff, {fault.json_path}: {fault.message}" for fault in found]


if __name__ == "__main__":
    sys.exit("\n".join(faults((HERE.parents[1] / "CITATION.cff").read_text("utf-8"))) or None)
