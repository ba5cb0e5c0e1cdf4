"""Check of the record that holds the state of a kernel (reason for records: see tracking/tracker.py)."""

import numpy as np
from numpy.typing import NDArray


def check_record(record: NDArray[np.void], state: np.dtype[np.void]) -> None:
    """Raise ValueError unless the record is a writable array of one state, which compiled code changes in place."""
    if record.dtype != state or record.shape != (1,) or not record.flags.writeable:
        raise ValueError(
            f"record: expected a writable array of one STATE, {state.itemsize} bytes, found"
            f" {'a writable' if record.flags.writeable else 'a read-only'} one, {record.shape} of"
            f" {record.dtype.itemsize} bytes"
        )
