"""Write events in the layout of the DSEC data set: events/{x,y,t,p}, ms_to_idx, t_offset.

t counts microseconds since t_offset, and ms_to_idx[k] is the first event at k ms or later. The arrays are compressed
with gzip, which every HDF5 tool reads; DSEC's Blosc needs a plugin. t has 32 bits as in DSEC, enough for 71 minutes; a
longer recording gets 64 bits. Units and long names are stored as attributes, which readers of DSEC ignore. Dimension
scales, which evetac's own files have, are left out: they would be datasets that DSEC does not have.
"""

from pathlib import Path

import numpy as np

from evetac_cli.formats.note import NAME
from evetac_cli.formats.write.pieces import note_for, pieces, t_offset_us
from evetac_cli.jobs import Progress
from evetac_cli.store.hdf5.chunks import RowWriter, put
from evetac_cli.store.hdf5.disk import new_file
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.netcdf import describe_dataset
from evetac_cli.store.recordings.read import Recording

TYPES = {"x": np.uint16, "y": np.uint16, "p": np.uint8}
SHORT_MS = 2**32 // 1000


def write(recording: Recording, path: Path, progress: Progress) -> None:
    """Write all columns in pieces."""
    types = {"t": np.uint32 if len(recording) <= SHORT_MS else np.int64, **TYPES}
    with new_file(path) as h5:
        h5.attrs[NAME] = note_for(recording, 0).text()
        count = recording.event_count
        columns = {name: RowWriter(h5, f"events/{name}", type_, (), count) for name, type_ in types.items()}
        for events in pieces(recording, progress):
            for name, column in columns.items():
                column.append(getattr(events, name))
        for column in columns.values():
            column.close()
        put(h5, "ms_to_idx", recording.starts.astype(np.uint64))
        put(h5, "t_offset", np.int64(t_offset_us(recording)))
        table = schema.load("recording")  # a recording stores its events in DSEC's layout
        for name in (*columns, "ms_to_idx", "t_offset"):
            dataset = f"events/{name}" if name in columns else name
            describe_dataset(h5[dataset], table.find(dataset))
