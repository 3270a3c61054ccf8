"""Workers through dask.distributed: on this machine, or wherever a scheduler's address leads.

As many tasks are handed out as there are workers, no more: so the time of a task counts from when it is
handed out, and a dying worker takes one task with it. A task whose worker died is done again alone, with
nothing else running beside it, so that no task is blamed for another's death.

Tasks that a later phase will ask for may be named ahead, those named last to be done first. A worker that has
nothing else to do takes them up, one place always left to this process, which searches meanwhile.
"""

from __future__ import annotations

import gc
import logging
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from dcvrt.errors import InputError
from dcvrt.studies.campaign import Outcome, Task, TaskFunction, attempt
from dcvrt.threads import ONE_THREAD


class Cluster:
    """Workers of a dask scheduler.

    Parameters
    ----------
    workers : how many to start on this machine; not used with `scheduler`.
    scheduler : address of a running scheduler, e.g. "tcp://host:8786". Its workers need dcvrt installed.

    Raises
    ------
    InputError
        On entering, when no scheduler answers at the address or it has no workers.
    """

    def __init__(self, workers: int, scheduler: str | None = None) -> None:
        self.workers, self.scheduler = workers, scheduler
        self._client: Any = None
        self._cluster: Any = None
        self._lock = threading.Lock()
        self._later: dict[str, tuple[Task, TaskFunction]] = {}
        self._early: dict[str, tuple[Any, float]] = {}
        self._taken = 1

    def __enter__(self) -> Cluster:
        import dask
        from distributed import Client, LocalCluster

        for name in (
            "distributed",
            "distributed.nanny",
            "distributed.worker",
            "distributed.scheduler",
            "tornado",
        ):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._settings = dask.config.set(
            {
                "distributed.scheduler.allowed-failures": 0,
                "distributed.nanny.pre-spawn-environ": ONE_THREAD,
                "distributed.worker.memory.terminate": False,
            }
        )
        self._main = _without_main_file()
        self._main.__enter__()
        if self.scheduler is None:
            with _interrupts_held_back():
                self._cluster = LocalCluster(
                    n_workers=self.workers,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address=":0",  # any free port: two studies may run side by side
                    silence_logs=logging.CRITICAL,
                )
            self._client = Client(self._cluster)
            return self
        try:
            self._client = Client(self.scheduler, timeout=5)
        except (OSError, ValueError, TimeoutError) as error:
            self.__exit__()
            raise InputError(
                f"no dask scheduler answers at {self.scheduler!r} ({type(error).__name__}). "
                "Way out: start one with 'dask scheduler' and give the address that it prints."
            ) from None
        if not self._client.nthreads():
            self.__exit__()
            raise InputError(
                f"the scheduler at {self.scheduler!r} has no workers. "
                f"Way out: start some with 'dask worker {self.scheduler}'."
            )
        return self

    def __exit__(self, *_: object) -> None:
        self._later.clear()
        with _interrupts_held_back():  # a second Ctrl-C must not leave workers behind
            if self._client is not None:
                self._client.close()
            if self._cluster is not None:
                self._cluster.close(timeout=10)
        self._main.__exit__(None, None, None)
        self._settings.__exit__(None, None, None)

    def run(
        self,
        tasks: Sequence[Task],
        function: TaskFunction,
        timeout_s: float,
        tries: int,
        started: Callable[[Task], int],
    ) -> Iterator[tuple[Task, Outcome]]:
        """See `dcvrt.studies.campaign.Crew`."""
        waiting, suspects = deque[Task](), deque[Task]()
        running: dict[Any, tuple[Task, float, int]] = {}
        for task in tasks:
            with self._lock:
                self._later.pop(task.key, None)
                early = self._early.pop(task.key, None)
            if early is None:
                waiting.append(task)
            else:
                running[early[0]] = (task, early[1], started(task))
        alone = False
        while waiting or suspects or running:
            if not running:
                alone = not waiting
            source = suspects if alone else waiting
            self._taken = self._places()  # none is left for tasks of later phases while some of this one wait
            if alone:
                self._let_end(timeout_s)
            while source and len(running) < (1 if alone else max(1, self._places() - self._under_way())):
                task = source.popleft()
                future = self._submit(task, function)
                running[future] = (task, time.monotonic(), started(task))
            if not source and not alone:
                self._take_up(len(running))
            for future in self._ended(running, timeout_s):
                task, begin, starts = running.pop(future)
                outcome = self._outcome(future, timeout_s, time.monotonic() - begin, starts)
                if outcome.state == "died" and starts < tries:
                    suspects.append(task)
                else:
                    yield task, outcome
        self._take_up(1)

    def ahead(self, tasks: Sequence[Task], function: TaskFunction) -> None:
        """See `Crew`."""
        with self._lock:
            named = {task.key: (task, function) for task in tasks if task.key not in self._early}
            self._later = named | self._later
        self._take_up(1)

    def _take_up(self, taken: int | None = None) -> None:
        """Hand out tasks of later phases while places are free beside those that are `taken`."""
        with self._lock:
            self._taken = self._taken if taken is None else taken
            while self._later and self._under_way() + self._taken < self._places():
                key = next(iter(self._later))
                task, function = self._later.pop(key)
                future = self._submit(task, function)
                self._early[key] = (future, time.monotonic())
                future.add_done_callback(lambda _: self._take_up())

    def _under_way(self) -> int:
        """Tasks of later phases that workers are doing."""
        return sum(not future.done() for future, _ in list(self._early.values()))

    def _let_end(self, timeout_s: float) -> None:
        """Wait for the tasks of later phases that workers are doing."""
        from distributed import wait

        with suppress(TimeoutError):
            wait([future for future, _ in self._early.values()], timeout=timeout_s)

    def _submit(self, task: Task, function: TaskFunction) -> Any:
        return self._client.submit(
            _attempt, function, dict(task.payload), key=f"{task.key}-{time.time_ns()}", pure=False
        )

    def _places(self) -> int:
        """Tasks that can run at once. A worker that is being replaced keeps its place."""
        if self._cluster is not None:
            return self.workers
        return max(1, sum(self._client.nthreads().values()))

    def _ended(self, running: dict[Any, tuple[Task, float, int]], timeout_s: float) -> list[Any]:
        """Wait until something has ended or run out of time."""
        from distributed import wait

        while True:
            try:
                done = list(wait(list(running), timeout=0.5, return_when="FIRST_COMPLETED").done)
            except TimeoutError:
                done = []
            now = time.monotonic()
            late = [f for f, (_, begin, _) in running.items() if now - begin > timeout_s and f not in done]
            if done or late:
                order = list(running)
                return sorted(done + late, key=order.index)

    def _outcome(self, future: Any, timeout_s: float, seconds: float, starts: int) -> Outcome:
        from distributed import KilledWorker

        if future.status == "finished":
            result = future.result()
            assert isinstance(result, Outcome)
            return result
        if future.status == "pending":
            where = [
                address for address, keys in self._client.processing().items() if future.key in map(str, keys)
            ]
            future.cancel(force=True)
            if where:
                self._client.restart_workers(where, timeout=60, raise_for_error=False)
            return Outcome("timeout", message=f"took longer than {timeout_s:g} s", seconds=seconds)
        error = future.exception()
        if isinstance(error, KilledWorker):
            times = "once" if starts == 1 else f"{starts} times"
            return Outcome("died", message=f"its worker died {times} while doing it", seconds=seconds)
        return Outcome("failed", message=f"{type(error).__name__}: {error}"[:500], seconds=seconds)


def _attempt(function: TaskFunction, payload: Mapping[str, Any]) -> Outcome:
    """Do one task. What the first one has loaded stays, and garbage collections leave it out from then on: to
    look through it takes a twentieth of a replay."""
    outcome = attempt(function, payload)
    if not gc.get_freeze_count():
        gc.collect()
        gc.freeze()
    return outcome


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Hold Ctrl-C back until the end of the block; threads and processes started in it never see one.

    Ctrl-C goes to every process of the terminal. It is this one that answers, by closing the workers; if they
    answered too, each would end with a traceback of its own. Threads and processes inherit the mask of the
    thread that starts them: the one that looks after the workers starts later ones without interrupts too.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # its start lifts the mask of the thread that starts it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _without_main_file() -> Iterator[None]:
    """Keep spawned workers from running the user's script again.

    A spawned process imports the file of `__main__`, which is the script that called `Study.run`; without a
    guard in the script that would start the study once more in every worker. Tasks are functions of
    importable modules, so the workers do not need it.
    """
    main = sys.modules["__main__"]
    hidden: dict[str, Any] = {
        name: vars(main)[name] for name in ("__file__", "__spec__") if name in vars(main)
    }
    vars(main).pop("__file__", None)
    main.__spec__ = None
    try:
        yield
    finally:
        vars(main).update(hidden)
