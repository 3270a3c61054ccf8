"""Campaigns: nothing is lost, nothing is done twice, one bad task spoils nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cloudpickle
import pytest

from dcvrt.errors import InputError
from dcvrt.studies.campaign import Campaign, InProcess, Task, crew_of
from dcvrt.studies.store import Store

cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers do not have the tests


def square(payload: dict) -> dict:
    return {"n": payload["n"], "value": payload["n"] ** 2, "pid": os.getpid()}


def fragile(payload: dict) -> dict:
    if payload["n"] == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    if payload["n"] == 5:
        raise ValueError("five is not welcome")
    if payload["n"] == 7:
        time.sleep(60)
    return square(payload)


def tasks(count: int) -> list[Task]:
    return [Task("squares", {"n": n}) for n in range(count)]


def run(
    folder: Path, function, count: int, workers: int, **options
) -> tuple[list[str], dict[int, int], list[int]]:
    """Messages of lost tasks, results, tasks whose loss was recorded."""
    results: dict[int, int] = {}
    lost: list[int] = []
    with Store(folder / "study.sqlite", write=True) as store, crew_of(workers) as crew:
        campaign = Campaign(store, crew, **options)
        messages = campaign.run(
            "squares",
            tasks(count),
            function,
            lambda task, r: results.update({r["n"]: r["value"]}),
            lambda task, why: lost.append(task.payload["n"]),
        )
    return messages, results, sorted(lost)


def test_a_task_is_keyed_by_what_it_says_not_by_how() -> None:
    assert Task("a", {"x": 1, "y": [2.5]}).key == Task("a", {"y": [2.5], "x": 1}).key
    assert Task("a", {"x": 1}).key != Task("b", {"x": 1}).key
    assert Task("a", {"x": 1}).text == '{"x":1}'


def test_finished_tasks_are_not_done_again(tmp_path: Path) -> None:
    _, first, _ = run(tmp_path, square, 4, workers=1)
    _, second, _ = run(tmp_path, square, 6, workers=1)
    assert first == {0: 0, 1: 1, 2: 4, 3: 9}
    assert second == {4: 16, 5: 25}


def test_the_answer_does_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    _, one, _ = run(tmp_path / "one", square, 12, workers=1)
    _, two, _ = run(tmp_path / "two", square, 12, workers=2)
    assert one == two == {n: n**2 for n in range(12)}


def test_a_raising_and_a_slow_task_are_set_aside_in_process(tmp_path: Path) -> None:
    def gentle(payload: dict) -> dict:
        return square(payload) if payload["n"] == 3 else fragile(payload)

    messages, results, lost = run(tmp_path, gentle, 9, workers=1, timeout_s=0.3)
    assert lost == [5, 7]
    assert sorted(results) == [0, 1, 2, 3, 4, 6, 8]
    assert [m.split(": ", 1)[1] for m in messages] == [
        "failed: ValueError: five is not welcome",
        "timeout: took longer than 0.3 s",
    ]


def test_a_poison_task_is_quarantined_and_the_others_finish(tmp_path: Path) -> None:
    messages, results, lost = run(tmp_path, fragile, 9, workers=2, timeout_s=8.0, tries=2)
    assert lost == [3, 5, 7]
    assert results == {n: n**2 for n in (0, 1, 2, 4, 6, 8)}
    assert [m.split(": ", 1)[1] for m in messages] == [
        "quarantined: its worker died 2 times while doing it",
        "failed: ValueError: five is not welcome",
        "timeout: took longer than 8 s",
    ]
    again, results, _ = run(tmp_path, fragile, 9, workers=1, timeout_s=8.0, tries=2)
    assert again == messages, "what was set aside stays so, and is reported again"
    assert results == {}


def logged(payload: dict) -> int:
    with open(payload["log"], "a") as log:
        log.write(f"{payload['n']}\n")
    if payload["n"] == payload.get("poison") and payload["n"] == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.05)
    return int(payload["n"])


def wait_for(done) -> None:
    deadline = time.monotonic() + 60
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.parametrize("poison", [None, 1])
def test_idle_workers_do_later_tasks_once_and_leave_one_place(tmp_path: Path, poison: int | None) -> None:
    """While the master searches, the tasks of a later phase are done one at a time; those of the phase that
    runs come before them; a task that kills its worker is set aside in its own phase and no other with it."""
    log = tmp_path / "log.txt"
    log.touch()

    def named(phase: str, numbers: range) -> list[Task]:
        return [Task(phase, {"n": n, "log": str(log), "poison": poison}) for n in numbers]

    later, now = named("later", range(8)), named("now", range(100, 104))
    results: list[int] = []
    lost: list[int] = []
    with Store(tmp_path / "study.sqlite", write=True) as store, crew_of(2) as crew:
        campaign = Campaign(store, crew, timeout_s=30.0, tries=2)
        campaign.ahead("later", later, logged)
        wait_for(lambda: len(log.read_text().split()) >= 3)  # nobody has asked for them yet
        assert not store.task_states("later"), "nothing is written before the phase"
        for phase, wanted in (("now", now), ("later", later)):
            campaign.run(
                phase,
                wanted,
                logged,
                lambda task, n: results.append(n),
                lambda task, why: lost.append(task.payload["n"]),
            )
        states = {key: state for key, (state, _) in store.task_states("later").items()}
        campaign.ahead("later", later, logged)  # nothing is left to do
        time.sleep(0.3)
    assert lost == ([] if poison is None else [1])
    assert sorted([*results, *lost]) == [*range(8), *range(100, 104)]
    assert set(states.values()) == ({"done"} if poison is None else {"done", "quarantined"})
    starts = [int(n) for n in log.read_text().split()]
    assert sorted(set(starts)) == [*range(8), *range(100, 104)]
    again = [n for n in set(starts) if starts.count(n) > 1]
    assert again == ([] if poison is None else [1])


def test_one_process_does_nothing_ahead_of_its_phase(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    log.touch()
    with Store(tmp_path / "study.sqlite", write=True) as store, crew_of(1) as crew:
        Campaign(store, crew).ahead("later", [Task("later", {"n": 0, "log": str(log)})], logged)
        assert not log.read_text()
        assert not store.task_states("later")


SLOW_RUN = """
import sys, time
from pathlib import Path
from dcvrt.studies.campaign import Campaign, Task, crew_of
from dcvrt.studies.store import Store

def work(payload):
    with open(payload["log"], "a") as log:
        log.write(f"{payload['n']}\\n")
    time.sleep(0.15)
    return payload["n"]

with Store(Path(sys.argv[1]) / "study.sqlite", write=True) as store, crew_of(int(sys.argv[2])) as crew:
    def record(task, n):
        store.put("hostings", [dict(name=f"{n:03}", role="sample", subset="", total_mw=n, by_site={})])
    Campaign(store, crew).run("slow", [Task("slow", {"n": n, "log": sys.argv[3]}) for n in range(12)], work,
                              record, lambda task, why: None)
"""


@pytest.mark.parametrize("workers", [1, 2])
def test_a_killed_run_goes_on_where_it_was(tmp_path: Path, workers: int) -> None:
    script = tmp_path / "slow_run.py"
    script.write_text(SLOW_RUN)
    log = tmp_path / "log.txt"
    command = [sys.executable, str(script), str(tmp_path), str(workers), str(log)]
    first = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)})
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and (not log.exists() or len(log.read_text().split()) < 5):
        time.sleep(0.02)
    first.send_signal(signal.SIGKILL)
    first.wait()
    with Store(tmp_path / "study.sqlite") as store:
        assert store.integrity() == "ok"
        done = set(store.hostings().name)
    assert 0 < len(done) < 12, "the kill has to fall into the campaign"
    begun = log.read_text().split()
    subprocess.run(
        command, check=True, timeout=120, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    )
    with Store(tmp_path / "study.sqlite") as store:
        assert list(store.hostings().name) == [f"{n:03}" for n in range(12)]
        assert (store.tasks().status == "done").all()
    repeated = log.read_text().split()[len(begun) :]
    assert not {f"{int(n):03}" for n in repeated} & done, "a finished task was done again"


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="needs signal masks")
def test_an_interrupt_from_the_terminal_ends_a_run_on_workers_without_a_word(tmp_path: Path) -> None:
    """It reaches every process of the terminal; a worker that has replaced a killed one is no exception."""
    script = tmp_path / "slow_run.py"
    script.write_text(
        SLOW_RUN.replace(
            "    time.sleep(0.15)",
            "    if payload['n'] == 1 and open(payload['log']).read().split().count('1') == 1:\n"
            "        import os, signal\n"
            "        os.kill(os.getpid(), signal.SIGKILL)\n"
            "    time.sleep(0.5)",
        )
    )
    log = tmp_path / "log.txt"
    command = [sys.executable, str(script), str(tmp_path), "2", str(log)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.Popen(
        command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and (not log.exists() or len(log.read_text().split()) < 8):
        time.sleep(0.02)
    os.killpg(run.pid, signal.SIGINT)
    _, told = run.communicate(timeout=60)
    assert told.count("Traceback") == 1, "only that of this script"
    assert told.rstrip().endswith("KeyboardInterrupt")
    assert "Worker" not in told
    with Store(tmp_path / "study.sqlite") as store:
        done = set(store.hostings().name)
        assert set(store.tasks().status) == {"done", "open"}
    assert 0 < len(done) < 12
    subprocess.run(command, check=True, timeout=120, env=environment)
    with Store(tmp_path / "study.sqlite") as store:
        assert (store.tasks().status == "done").all()


def test_a_task_that_took_the_whole_process_down_too_often_is_not_started_again(tmp_path: Path) -> None:
    with Store(tmp_path / "study.sqlite", write=True) as store:
        store.add_tasks([(t.key, "squares", t.text) for t in tasks(2)])
        store.count_attempt(tasks(1)[0].key, by=3)
        messages = Campaign(store, InProcess(), tries=3).run(
            "squares", tasks(2), square, lambda *_: None, lambda *_: None
        )
    assert [m.split(": ", 1)[1] for m in messages] == ["quarantined: its worker died 3 times while doing it"]


def test_no_workers_is_refused() -> None:
    with pytest.raises(InputError) as caught:
        crew_of(0)
    assert str(caught.value) == "workers = 0: needs at least 1."


def test_a_scheduler_that_does_not_answer_is_named() -> None:
    with pytest.raises(InputError) as caught, crew_of(2, "tcp://127.0.0.1:9"):
        pass
    assert str(caught.value) == (
        "no dask scheduler answers at 'tcp://127.0.0.1:9' (OSError). "
        "Way out: start one with 'dask scheduler' and give the address that it prints."
    )
