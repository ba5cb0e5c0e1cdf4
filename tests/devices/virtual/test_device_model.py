"""The clock of a virtual camera that goes wrong: the same events at other times."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from evetac_cli.devices.dvxplorer import event_words, protocol
from evetac_cli.devices.virtual import device_model
from evetac_cli.devices.virtual.device_model import DeviceModel, shifted
from evetac_cli.devices.virtual.word_sources import PreparedWords, random_event_words
from evetac_cli.events import Events, concatenate

WORDS = random_event_words(50_000, 0.1, np.random.default_rng(0))


def decoded(words: np.ndarray) -> tuple[Events, dict[str, int]]:
    decoder = event_words.start()
    events = concatenate([event_words.step(decoder, words.tobytes()), event_words.flush(decoder)])
    return events, {name: count for name, count in decoder.counted.items() if count}


def test_a_clock_that_jumps() -> None:
    """Assert that a jump moves all later times by as much, and that one below 0 wraps as the camera's counter does."""
    middle = int(np.flatnonzero(WORDS >> 26 == 2)[50])
    ahead = np.concatenate([WORDS[:middle], shifted(WORDS[middle:], 5000)])
    (true, _), (shown, missing) = decoded(WORDS), decoded(ahead)
    assert missing == {"ms_without_time": 5001}
    assert np.unique(shown.t - true.t).tolist() == [0, 5_000_000]
    back = shifted(WORDS, -5000)
    stamps = back[back >> 26 == 2] & ((1 << 22) - 1)
    assert int(stamps[0]) == (1 << 22) - 4999


def test_a_computer_that_stands_still_finds_the_words_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a transfer whose time is over before it looks for words still brings those that there are."""
    source = PreparedWords(WORDS, paced=False)
    model = DeviceModel(source, 10, (), 1 << 20)
    assert model.write(protocol.DVS, protocol.RUN, 1)
    late_s = itertools.count(1000.0, 60.0)  # a minute from one look at the clock to the next
    monkeypatch.setattr(device_model, "time", SimpleNamespace(monotonic=lambda: next(late_s), sleep=lambda s: None))
    data = b""
    while part := model.transfer(65536, 0.005):
        data += part
    assert [word for word in np.frombuffer(data, "<u4") if word] == WORDS.tolist()
