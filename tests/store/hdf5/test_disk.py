"""Arrays that lie on disk while they are used: the same as in memory, gone with them, errors in words."""

import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.store.hdf5 import disk


def test_columns_are_put_end_to_end(tmp_path: Path) -> None:
    """Assert that every column is what numpy makes of its parts, also of empty ones, and the folder stays empty."""
    rng = np.random.default_rng(0)
    parts = [(rng.random((rows, 3, 2), np.float32)[:, ::-1], np.arange(rows, dtype=np.int8)) for rows in (4, 0, 7)]
    values, numbers = disk.joined_on_disk(tmp_path, iter(parts))
    np.testing.assert_array_equal(values, np.concatenate([part[0] for part in parts]))
    np.testing.assert_array_equal(numbers, np.concatenate([part[1] for part in parts]))
    assert (values.dtype, numbers.dtype) == (np.float32, np.int8)
    assert not values.flags.writeable
    assert list(tmp_path.iterdir()) == []
    assert disk.joined_on_disk(tmp_path, []) == ()
    (nothing,) = disk.joined_on_disk(tmp_path, [(np.empty((0, 5), np.int64),)])
    assert (nothing.shape, nothing.dtype) == ((0, 5), np.int64)


def test_a_disk_that_does_not_take_them(tmp_path: Path) -> None:
    """Assert that a folder that is not there is said in words."""
    with pytest.raises(InputError, match="cannot be written: No such file"):
        disk.joined_on_disk(tmp_path / "none", [(np.zeros(3),)])


def test_of_runs_at_once_one_puts_its_file_there(tmp_path: Path) -> None:
    """Assert that the others are refused, and that no lock file is left."""
    for number in range(10):
        path, together = tmp_path / f"{number}.txt", threading.Barrier(3)

        def run(name: str, path: Path = path, together: threading.Barrier = together) -> bool:
            try:
                with disk.taking_the_place_of(path, check=partial(disk.check_free, path, force=False)) as unfinished:
                    unfinished.write_text(name)
                    together.wait()
            except InputError as error:
                assert error.message == "the output exists"
                return False
            return True

        with ThreadPoolExecutor(3) as runs:
            assert sorted(runs.map(run, "abc")) == [False, False, True]
        assert path.read_text() in "abc"
    assert len(list(tmp_path.iterdir())) == 10
