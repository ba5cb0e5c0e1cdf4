"""list: the names that flags take, and the keys of files of one's own."""

import pytest

from evetac_cli import names, resources
from evetac_cli.commands.listing import LISTS
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from tests.make import answer_of, evetac


@pytest.mark.parametrize("what", LISTS)
def test_a_list_has_every_name(what: str) -> None:
    """Assert that --json has every name of the table that flags are checked against, and people see each of them."""
    rows = answer_of("list", what)["rows"]
    expected = {
        "scenes": [*names.RECORDED_SCENES, *names.GRASPED_SCENES],
        "objects": list(resources.table("objects")),
        "sensors": list(names.SENSORS),
        "networks": list(ARCHITECTURES),
        "controllers": list(names.CONTROLLERS),
    }
    found = [row["name"] for row in rows]
    if what == "keys":
        assert {"gel.cut", "time.rest_s", "dot_radius_px", "mass_g"} <= set(found)
        assert {row["file"] for row in rows} == {"scene", "sensor", "object"}
    else:
        assert found == expected[what]
    shown = evetac("list", what)
    assert shown.exit_code == 0
    assert all(name in shown.stdout for name in found)
