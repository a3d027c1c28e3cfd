"""One progress bar on stderr, with an ETA; if stderr is not a terminal, a line every `LINE_EVERY` seconds instead."""

from __future__ import annotations

import sys
import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

LINE_EVERY = 30.0  # seconds between lines in a log


class Bar:
    """`with Bar() as bar: bar.update(stage, done, total)`."""

    def __enter__(self) -> Bar:
        self._task = None
        self._terminal = sys.stderr.isatty()
        self._said = self._started = time.monotonic()
        self._rich = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("ETA"),
            TimeRemainingColumn(),
            console=Console(stderr=True, markup=False, emoji=False),  # prints names as they are
            disable=not self._terminal,
        )
        self._rich.start()
        return self

    def __exit__(self, *_) -> None:
        self._rich.stop()

    def update(self, stage: str, done: int, total: int) -> None:
        """Shows `done` of `total` in `stage`; cheap enough to call at every step."""
        if self._terminal:
            if self._task is None:
                self._task = self._rich.add_task(stage, total=total)
            self._rich.update(self._task, description=stage, completed=done, total=total)
            return
        now = time.monotonic()
        if now - self._said >= LINE_EVERY:
            self._said = now
            left = (now - self._started) * (total - done) / max(done, 1)
            print(f"{stage}: {done}/{total}, about {left:.0f} s left", file=sys.stderr, flush=True)

    def say(self, message: str) -> None:
        """Prints a line above the bar."""
        if self._terminal:
            self._rich.console.print(message)
        else:
            print(message, file=sys.stderr, flush=True)
