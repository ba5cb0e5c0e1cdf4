"""The file of the sticking share's network: the package's, and files that are none."""

import json
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.resources import STICKING_MODEL
from evetac_cli.stages.touch import touch_fold


def test_the_package_s_network_says_what_it_saw() -> None:
    """Assert that the package's network is one, and that its card names what it never saw, and seeds below 10,000."""
    assert touch_fold.shipped_network() is touch_fold.shipped_network()
    card = json.loads(STICKING_MODEL.with_suffix(".json").read_text())
    trained, never = card["training"], card["never_trained_on"]
    assert not set(trained["objects"]) & set(never["objects"]) and not set(trained["motions"]) & set(never["motions"])
    assert max(*trained["trial_seeds"], *card["deviations"]["trial_seeds"]) < 10_000
    network = touch_fold.shipped_network()
    weights = sum(array.size for array in network) - len(network.share_sd)
    assert card["parameters"] == weights


def test_other_files_are_refused(tmp_path: Path) -> None:
    """Assert InputError with the reason for arrays that miss, a broken file, a lone array, an object and no file."""
    arrays = touch_fold.shipped_network()._asdict()
    np.savez(tmp_path / "less.npz", **{name: array for name, array in arrays.items() if name != "third"})
    np.savez(tmp_path / "object.npz", **{**arrays, "first": np.array([{}], object)})
    np.save(tmp_path / "lone.npy", np.zeros(3))
    (tmp_path / "broken.npz").write_bytes(STICKING_MODEL.read_bytes()[:1000])
    (tmp_path / "empty.npz").write_bytes(b"")
    for name, why in (("less.npz", "third"), ("object.npz", "allow_pickle"), ("lone.npy", ""), ("broken.npz", "")):
        with pytest.raises(InputError, match=f"(?s)not a sticking-share network.*{why}"):
            touch_fold.read_network(tmp_path / name)
    for name in ("empty.npz", "none.npz"):
        with pytest.raises(InputError, match="not a sticking-share network"):
            touch_fold.read_network(tmp_path / name)
