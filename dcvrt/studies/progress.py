"""What a run says while it works: a bar on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from typing import Any, TextIO


class Silent:
    """Says nothing."""

    def __enter__(self) -> Silent:
        return self

    def __exit__(self, *_: object) -> None: ...

    def say(self, text: str) -> None:
        """A sentence on what comes next."""

    def __call__(self, phase: str, ended: int, total: int, lost: int) -> None:
        """Tasks that have ended, all tasks, tasks without a result."""


class Reporter(Silent):
    """Shows phase, tasks done of all, tasks lost and the time still to go.

    Parameters
    ----------
    stream : where to; standard error when not given.
    every_s : time between plain lines, where there is no terminal.
    """

    def __init__(self, stream: TextIO | None = None, every_s: float = 15.0) -> None:
        self.stream = stream or sys.stderr
        self.every_s = every_s
        self._begin: dict[str, tuple[float, int]] = {}
        self._said = 0.0
        self._bar: Any = None
        self._rows: dict[str, Any] = {}

    def __enter__(self) -> Reporter:
        if self.stream.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[note]}"),
                TimeElapsedColumn(),
                console=Console(file=self.stream),
            )
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def say(self, text: str) -> None:
        """A sentence on what comes next."""
        if self._bar is not None:
            self._bar.console.print(text, highlight=False, markup=False)
        else:
            print(text, file=self.stream, flush=True)

    def __call__(self, phase: str, ended: int, total: int, lost: int) -> None:
        """Tasks that have ended, all tasks, tasks without a result."""
        now = time.monotonic()
        begin, before = self._begin.setdefault(phase, (now, ended))
        left = remaining(now - begin, ended - before, total - ended)
        note = ", ".join(part for part in (left, f"{lost} without result" if lost else "") if part)
        if self._bar is not None:
            if phase not in self._rows:
                self._rows[phase] = self._bar.add_task(phase, total=total, note="")
            self._bar.update(self._rows[phase], completed=ended, total=total, note=note)
        elif ended == total or now - self._said >= self.every_s:
            self._said = now
            print(
                f"{phase}: {ended} of {total} done{', ' + note if note else ''}", file=self.stream, flush=True
            )


def remaining(elapsed: float, done: int, left: int) -> str:
    """How long the rest takes at the pace so far.

    >>> remaining(60.0, 4, 8)
    'about 2 min left'
    >>> remaining(60.0, 0, 8), remaining(60.0, 8, 0)
    ('', '')
    """
    if done == 0 or left == 0:
        return ""
    seconds = elapsed / done * left
    return f"about {seconds / 60:.0f} min left" if seconds >= 90 else f"about {seconds:.0f} s left"
