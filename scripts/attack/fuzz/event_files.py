"""Write small event files in other programs' formats, to be damaged; dv-processing writes the one with IMU samples."""

from pathlib import Path

import h5py
import numpy as np

from evetac_cli.events import Events

EVENTS = 5000
# Name of each kind: its file, and the family of damage.
FILES = {
    "npz": ("events.npz", "bytes"),
    "npz, packed": ("packed.npz", "bytes"),
    "npy": ("events.npy", "bytes"),
    "npy, structured": ("structured.npy", "bytes"),
    "CSV": ("events.csv", "text"),
    "MVSEC": ("mvsec.h5", "hdf5"),
    "v2e": ("v2e.h5", "hdf5"),
    "rpg": ("rpg.h5", "hdf5"),
    "Prophesee HDF5": ("prophesee.h5", "hdf5"),
    "AEDAT 2": ("jaer.aedat", "bytes"),
    "EVT2.1": ("evt21.raw", "bytes"),
    "AEDAT4 with IMU": ("imu.aedat4", "bytes"),
}


def write(folder: Path, events: Events) -> None:
    """Write the same events, with a frame of 640x480, into a file of every kind."""
    t, x, y, p = (column.astype(np.int64) for column in events)
    table = np.stack([t, x, y, p], axis=1)
    rows = np.zeros(len(t), [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    for name in "txyp":
        rows[name] = getattr(events, name)
    np.savez(folder / "events.npz", **events._asdict(), frames=np.zeros((2, 8, 8), np.uint8))
    np.savez_compressed(folder / "packed.npz", events=np.asfortranarray(table))
    np.save(folder / "events.npy", table[:, [1, 2, 0, 3]].astype(np.float64))
    np.save(folder / "structured.npy", rows)
    lines = "".join(",".join(map(str, row)) + ",note\n" for row in table[:, [1, 2, 3, 0]].tolist())
    (folder / "events.csv").write_text("%geometry:640,480\nx,y,polarity,timestamp,label\n" + lines)
    _hdf5(folder, table, rows)
    _aedat(folder, table)
    _evt21(folder / "evt21.raw", table)
    _with_imu(folder / "imu.aedat4", table[:500])


def _hdf5(folder: Path, table: np.ndarray, rows: np.ndarray) -> None:
    with h5py.File(folder / "mvsec.h5", "w") as file:
        for side in ("left", "right"):
            columns = [table[:, 1], table[:, 2], 1.5e9 + table[:, 0] / 1e6, table[:, 3] * 2 - 1]
            file[f"davis/{side}/events"] = np.stack(columns, axis=1)
            file[f"davis/{side}/imu"] = np.zeros((20, 6))
    with h5py.File(folder / "v2e.h5", "w") as file:
        file.create_dataset("events", data=table.astype(np.uint32), chunks=(1000, 4), compression="gzip")
    with h5py.File(folder / "rpg.h5", "w") as file:
        for name, column in zip("txyp", table.T, strict=True):
            file[f"events/{name}s"] = column / 1e6 if name == "t" else column
    with h5py.File(folder / "prophesee.h5", "w") as file:
        file.create_dataset("CD/events", data=rows, chunks=(1000,), compression="gzip")
        file["CD/indexes"] = np.zeros(3, [("id", "<u8"), ("ts", "<i8")])
        file.attrs["geometry"] = "640x480"


def _aedat(folder: Path, table: np.ndarray) -> None:
    """Write AEDAT 2 of a DAVIS640."""
    words = np.zeros((len(table), 2), ">u4")
    words[:, 0] = (639 - table[:, 1]) << 12 | (479 - table[:, 2]) << 22 | table[:, 3] << 11
    words[:, 1] = table[:, 0]
    head = b"#!AER-DAT2.0\r\n# AEChip: eu.seebetter.ini.chips.davis.DAVIS640\r\n#End Of ASCII Header\r\n"
    (folder / "jaer.aedat").write_bytes(head + words.tobytes())


def _evt21(path: Path, table: np.ndarray) -> None:
    """Write EVT2.1: one event per word, preceded by a time-high word whenever the high bits of time change."""
    words, high = [], -1
    for t, x, y, p in table.tolist():
        if t >> 6 != high:
            high = t >> 6
            words.append(8 << 60 | high << 32)
        words.append(p << 60 | (t & 63) << 54 | x // 32 * 32 << 43 | y << 32 | 1 << x % 32)
    head = b"% format EVT21;height=480;width=640\n% geometry 640x480\n% end\n"
    path.write_bytes(head + np.array(words, "<u8").tobytes())


def _with_imu(path: Path, table: np.ndarray) -> None:
    """Write AEDAT4 with events, IMU samples, triggers and frames."""
    import dv_processing as dv

    config = dv.io.MonoCameraWriter.Config("DAVIS")
    config.addEventStream((640, 480))
    config.addImuStream()
    config.addTriggerStream()
    config.addFrameStream((40, 30))
    writer = dv.io.MonoCameraWriter(str(path), config)
    for first in range(0, len(table), 100):
        events = dv.EventStore()
        for t, x, y, p in table[first : first + 100].tolist():
            events.push_back(t + 1, x, y, bool(p))
        writer.writeEventPacket(events.toPacket())
        t = int(table[first, 0]) + 1
        writer.writeImu(dv.IMU(t, 20.0, *range(9)))
        writer.writeTrigger(dv.Trigger(t, dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE))
        writer.writeFrame(dv.Frame(t, np.full((30, 40), first % 256, np.uint8)))
    del writer
