# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Fuzz one target, or each in turn, guided by coverage: needs the package atheris (``pip install atheris``).

    python test/fuzz/fuzz.py [--seconds 600] [TARGET …]

Inputs that reach new code are kept in build/fuzz/TARGET, where the next run goes on; what fails is written to
build/fuzz/failed-TARGET-… and ends the target. Put it into test/fuzz/corpus/TARGET with the fix: ``make test``
replays the corpus. Each target is a process of its own, bounded in memory (2 GB) and in time (10 s an input).
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
KEPT = ROOT / "build" / "fuzz"


def fuzz(name: str, arguments: list[str]) -> None:
    """Fuzz in this process; does not return."""
    import atheris

    with atheris.instrument_imports(include=["calib_planner"]):
        sys.path[:0] = [str(HERE), str(HERE.parent)]
        from targets import LONGEST, TARGETS
    run = TARGETS[name]
    atheris.Setup([sys.argv[0], f"-max_len={LONGEST}", *arguments], lambda data: run(bytes(data)))
    atheris.Fuzz()


def main() -> int:
    """Each target in a process of its own; the number of targets that failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET")
    parser.add_argument("--seconds", type=int, default=600, help="for each target")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    options, rest = parser.parse_known_args()
    if find_spec("atheris") is None:
        print(
            "fuzz.py: atheris is not installed (pip install atheris): make test replays the corpus",
            file=sys.stderr,
        )
        return 2
    if options.inside:
        fuzz(options.targets[0], rest)
    sys.path[:0] = [str(HERE), str(HERE.parent)]
    from targets import FILES, TARGETS

    ros = find_spec("rclpy") is not None and find_spec("calib_planner_msgs") is not None
    names = options.targets or list(TARGETS if ros else FILES)
    failed = []
    for name in names:
        if name not in TARGETS:
            parser.error(f"no target {name!r}; valid: {', '.join(TARGETS)}")
        kept = KEPT / name
        kept.mkdir(parents=True, exist_ok=True)
        folders = [str(kept), *([str(HERE / "corpus" / name)] if (HERE / "corpus" / name).is_dir() else [])]
        limits = [f"-max_total_time={options.seconds}", "-timeout=10", "-rss_limit_mb=2048", "-verbosity=0"]
        limits += ["-print_final_stats=1", f"-artifact_prefix={KEPT}/failed-{name}-"]
        command = [sys.executable, __file__, "--inside", name, *limits, *folders]
        try:
            status = subprocess.run(command, cwd=KEPT, timeout=2 * options.seconds + 300).returncode
        except subprocess.TimeoutExpired:  # it is killed by then
            status = 124
        print(f"fuzz {name}: {'nothing' if status == 0 else f'FAILED (status {status})'}", flush=True)
        failed += [name] if status else []
    return len(failed)


if __name__ == "__main__":
    raise SystemExit(main())
