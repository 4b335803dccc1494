"""Run damaged cases in forked children, so that a crash, a hang or a large memory is caught.

Each child serves a stretch of cases under a limit of address space and of processor time per
case (the wall clock would measure the machine's other work), and tells its parent before and
after each of them. When a child dies, the case that it had begun is the finding; another child
goes on behind it.
"""

from __future__ import annotations

import dataclasses
import os
import pickle
import resource
import select
import shutil
import signal
import struct
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path

#: a case: (its own index, an empty folder) -> what came of it, in a word or two
Case = Callable[[int, Path], str]


@dataclasses.dataclass(frozen=True)
class Limits:
    """Of one child."""

    #: address space beyond what was mapped at the start
    memory_bytes: int = 2 * 2**30
    #: told for every kind; the limit itself only ends what would not end
    cpu_s: float = 30.0
    #: a case that waits for something (a pipe, a lock) uses no processor time
    wall_s: float = 300.0


@dataclasses.dataclass
class Tally:
    """Counts of outcomes, and findings as sentences."""

    cases: int = 0
    outcomes: Counter[str] = dataclasses.field(default_factory=Counter)
    findings: list[str] = dataclasses.field(default_factory=list)
    most_cpu_s: float = 0.0
    peak_mib: int = 0

    def add(self, other: Tally) -> None:
        """Take the counts of another stretch in."""
        self.cases += other.cases
        self.outcomes += other.outcomes
        self.findings += other.findings
        self.most_cpu_s = max(self.most_cpu_s, other.most_cpu_s)
        self.peak_mib = max(self.peak_mib, other.peak_mib)


class FoundError(Exception):
    """A case found something that must not be; the message says what."""


def run_cases(case: Case, first: int, count: int, limits: Limits | None = None) -> Tally:
    """Run the cases ``first`` .. ``first + count - 1`` in forked children."""
    limits = limits or Limits()
    tally, at, end = Tally(), first, first + count
    while at < end:
        folder = Path(tempfile.mkdtemp(prefix="gcar-fuzz-"))
        try:
            at = _stretch(case, at, end, limits, folder, tally)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    return tally


def _stretch(case: Case, at: int, end: int, limits: Limits, folder: Path, tally: Tally) -> int:
    """Serve cases in one child until it is done or dead; return the next case."""
    reader, writer = os.pipe()
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        os.close(reader)
        _child(case, at, end, limits, folder, writer)
    os.close(writer)
    stream, hung = os.fdopen(reader, "rb", buffering=0), False
    while True:
        ready, _, _ = select.select([stream], [], [], limits.wall_s)
        if not ready:
            hung = True
            os.kill(child, signal.SIGKILL)
        message = _receive(stream)
        if message is None:
            break
        index, outcome, cpu_s, peak_mib = message
        tally.cases += 1
        tally.most_cpu_s = max(tally.most_cpu_s, cpu_s)
        tally.peak_mib = max(tally.peak_mib, peak_mib)
        if outcome.startswith("FINDING"):
            tally.findings.append(f"case {index}: {outcome}")
        tally.outcomes[outcome.split(":")[0]] += 1
        at = index + 1
    stream.close()
    _, status = os.waitpid(child, 0)
    if at < end:  # it died within case ``at``
        number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        late = hung or number == signal.SIGPROF
        what = "time-out" if late else f"signal {number}" if number else f"exit {status >> 8}"
        tally.cases += 1
        tally.outcomes[f"FINDING {what}"] += 1
        tally.findings.append(f"case {at}: FINDING {what}")
        at += 1
    return at


def _child(case: Case, at: int, end: int, limits: Limits, folder: Path, writer: int) -> None:
    """Serve cases and leave without any clean-up of the parent's; never returns."""
    try:
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nowhere, stream)
        # What the libraries have mapped already is not the case's.
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = limits.memory_bytes + pages * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for index in range(at, end):
            own = folder / str(index)
            own.mkdir()
            before = _cpu_s()
            signal.setitimer(signal.ITIMER_PROF, limits.cpu_s)
            try:
                outcome = case(index, own)
            except FoundError as found:
                outcome = f"FINDING {found}"
            except MemoryError:
                outcome = "FINDING out of memory"
            except BaseException:  # noqa: BLE001 - whatever escapes is what is looked for
                last = " | ".join(traceback.format_exc().strip().splitlines()[-3:])
                outcome = f"FINDING traceback: {last}"
            signal.setitimer(signal.ITIMER_PROF, 0)
            shutil.rmtree(own, ignore_errors=True)
            peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
            _send(writer, (index, outcome, _cpu_s() - before, peak_mib))
    finally:
        os._exit(0)


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _send(writer: int, message: tuple[int, str, float, int]) -> None:
    data = pickle.dumps(message)
    data = struct.pack("I", len(data)) + data
    while data:
        data = data[os.write(writer, data) :]


def _receive(stream: object) -> tuple[int, str, float, int] | None:
    head = _exactly(stream, 4)
    if head is None:
        return None
    data = _exactly(stream, struct.unpack("I", head)[0])
    return None if data is None else pickle.loads(data)  # noqa: S301 - from our own child


def _exactly(stream: object, count: int) -> bytes | None:
    data = b""
    while len(data) < count:
        more = stream.read(count - len(data))  # type: ignore[attr-defined]
        if not more:
            return None
        data += more
    return data
