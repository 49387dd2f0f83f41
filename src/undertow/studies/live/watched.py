"""A run that goes on, for the page: its log is read as it grows, and nothing reaches the run."""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path

from undertow.base import ArtefactError
from undertow.display.live import Message
from undertow.runtime import GrowingLog, Recording
from undertow.studies.live.messages import ReadOnlyShow, described
from undertow.studies.live.recorded import RATE, LoggedRun, of_log

#: Time between two looks at the log, s; how much later pictures are shown than they came about, so
#: that none is missing; and how much of the past who comes later is shown.
LOOK, BEHIND, PAST = 0.04, 0.12, 8.0

#: Decisions that are kept for who comes later.
DECISIONS = 400


class Watched(ReadOnlyShow):
    """A run, shown while it goes on; once it is over, what was recorded of it.

    Parameters
    ----------
    path
        Its log.
    mechanism
        For a run of one's own mechanism in a Python file: which one it is.

    Attributes
    ----------
    over
        Whether the run has ended, and all has been told.

    Raises
    ------
    ArtefactError
        When it is no log of a run, or is of a mechanism that has to be named.
    """

    what, remedy = "run", "Give it another target from a terminal: undertow target"

    def __init__(self, path: Path, mechanism: str | None = None) -> None:
        self._log, self._mechanism, self.over = GrowingLog(path), mechanism, False
        first = self._log.news(most=1)
        self._run = LoggedRun(first, mechanism)
        self._every = max(1, round(1.0 / (RATE * self._run.period)))
        self._frames: deque[Message] = deque(maxlen=math.ceil(PAST * RATE))
        self._plans: deque[Message] = deque([self._run.first], maxlen=DECISIONS)
        self._recording: Message | None = None
        self._wait = 0.0
        self._tell(first)

    def hello(self) -> Message:
        """Return what a new viewer must know: the last seconds, or all of a run that is over."""
        return self._recording or {
            **described(self._run.belief, self._run.scene), "live": True, "watched": True,
            "behind": BEHIND, "speeds": [1.0], "controls": [], "beside": [],
            "frames": [*self._frames],
            "state": {"kind": "state", "mode": "watched", "paused": False, "speed": 1.0},
            "plans": [*self._plans],
        }  # fmt: skip

    def advance(self, seconds: float) -> list[Message]:
        """Look at the log now and then, and return what is new in it."""
        self._wait -= seconds
        if self.over or self._wait > 0.0:
            return []
        self._wait = LOOK
        try:
            if not self._log.over:
                return self._tell(self._log.news(self._every))
            self.over = True
            self._recording = of_log(self._log.path, self._mechanism)
        except (ArtefactError, OSError) as error:  # removed, or just being closed
            self.over = self.over or not self._log.path.exists()
            return [{"kind": "note", "text": str(error)}] if self.over else []
        return [self._recording]

    def _tell(self, news: Recording) -> list[Message]:
        frames, plans = self._run.frames(news.steps), self._run.decisions(news)
        self._frames += frames
        self._plans += plans
        return [*plans, *frames]
