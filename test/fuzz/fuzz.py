# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Fuzz targets one after the other, guided by coverage: needs the package atheris (``make fuzz`` installs it).

    python test/fuzz/fuzz.py [--seconds 600 | --total 30] [--seed N] [TARGET …]
    python test/fuzz/fuzz.py --input FILE TARGET          one input again; without atheris

``--seconds`` is the time of each target; ``--total`` is a time that all of them share, in random order. Inputs
that reach new code are kept in build/fuzz/TARGET, where the next run goes on. What fails is written to
build/fuzz/failed-TARGET-…, printed with the way to repeat it, and ends the target. Put it into
test/fuzz/corpus/TARGET with the fix: ``make test`` replays the corpus.

The library is imported once, instrumented, and each target is a fork of this process, bounded in memory (2 GB)
and in time (30 s an input, on a busy machine as well). The whole corpus runs before the forks, so that modules
which a reader imports when it is first called are instrumented, too.
"""

from __future__ import annotations

import argparse
import atexit
import base64
import gzip
import io
import os
import random
import re
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stderr
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
CORPUS = HERE / "corpus"
KEPT = ROOT / "build" / "fuzz"
WORD = re.compile(rb"[A-Za-z_][A-Za-z0-9_]{2,30}")
NUMBERS = (b"nan", b"-inf", b"1e400", b"-0.0", b"1e-320", b"99999999999999999999", b"null", b"[]", b"{}", b"\xff")
GRACE = 60.0
"""A target that has not ended so long after its time is killed [s]: two inputs of the longest time."""


def load() -> dict[str, Callable[[bytes], None]]:
    """The targets, instrumented, after every input of the corpus."""
    import atheris

    with redirect_stderr(io.StringIO()), atheris.instrument_imports(include=["calib_planner"]):
        from targets import FILES, TARGETS

        ros = find_spec("rclpy") is not None and find_spec("calib_planner_msgs") is not None
        names = TARGETS if ros else FILES
        for name in names:
            for data in seeds(name) or [b""]:
                TARGETS[name](data)
    return {name: TARGETS[name] for name in names}


def seeds(name: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted((CORPUS / name).glob("*"))]


def dictionary(name: str) -> Path:
    """The words of a target's corpus, and awkward numbers: mutations put them in whole."""
    words = sorted({word for data in seeds(name) for word in WORD.findall(data)} | set(NUMBERS))
    path = KEPT / f"{name}.dict"
    path.write_text("".join('"' + "".join(f"\\x{b:02x}" for b in word) + '"\n' for word in words))
    return path


def fuzz(name: str, run: Callable[[bytes], None], seconds: float, seed: int, log: Path) -> NoReturn:
    """Fuzz in this process, a fork: what fails leaves it by ``SystemExit``, after which the input is written."""
    import atheris
    from targets import LONGEST

    atexit.unregister(shutil.rmtree)  # the folder is the parent's
    with log.open("wb") as out:
        os.dup2(out.fileno(), 1)
        os.dup2(out.fileno(), 2)
    kept = KEPT / name
    kept.mkdir(exist_ok=True)
    folders = [str(kept), *([str(CORPUS / name)] if (CORPUS / name).is_dir() else [])]
    limits = ["-timeout=30", "-rss_limit_mb=2048", f"-max_len={LONGEST}", f"-seed={seed}"]
    limits += ["-print_final_stats=1", f"-artifact_prefix={KEPT}/failed-{name}-", f"-dict={dictionary(name)}"]
    atheris.Setup([sys.argv[0], *limits, *folders], lambda data: run(bytes(data)))
    # The fuzzer ends in order at this signal. The thread runs while an input does: the handler is there by then.
    ends = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGUSR1))
    ends.daemon = True
    ends.start()
    atheris.Fuzz()
    raise SystemExit(0)


def end_of(child: int, seconds: float) -> int:
    """The exit status of a process (negative: of which signal it died), killed where it takes longer."""
    last = time.monotonic() + seconds
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > last:
            os.kill(child, signal.SIGKILL)
            last = float("inf")
        time.sleep(0.02)


def repeat(path: Path, name: str) -> str:
    """How to run a failed input again, with the input itself."""
    packed = base64.b64encode(gzip.compress(path.read_bytes(), mtime=0)).decode()
    return (
        f"  the input: {path.read_bytes()[:500]!r}\n"
        f"  again: echo {packed} | base64 -d | gunzip > /tmp/{path.name}\n"
        f"         python test/fuzz/fuzz.py --input /tmp/{path.name} {name}"
    )


def report(name: str, log: Path, status: int, before: set[Path]) -> bool:
    """Print what a target did; whether it failed."""
    text = log.read_text("utf-8", "replace")
    inputs = re.findall(r"number_of_executed_units: (\d+)", text)
    edges = re.findall(r"cov: (\d+)", text)
    failures = sorted(set(KEPT.glob(f"failed-{name}-*")) - before)
    bad = status != 0 or bool(failures)
    print(
        f"fuzz {name}: {inputs[-1] if inputs else '?'} inputs, {edges[-1] if edges else '?'} edges, "
        f"{len(list((KEPT / name).glob('*')))} kept: {f'FAILED (status {status})' if bad else 'nothing'}",
        flush=True,
    )
    if bad:
        print("\n".join(f"  | {line[:300]}" for line in text.splitlines()[-40:]))
        for path in failures:
            print(repeat(path, name), flush=True)
    return bad


def main() -> int:
    """Each target in a process of its own; the number of targets that failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET")
    parser.add_argument("--seconds", type=float, default=600.0, help="for each target")
    parser.add_argument("--total", type=float, help="seconds that all targets share, in place of --seconds")
    parser.add_argument("--seed", type=int, help="of order and mutations; another one each time by default")
    parser.add_argument("--input", type=Path, help="run one target with this file, once")
    options = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.path[:0] = [str(HERE), str(HERE.parent)]
    if options.input is not None:
        from targets import TARGETS

        if len(options.targets) != 1 or options.targets[0] not in TARGETS:
            parser.error(f"--input goes with one target; valid: {', '.join(TARGETS)}")
        TARGETS[options.targets[0]](options.input.read_bytes())
        return 0
    if find_spec("atheris") is None:
        print("fuzz.py: atheris is not installed: pip install -r requirements/fuzz.txt", file=sys.stderr)
        return 2
    KEPT.mkdir(parents=True, exist_ok=True)
    targets = load()
    names = options.targets or list(targets)
    for name in names:
        if name not in targets:
            parser.error(f"no target {name!r}; valid: {', '.join(targets)}")
    seed = options.seed if options.seed is not None else random.SystemRandom().randrange(1, 1 << 31)
    if options.total is not None:
        random.Random(seed).shuffle(names)
    seconds = options.seconds if options.total is None else options.total / len(names)
    print(f"fuzz: {len(names)} targets of {seconds:.3g} s each, seed {seed}", flush=True)
    failed = 0
    for name in names:
        log, before = KEPT / f"{name}.log", set(KEPT.glob(f"failed-{name}-*"))
        child = os.fork()
        if child == 0:
            fuzz(name, targets[name], seconds, seed, log)
        failed += report(name, log, end_of(child, seconds + GRACE), before)
    return failed


if __name__ == "__main__":
    raise SystemExit(main())
