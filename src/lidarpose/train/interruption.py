"""SIGINT and SIGTERM while training: the run saves its state before it ends."""

import signal
import sys
import threading
from types import FrameType


class Interrupted(KeyboardInterrupt):
    """A run that was told to stop and has saved its state. `status` is the exit status of a shell."""

    def __init__(self, message: str, number: int):
        super().__init__(message)
        self.status = 128 + number


class StopRequest:
    """Notes the first SIGINT or SIGTERM inside its `with` block; a second one stops at once, as without this class.

    Python delivers signals to the main thread alone: in any other thread nothing is noted.
    """

    number: int = 0

    def __enter__(self) -> "StopRequest":
        numbers = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
        self._before = {number: signal.signal(number, self._note) for number in numbers}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.number:
            raise KeyboardInterrupt
        self.number = number
        print("lidarpose: finishing these batches and saving; once more to stop at once", file=sys.stderr)
