"""Who used the cores, from Linux's counts."""

import os
from pathlib import Path

from evetac_cli.realtime.core_use import LAST_S, CoreUse

TICKS_S = os.sysconf("SC_CLK_TCK")


class Counts:
    """A folder as /proc, of a computer with two cores, a detector (7) and a recorder (8)."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        for process in (7, 8):
            (folder / str(process)).mkdir()
        self.set(0.0, 0.0, 0.0, 0.0)

    def set(self, detector_s: float, recorder_s: float, others_s: float, waited_s: float) -> None:
        """Seconds of cores used so far, and waited for one by the recorder."""
        busy = round((detector_s + recorder_s + others_s) * TICKS_S)
        (self._folder / "stat").write_text(f"cpu  {busy} 0 0 999 77 0 0 0 0 0\ncpu0 1 2 3\n")
        for process, used_s in ((7, detector_s), (8, recorder_s)):
            name = "a (name) with 3 words"
            fields = f"R 1 1 1 0 -1 4194304 99 0 0 0 {round(used_s * TICKS_S)} 0 0 0 20 0 1"
            (self._folder / str(process) / "stat").write_text(f"{process} ({name}) {fields}\n")
            waited_ns = round(1e9 * waited_s) if process == 8 else 0
            (self._folder / str(process) / "schedstat").write_text(f"123456 {waited_ns} 7\n")


def test_who_used_the_cores_and_who_waited(tmp_path: Path) -> None:
    """Assert that shares are those of the last second, or of all, the largest first, without next to nothing."""
    counts = Counts(tmp_path)
    cores = CoreUse({"the detector": 7, "the recorder": 8}, tmp_path, 2)
    assert cores.words() == ""
    cores.sample(100.0)
    assert cores.words() == ""
    for second in range(1, 5):
        counts.set(0.8 * second, 0.1 * second, 0.02 * second, 0.0)
        cores.sample(100.0 + second)
    said = "the detector used 80% of a core, the recorder 10% (2 cores in total)"
    assert cores.words(whole=True) == said
    assert cores.words() == f"in the last {LAST_S:.1f} s {said}"
    counts.set(3.5, 0.4, 1.28, 0.9)
    cores.sample(105.0)
    said = "other programs used 120% of a core, the detector 30% (2 cores in total)"
    said += "; the recorder waited 90% of the time for a core"
    assert cores.words() == f"in the last 1.0 s {said}"


def test_samples_are_not_taken_at_every_call(tmp_path: Path) -> None:
    """Assert that a loop may ask as often as it likes."""
    counts = Counts(tmp_path)
    cores = CoreUse({"the detector": 7}, tmp_path, 2)
    cores.sample(1.0)
    counts.set(1.0, 0.0, 0.0, 0.0)
    cores.sample(1.01)
    assert cores.words() == ""


def test_a_computer_that_does_not_say(tmp_path: Path) -> None:
    """Assert that there are no words where there are no counts, and that a process may end."""
    cores = CoreUse({"the detector": 7}, tmp_path / "no-proc", 2)
    cores.sample(1.0)
    cores.sample(2.0)
    assert cores.words(whole=True) == ""
    counts = Counts(tmp_path)
    cores = CoreUse({"the detector": 7, "the recorder": 8}, tmp_path, 2)
    cores.sample(1.0)
    counts.set(0.5, 0.5, 0.0, 0.0)
    (tmp_path / "7" / "stat").unlink()
    cores.sample(2.0)
    assert "the recorder used 50% of a core" in cores.words()
    assert "detector" not in cores.words()


def test_this_computer() -> None:
    """Assert that the counts of Linux as it runs are understood."""
    cores = CoreUse({"this test": os.getpid()})
    cores.sample(0.0)
    until_s = os.times().user + 0.2
    while os.times().user < until_s:
        pass
    cores.sample(0.25)
    assert "this test" in cores.words()
