"""Where the back-end's work is done: in a process of its own, or at once in this one.

Owns starting that process, handing it work and taking its answers, and starting it anew when it
dies. Both workers answer the same to the same question, bit for bit.

Deviation: the process is a plain child that reads from a pipe, not one of `multiprocessing`, which
would run a user's script a second time where it has no main guard. All that goes through the pipe
is pickled by this program itself.
"""

from __future__ import annotations

import logging
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, BinaryIO, Protocol

_log = logging.getLogger("dyob.backend")
_ROOT = Path(__file__).resolve().parent.parent.parent
_LENGTH_BYTES = 8
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_CLOSE_S = 2.0  # s, that a process has for ending by itself


class WorkerDied(RuntimeError):
    """The process ended before it answered; the question may be asked again."""


class Worker(Protocol):
    """Does one piece of work after another."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Begin `function(*arguments)`; a function of a module, and arguments that pickle."""

    def close(self) -> None:
        """Stop; answers that are still missing never come."""


class InlineWorker:
    """Does the work at once, in this process."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """The answer is ready on return."""
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future

    def close(self) -> None:
        """Nothing to stop."""


class ProcessWorker:
    """Does the work in a child process, which is started when there is some."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._pending: list[Future[Any]] = []
        self._lock = threading.Lock()

    @property
    def pid(self) -> int | None:
        """Of the child process, None before it is started."""
        return None if self._process is None else self._process.pid

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Answers come in the order of questions; WorkerDied is one if the process ends."""
        future: Future[Any] = Future()
        message = pickle.dumps((function, arguments), protocol=pickle.HIGHEST_PROTOCOL)
        for attempt in range(2):
            process = self._running()
            with self._lock:
                self._pending.append(future)
            try:
                assert process.stdin is not None
                _send(process.stdin, message)
                return future
            except OSError:  # it died between two questions
                with self._lock:
                    if future in self._pending:
                        self._pending.remove(future)
                _log.warning("the back-end's process ended by itself; attempt %d", attempt + 1)
                self._process = None
        future.set_exception(WorkerDied("the back-end's process could not be started"))
        return future

    def close(self) -> None:
        """End the child process."""
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None
        try:
            process.stdin.close()
            process.wait(_CLOSE_S)
        except (OSError, subprocess.TimeoutExpired):
            process.kill()
            process.wait()

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is not None and self._process.poll() is None:
            return self._process
        environment = {**os.environ, **dict.fromkeys(_ONE_THREAD, "1")}
        environment["PYTHONPATH"] = os.pathsep.join(
            [str(_ROOT), *filter(None, [environment.get("PYTHONPATH")])]
        )
        process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            start_new_session=True,  # Ctrl-C is for the run, which then ends this one
        )
        self._process = process
        threading.Thread(target=self._read, args=(process,), daemon=True).start()
        return process

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        """Hand answers to their futures until the process ends."""
        assert process.stdout is not None
        while (message := _receive(process.stdout)) is not None:
            with self._lock:
                future = self._pending.pop(0)
            answer, error = pickle.loads(message)
            if error is None:
                future.set_result(answer)
            else:
                future.set_exception(error)
        with self._lock:
            lost, self._pending = self._pending, []
        for future in lost:
            future.set_exception(WorkerDied("the back-end's process ended before it answered"))


def _send(pipe: BinaryIO, message: bytes) -> None:
    pipe.write(len(message).to_bytes(_LENGTH_BYTES, "little"))
    pipe.write(message)
    pipe.flush()


def _receive(pipe: BinaryIO) -> bytes | None:
    """The next message, None at the end of the pipe."""
    header = pipe.read(_LENGTH_BYTES)
    if len(header) < _LENGTH_BYTES:
        return None
    n = int.from_bytes(header, "little")
    message = pipe.read(n)
    return message if len(message) == n else None


def _serve() -> None:
    """The child: answer questions from the standard input until it ends."""
    questions = sys.stdin.buffer
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what libraries print is no answer
    while (message := _receive(questions)) is not None:
        function, arguments = pickle.loads(message)
        try:
            answer = (function(*arguments), None)
        except Exception as error:
            answer = (None, error)
        _send(answers, pickle.dumps(answer, protocol=pickle.HIGHEST_PROTOCOL))


if __name__ == "__main__":
    _serve()
