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
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Protocol

_log = logging.getLogger("dyob.backend")
_ROOT = Path(__file__).resolve().parent.parent.parent
_LENGTH_BYTES = 8
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_CLOSE_S = 2.0  # s, that a process has for ending by itself


class WorkerDied(RuntimeError):  # noqa: N818
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


class _Child:
    """One child process, and the futures of the questions that it has not answered."""

    def __init__(self) -> None:
        environment = {**os.environ, **dict.fromkeys(_ONE_THREAD, "1")}
        environment["PYTHONPATH"] = os.pathsep.join(
            [str(_ROOT), *filter(None, [environment.get("PYTHONPATH")])]
        )
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__],  # nothing from the working folder
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            start_new_session=True,  # Ctrl-C is for the run, which then ends this one
        )
        self.answers = True  # until its pipe ends, which may be before it counts as ended
        self._pending: list[Future[Any]] = []
        self._lock = threading.Lock()
        threading.Thread(target=self._read, name="back-end", daemon=True).start()

    def ask(self, message: bytes) -> Future[Any]:
        """Hand over a question. Raises OSError where the process is no more."""
        assert self.process.stdin is not None
        future: Future[Any] = Future()
        with self._lock:
            if not self.answers:
                raise BrokenPipeError("it has ended")
            self._pending.append(future)
        _send(self.process.stdin, message)
        return future

    def end(self) -> None:
        """Let it end by itself, else make it."""
        assert self.process.stdin is not None
        with suppress(OSError):  # what could not be flushed is lost
            self.process.stdin.close()
        try:
            self.process.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def _read(self) -> None:
        """Hand answers to their futures until the process ends."""
        assert self.process.stdout is not None
        while (message := _receive(self.process.stdout)) is not None:
            try:
                answer, error = pickle.loads(message)
            except Exception as reason:  # an error that pickles, but cannot be made again
                answer, error = None, RuntimeError(f"an answer cannot be read: {reason!r}")
            with self._lock:
                future = self._pending.pop(0)
            if error is None:
                future.set_result(answer)
            else:
                future.set_exception(error)
        with self._lock:
            self.answers = False
            lost, self._pending = self._pending, []
        for future in lost:
            future.set_exception(WorkerDied("the back-end's process ended before it answered"))
        self.process.stdout.close()


class ProcessWorker:
    """Does the work in a child process, which is started when there is some.

    It ends with `close`, or when nobody knows of this worker any longer.
    """

    def __init__(self) -> None:
        self._child: _Child | None = None

    @property
    def pid(self) -> int | None:
        """Of the child process, None before it is started."""
        return None if self._child is None else self._child.process.pid

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Answers come in the order of questions; WorkerDied is one if the process ends."""
        message = pickle.dumps((function, arguments), protocol=pickle.HIGHEST_PROTOCOL)
        for _ in range(2):
            try:
                return self._running().ask(message)
            except OSError as error:  # it died between two questions
                _log.warning("the back-end's process cannot be asked: %s", error)
                self.close()
        future: Future[Any] = Future()
        future.set_exception(WorkerDied("the back-end's process could not be started"))
        return future

    def close(self) -> None:
        """End the child process."""
        child, self._child = self._child, None
        if child is not None:
            child.end()

    def _running(self) -> _Child:
        child = self._child
        if child is None or not child.answers or child.process.poll() is not None:
            child = self._child = _Child()
            weakref.finalize(self, child.end)
        return child


def _send(pipe: IO[bytes], message: bytes) -> None:
    pipe.write(len(message).to_bytes(_LENGTH_BYTES, "little"))
    pipe.write(message)
    pipe.flush()


def _receive(pipe: IO[bytes]) -> bytes | None:
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
        answer: tuple[Any, Exception | None]
        try:
            answer = (function(*arguments), None)
        except Exception as error:
            answer = (None, error)
        _send(answers, pickle.dumps(answer, protocol=pickle.HIGHEST_PROTOCOL))


if __name__ == "__main__":
    _serve()
