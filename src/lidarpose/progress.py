"""Progress of long tasks on stderr: a bar on a terminal, otherwise a line every ten seconds."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType

# seconds between updates of the bar, between lines if stderr is not a terminal, and between lines without progress
BAR_EVERY, LINE_EVERY, SAME_EVERY = 1.0, 10.0, 60.0
_quiet = False


def set_quiet(quiet: bool) -> None:
    """Disables or enables all progress output of this process."""
    global _quiet
    _quiet = quiet


def is_quiet() -> bool:
    return _quiet


class Progress:
    """Shows the progress of a task inside a `with` block. A thread refreshes it between updates.

    Args:
        total: amount of work, None if unknown.
        unit: name of the counted items, in the plural.
        done: amount that was already done, which does not count for the speed. None takes it from the first update,
            and the time before that does not count either.
        label: a name shown before the bar.
        shown: whether anything is shown; False for all but one of several processes.
    """

    def __init__(self, total: int | None, *, unit: str, done: int | None = None, label: str = "", shown: bool = True):
        self.total, self.unit, self.label = total, unit, label
        self.done, self._first = done or 0, done
        self._note = ""
        self._shown = shown and not _quiet and sys.stderr is not None
        self._ended = threading.Event()
        self._started = time.monotonic()
        self._bar = None

    def __enter__(self) -> Progress:
        self._started = time.monotonic()
        if self._shown:
            if sys.stderr.isatty():
                from tqdm import tqdm

                self._bar = tqdm(
                    total=self.total, initial=self.done, unit=f" {self.unit}", desc=self.label or None, smoothing=0.1
                )
            self._thread = threading.Thread(target=self._watch, daemon=True)
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        if self._shown:
            self._thread.join()
        if self._bar is not None:
            self._bar.close()

    def update(self, done: int, note: str = "") -> None:
        """Reports progress. done: total amount done so far; note: a short text shown behind it, such as the loss."""
        self.done, self._note = done, note or self._note
        if self._first is None:
            self._first, self._started = done, time.monotonic()
            if self._bar is not None:
                self._bar.initial = self._bar.n = self._bar.last_print_n = done
        if self._bar is not None:
            self._bar.set_postfix_str(self._note, refresh=False)
            self._bar.update(done - self._bar.n)

    def line(self) -> str:
        """The progress as a line of text."""
        total = "" if self.total is None else f" of {self.total:,}"
        seconds = time.monotonic() - self._started
        rate = (self.done - (self._first or 0)) / max(seconds, 1e-9)
        speed = f", {rate:,.1f}/s" if rate > 0 else ""
        remaining = ""
        if self.total is not None and rate > 0:
            minutes, remaining_seconds = divmod(round(max(self.total - self.done, 0) / rate), 60)
            remaining = f", {minutes // 60}:{minutes % 60:02d}:{remaining_seconds:02d} left"
        name = f"{self.label}: " if self.label else ""
        return f"{name}{self.done:,}{total} {self.unit}{speed}{remaining}{f', {self._note}' if self._note else ''}"

    def _watch(self) -> None:
        last_done, last_time = None, 0.0
        while not self._ended.wait(BAR_EVERY if self._bar is not None else LINE_EVERY):
            if self._bar is not None:
                self._bar.refresh()
            elif self.done != last_done or time.monotonic() - last_time >= SAME_EVERY:
                last_done, last_time = self.done, time.monotonic()
                print(f"lidarpose: {self.line()}", file=sys.stderr, flush=True)
