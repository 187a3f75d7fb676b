"""Work done in a process is the same as done at once; a process that dies costs one answer."""

from __future__ import annotations

import gc
import os
import signal
import time

import numpy as np
import pytest

from pipelines.backend.worker import InlineWorker, ProcessWorker, WorkerDied
from pipelines.errors import DatasetError

WAIT_S = 10.0


@pytest.fixture
def worker():
    worker = ProcessWorker()
    yield worker
    worker.close()


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def ends(pid: int) -> bool:
    deadline = time.monotonic() + 5.0
    while is_running(pid) and time.monotonic() < deadline:
        time.sleep(0.02)
    return not is_running(pid)


def test_both_workers_answer_alike(worker) -> None:
    A = np.random.default_rng(0).normal(size=(40, 40))
    b = A[:, 0] + 1.0
    there = worker.submit(np.linalg.solve, A, b).result(WAIT_S)
    here = InlineWorker().submit(np.linalg.solve, A, b).result(0)
    np.testing.assert_array_equal(there, here)
    assert worker.pid not in (None, os.getpid())
    assert worker.submit(os.getpid).result(WAIT_S) == worker.pid


def test_answers_come_in_the_order_of_questions(worker) -> None:
    answers = [worker.submit(divmod, n, 7) for n in range(50)]
    assert [a.result(WAIT_S) for a in answers] == [divmod(n, 7) for n in range(50)]


def test_what_is_printed_does_not_disturb_the_answers(worker) -> None:
    assert worker.submit(print, "not an answer").result(WAIT_S) is None
    assert worker.submit(abs, -3).result(WAIT_S) == 3


@pytest.mark.parametrize("make", [InlineWorker, ProcessWorker])
def test_an_error_comes_back_as_it_is(make) -> None:
    worker = make()
    try:
        with pytest.raises(ZeroDivisionError):
            worker.submit(divmod, 1, 0).result(WAIT_S)
        with pytest.raises(np.linalg.LinAlgError, match="Singular"):
            worker.submit(np.linalg.inv, np.zeros((2, 2))).result(WAIT_S)
        assert worker.submit(abs, -1).result(WAIT_S) == 1
    finally:
        worker.close()


def test_our_own_errors_pass_too(worker) -> None:
    from pipelines.datasets import open_sequence

    with pytest.raises(DatasetError):
        worker.submit(open_sequence, "/nowhere/at/all").result(WAIT_S)


def test_a_killed_process_costs_its_answer_and_the_next_question_works(worker) -> None:
    assert worker.submit(abs, -1).result(WAIT_S) == 1
    pid = worker.pid
    lost = worker.submit(time.sleep, 60.0)
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(WorkerDied, match="ended before it answered"):
        lost.result(WAIT_S)
    assert worker.submit(abs, -2).result(WAIT_S) == 2
    assert worker.pid != pid


def test_questions_just_after_a_death_are_answered_or_lost_but_never_hang(worker) -> None:
    for _ in range(3):
        worker.submit(abs, -1).result(WAIT_S)
        os.kill(worker.pid, signal.SIGKILL)
        try:
            assert worker.submit(abs, -2).result(WAIT_S) == 2
        except WorkerDied:
            assert worker.submit(abs, -2).result(WAIT_S) == 2


def test_close_ends_the_process(worker) -> None:
    worker.submit(abs, -1).result(WAIT_S)
    pid = worker.pid
    worker.close()
    worker.close()  # once more does no harm
    assert worker.pid is None and ends(pid)


def test_the_process_ends_with_a_worker_that_nobody_closed() -> None:
    worker = ProcessWorker()
    worker.submit(abs, -1).result(WAIT_S)
    pid = worker.pid
    del worker
    gc.collect()
    assert ends(pid)
