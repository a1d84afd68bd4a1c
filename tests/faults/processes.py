"""Starting, killing and asking the processes of the fault tests."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

WORKER = Path(__file__).with_name("worker.py")


class Job:
    """A child under way; its standard error and its answer are files."""

    def __init__(self, nursery: Nursery, pid: int, answer: Path, stderr: Path, events: Path) -> None:
        self._nursery = nursery
        self.pid = pid
        self._answer = answer
        self._stderr = stderr
        self._events = events
        self.started = time.perf_counter()
        self.seconds = 0.0
        self._status: int | None = None

    def wait(self) -> int:
        """Wait for its end and return the exit status, ``-signal.SIGKILL`` for a killed one."""
        if self._status is None:
            self._status = int(self._nursery.ask({"reap": self.pid}))
            self.seconds = time.perf_counter() - self.started
        return self._status

    def kill(self, after: float) -> bool:
        """Kill it that many seconds after its start; return False where it had ended before."""
        time.sleep(max(0.0, self.started + after - time.perf_counter()))
        os.kill(self.pid, signal.SIGKILL)
        return self.wait() == -signal.SIGKILL

    @property
    def answer(self) -> Any:
        """What it answered."""
        return json.loads(self._answer.read_text())

    @property
    def stderr(self) -> str:
        """What it wrote to standard error."""
        return self._stderr.read_text()

    @property
    def finished_nodes(self) -> int:
        """How many nodes it had computed."""
        return self._events.stat().st_size if self._events.exists() else 0


class Nursery:
    """A warmed-up process that forks children for jobs.  `folder` takes what they write beside their outputs."""

    def __init__(self, folder: Path, command: Sequence[str] = (sys.executable,)) -> None:
        folder.mkdir(parents=True)
        self.folder = folder
        self._count = 0
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [*command, str(WORKER), str(folder)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip

    def __enter__(self) -> Nursery:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended already; whoever asked it was told so
            self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait(20)

    def ask(self, line: dict[str, Any]) -> str:
        """Send one line and return the answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(line) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        assert answer, "the process that forks the children has ended"
        return answer

    def start(self, kind: str, **job: Any) -> Job:
        """Start a job."""
        self._count += 1
        base = self.folder / str(self._count)
        answer, stderr, events = (base.with_suffix(suffix) for suffix in (".json", ".stderr", ".events"))
        plain = {name: str(value) if isinstance(value, Path) else value for name, value in job.items()}
        told = {"kind": kind, "answer": str(answer), "stderr": str(stderr), "events": str(events), **plain}
        return Job(self, int(self.ask(told)), answer, stderr, events)

    def do(self, kind: str, **job: Any) -> Job:
        """Do a job and wait for its end, which must be a good one."""
        started = self.start(kind, **job)
        status = started.wait()
        assert status == 0, started.stderr
        return started
