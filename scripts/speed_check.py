"""python scripts/speed_check.py: has anything become much slower? For CI, where no test may ask the clock.

Runs `splatpainter bench speed --quick`, whose lines are told in parts of a fixed piece of numpy's work of the same run,
and compares them with benchmarks/quick_ratios.json. Exits with 1 where a line takes MAX_FACTOR times as long as there,
twice in a row: shared machines are noisy. --write puts this run's ratios there, after a change that is meant.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

STORED = Path(__file__).resolve().parents[1] / "benchmarks" / "quick_ratios.json"
MAX_FACTOR = 3.0
"""Lines of a second run on a busy machine differ by up to 2."""
SLACK = 0.5
"""Parts of the calibration that a line may take longer whatever it took: a slip of the scheduler."""
TRIES = 2
OTHERS = ", reference"
"""Ending of the lines that are not of our kernels."""


def measured() -> dict[str, float]:
    """Line -> its ratio, of one run."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "splatpainter", "bench", "speed", "--quick", "--json", "--out", folder]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE)
    lines = json.loads(done.stdout)["lines"]
    return {line["operation"]: round(line["calibrated"], 3) for line in lines if not line["operation"].endswith(OTHERS)}


def slower(ratios: dict[str, float], stored: dict[str, float]) -> dict[str, float]:
    """The lines that take too long -> their factor. Lines that are not stored have no bound."""
    return {
        name: ratio / stored[name]
        for name, ratio in ratios.items()
        if name in stored and ratio > MAX_FACTOR * stored[name] + SLACK
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help="store this run's ratios")
    if parser.parse_args().write:
        STORED.write_text(json.dumps(measured(), indent=2) + "\n", encoding="utf-8")
        return 0
    stored = json.loads(STORED.read_text(encoding="utf-8"))
    late: dict[str, float] = {}
    for attempt in range(TRIES):
        ratios = measured()
        for name, ratio in ratios.items():
            print(f"{ratio:10.2f}  stored {stored.get(name, 0.0):10.2f}  {name}", flush=True)
        again = slower(ratios, stored)
        late = {name: factor for name, factor in again.items() if attempt == 0 or name in late}
        if not late:
            return 0
    for name, factor in late.items():
        print(f"{name}: {factor:.1f} times as long as stored, twice", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
