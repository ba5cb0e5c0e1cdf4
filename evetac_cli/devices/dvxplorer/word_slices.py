"""From buffers of event words, as they come from USB, to slices: the part of a camera's driver without the USB."""

from collections.abc import Mapping

from evetac_cli.devices.device_slices import DeviceSlices
from evetac_cli.devices.dvxplorer import event_words
from evetac_cli.events import SLICE_US, Events


class WordSlices(DeviceSlices):
    """Cuts the words of one camera into slices; see DeviceSlices."""

    def __init__(self, patience_us: float) -> None:
        super().__init__(patience_us)
        event_words.step(event_words.start(), bytes(4))  # loads or compiles it before there is a clock to keep
        self._decoder = event_words.start()

    @property
    def counted(self) -> Mapping[str, int]:
        """What was lost so far, by reason."""
        return {**self._decoder.counted, "late_events": self.late_events}

    @property
    def open_events(self) -> int:
        """Events that are known, of slices that are not closed."""
        return self.waiting_events + self._decoder.frame.size

    def push_words(
        self, data: bytes, begun_us: float, ended_us: float, *, emptied: bool, gap: bool = False
    ) -> list[Events]:
        """Take what a read from begun_us to ended_us brought; return the slices that are closed now.

        emptied: whether the read left nothing in the camera; gap: whether earlier bytes were lost on the way.
        """
        if gap:
            event_words.bytes_were_lost(self._decoder)
        before_us = self._decoder.now_us
        events = event_words.step(self._decoder, data, self.device_ms(ended_us))
        closed = []
        if self._decoder.first_ms is not None:
            closed = self.push(events, SLICE_US * self._decoder.first_ms, self._decoder.now_us, ended_us)
        if emptied and self._decoder.now_us == before_us:
            slices = self.over(begun_us)
            closed += self.take(event_words.flush(self._decoder)) + self.close_until(slices)
        return closed
