"""Campaign: many independent tasks, each done once, however often the run is interrupted.

A task is a piece of plain data. Its key is the hash of its canonical text, so the same question asked again
finds the answer that is already in the store. Results are written by the parent process alone, each in one
transaction with the task's new state. A task that raises, runs out of time or keeps killing its worker is set
aside with its message, and the campaign goes on.
"""

from __future__ import annotations

import hashlib
import json
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

from dcvrt.errors import InputError
from dcvrt.studies.store import Store

Payload = Mapping[str, Any]
TaskFunction = Callable[[Payload], Any]

LOST = ("failed", "timeout", "quarantined")
"""States of a task that has no result."""


@dataclass(frozen=True)
class Task:
    """One piece of work: plain data (JSON) that says everything its result depends on."""

    phase: str
    payload: Payload

    @cached_property
    def text(self) -> str:
        """Canonical text: keys sorted, no spaces, numbers as Python writes them."""
        return json.dumps(self.payload, sort_keys=True, separators=(",", ":"), allow_nan=False)

    @cached_property
    def key(self) -> str:
        """Hash of the phase and the canonical text."""
        return hashlib.sha256(f"{self.phase}\n{self.text}".encode()).hexdigest()


@dataclass(frozen=True)
class Outcome:
    """What became of a task. `state` is done, failed, timeout, died or refused."""

    state: str
    result: Any = None
    message: str = ""
    seconds: float = 0.0


class Crew(Protocol):
    """Whoever does the work: gives back (task, outcome) as they come."""

    def run(
        self,
        tasks: Sequence[Task],
        function: TaskFunction,
        timeout_s: float,
        tries: int,
        started: Callable[[Task], int],
    ) -> Iterator[tuple[Task, Outcome]]:
        """Do every task; `started` is called before each start and returns the number of starts so far."""

    def ahead(self, tasks: Sequence[Task], function: TaskFunction) -> None:
        """Name tasks that will be asked for later, so that who is idle may do them before."""


Progress = Callable[[str, int, int, int], None]
"""Called with phase, tasks ended, tasks in all, tasks without a result."""


@dataclass
class Campaign:
    """Does the open tasks of a store and writes what comes back.

    Parameters
    ----------
    store : where tasks and results are kept.
    crew : `InProcess` or `dcvrt.studies.cluster.Cluster`.
    timeout_s : longest time for one task.
    tries : how often a task may take its worker down before it is quarantined.
    """

    store: Store
    crew: Crew
    timeout_s: float = 600.0
    tries: int = 3
    progress: Progress = lambda phase, ended, total, lost: None

    def run(
        self,
        phase: str,
        tasks: Sequence[Task],
        function: TaskFunction,
        record: Callable[[Task, Any], None],
        record_lost: Callable[[Task, str], None],
    ) -> list[str]:
        """Do the tasks of a phase that the store has no result of yet.

        Parameters
        ----------
        phase : what progress and store call it.
        tasks : all tasks of the phase, done or not.
        function : does one task; an importable function, as it is sent to other processes.
        record : writes a result into the store; called inside the transaction that marks the task done.
        record_lost : writes what stands for a task without a result.

        Returns
        -------
        list of str
            The message of each task without a result, one line each.
        """
        by_key = {task.key: task for task in tasks}
        self.store.add_tasks((task.key, phase, task.text) for task in by_key.values())
        states = self.store.task_states(phase)
        lost = {key for key in by_key if states[key][0] in LOST}
        ended = sum(states[key][0] == "done" for key in by_key) + len(lost)
        open_tasks = [task for key, task in by_key.items() if states[key][0] == "open"]
        for task in [task for task in open_tasks if states[task.key][1] >= self.tries]:
            # Started often enough and never ended: it took this very process down each time.
            open_tasks.remove(task)
            self._set_aside(task, "quarantined", _killer(states[task.key][1]), 0.0, record_lost)
            lost.add(task.key)
            ended += 1
        self.progress(phase, ended, len(by_key), len(lost))

        under_way: set[str] = set()

        def started(task: Task) -> int:
            under_way.add(task.key)
            self.store.count_attempt(task.key)
            return self.store.task_states(phase)[task.key][1]

        try:
            for task, outcome in self.crew.run(open_tasks, function, self.timeout_s, self.tries, started):
                under_way.discard(task.key)
                if outcome.state == "done":
                    with self.store.transaction():
                        record(task, outcome.result)
                        self.store.set_task(task.key, "done", seconds=outcome.seconds)
                else:
                    state = "quarantined" if outcome.state == "died" else outcome.state
                    self._set_aside(task, state, outcome.message, outcome.seconds, record_lost)
                    lost.add(task.key)
                ended += 1
                self.progress(phase, ended, len(by_key), len(lost))
        except BaseException:
            for key in under_way:  # interrupted from outside: no task is to blame
                self.store.count_attempt(key, by=-1)
            raise
        frame = self.store.tasks().set_index("hash")
        return [
            f"{phase} task {key[:12]}: {frame.status[key]}: {frame.message[key]}"
            for key in by_key
            if key in lost
        ]

    def ahead(self, phase: str, tasks: Sequence[Task], function: TaskFunction) -> None:
        """Let workers that are idle do tasks that `run` will be called with later; nothing is written before.

        A task that was started before and has not ended waits for its phase.
        """
        states = self.store.task_states(phase)
        self.crew.ahead([t for t in tasks if states.get(t.key, ("open", 0)) == ("open", 0)], function)

    def _set_aside(
        self, task: Task, state: str, message: str, seconds: float, record_lost: Callable[[Task, str], None]
    ) -> None:
        with self.store.transaction():
            record_lost(task, f"{state}: {message}")
            self.store.set_task(task.key, state, message, seconds)


def _killer(deaths: int) -> str:
    return f"its worker died {deaths} times while doing it"


# -- in this process -----------------------------------------------------------------------------------------


class OutOfTime(BaseException):
    """A task took longer than it may. Not an Exception: a task must not catch it by the way."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `OutOfTime` in the block after `seconds`, where the system has interval timers and this is the
    main thread."""
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def ring(*_: object) -> None:
        raise OutOfTime

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def attempt(function: TaskFunction, payload: Payload) -> Outcome:
    """Do one task; an exception becomes an outcome with its message."""
    begin = time.perf_counter()
    try:
        return Outcome("done", function(payload), seconds=time.perf_counter() - begin)
    except Exception as error:  # whatever it is, it belongs to this task alone
        message = " ".join(f"{type(error).__name__}: {error}".split())
        return Outcome("failed", message=message[:500], seconds=time.perf_counter() - begin)


class InProcess:
    """Does the tasks one after the other in this process, and none ahead of its time."""

    def ahead(self, tasks: Sequence[Task], function: TaskFunction) -> None:
        """See `Crew`."""

    def run(
        self,
        tasks: Sequence[Task],
        function: TaskFunction,
        timeout_s: float,
        tries: int,
        started: Callable[[Task], int],
    ) -> Iterator[tuple[Task, Outcome]]:
        """See `Crew`. A task that kills the process is counted when the run is started again."""
        for task in tasks:
            started(task)
            try:
                with time_limit(timeout_s):
                    outcome = attempt(function, task.payload)
            except OutOfTime:
                outcome = Outcome("timeout", message=f"took longer than {timeout_s:g} s", seconds=timeout_s)
            yield task, outcome


def crew_of(workers: int, scheduler: str | None = None) -> Any:
    """The crew for a number of workers or the address of a running dask scheduler, as a context manager.

    Raises
    ------
    InputError
        For fewer than one worker.
    """
    from contextlib import nullcontext

    if workers < 1:
        raise InputError(f"workers = {workers}: needs at least 1.")
    if workers == 1 and scheduler is None:
        return nullcontext(InProcess())
    from dcvrt.studies.cluster import Cluster

    return Cluster(workers, scheduler)
