"""Command line of the fuzzing: see the package's own text."""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import traceback
from pathlib import Path

from .supervisor import Plan, faults, run, summary
from .target import make_target, names, rng_of

KERNELS = Path(__file__).with_name("kernels.py")
"""Extreme values for every kernel; it has seeds and a --count of its own to try one again."""


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Hostile inputs for all readers.")
    parser.add_argument("--seconds", type=float, default=600, help="wall time of the run (600)")
    parser.add_argument("--targets", default="all", help=f"comma separated, of: {', '.join(names())}")
    parser.add_argument("--seed", type=int, default=0, help="first seed (0)")
    parser.add_argument("--inputs", type=int, default=None, help="at most this many of each target")
    parser.add_argument("--jobs", type=int, default=1, help="processes (1)")
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"), help="folder of failing inputs (out/fuzz)")
    parser.add_argument("--replay", type=int, default=None, metavar="SEED", help="try one input of one target here")
    config = parser.parse_args()
    available = [*names(), *(["kernels"] if KERNELS.exists() else [])]
    chosen = available if config.targets == "all" else config.targets.split(",")
    wrong = [name for name in chosen if name not in available]
    if wrong:
        parser.error(f"unknown target {wrong[0]!r}; expected one of {', '.join(available)}")
    if config.replay is not None:
        return replay(chosen[0], config.replay)
    share, status = config.seconds / len(chosen), 0
    if "kernels" in chosen:  # a program of its own: bounds are checked in kernels that it compiles for itself
        chosen.remove("kernels")
        seconds = str(max(1, round(share)))
        status = subprocess.run([sys.executable, KERNELS, "--seconds", seconds, "--seed", str(config.seed)]).returncode
        config.seconds -= share
    if not chosen:
        return status
    plan = Plan(chosen, config.seconds, config.jobs, config.seed, config.inputs, config.out)
    tallies = run(plan)
    print("\n" + summary(tallies))
    for fault in faults(config.out):
        again = f"--targets {fault['target']} --replay {fault['seed']}"
        print(f"\n{fault['fault']}\n  {fault['count']} x; {'; '.join(fault['where'])}\n  python -m tests.fuzz {again}")
    return 1 if status or any(tally.failures for tally in tallies.values()) else 0


def replay(name: str, seed: int) -> int:
    """One input in this process, with its traceback."""
    import warnings

    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory() as folder:
        target = make_target(name, Path(folder))
        rng = rng_of(name, seed)
        files = target.make(rng)
        print({file: len(data) for file, data in files.items()})
        try:
            print(target.check(files, rng))
        except Exception:
            traceback.print_exc()
            return 1
        finally:
            target.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
