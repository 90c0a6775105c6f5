"""All wheels that users get, from any one system: `python scripts/build_wheels.py [--out dist] [TARGET ...]`

One wheel per platform for all Pythons (py3-none-PLATFORM), each with its own native library; pip's ziglang crosses to
all of them. Targets: zig's names, default: all of native/build.py's PLATFORMS. Windows' and macOS' first build takes
longer, because zig compiles their runtime once.
"""

from __future__ import annotations

import argparse
import os
import runpy
import subprocess
import sys
import time
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NATIVE = runpy.run_path(str(ROOT / "native" / "build.py"))
LIBRARIES: dict[str, str] = NATIVE["LIBRARIES"]
PLATFORMS: dict[str, str] = NATIVE["PLATFORMS"]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("targets", nargs="*", default=list(PLATFORMS), metavar="TARGET", help=", ".join(PLATFORMS))
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for target in args.targets:
        start = time.monotonic()
        command = [
            sys.executable,
            "-m",
            "pip",
            "wheel",
            "--quiet",
            "--no-deps",
            "--wheel-dir",
            str(args.out),
            str(ROOT),
        ]
        subprocess.run(command, check=True, env={**os.environ, "SPLATPAINTER_TARGET": target})
        wheel = max(args.out.glob(f"*-{PLATFORMS[target]}.whl"), key=lambda path: path.stat().st_mtime)
        with zipfile.ZipFile(wheel) as archive:
            names = [name for name in archive.namelist() if Path(name).name in LIBRARIES.values()]
            sizes = {name: archive.getinfo(name).file_size for name in names}
        if len(sizes) != 1:
            raise SystemExit(f"{wheel.name}: expected one native library, got {sorted(sizes)}")
        (size,) = sizes.values()
        print(f"{wheel.name}: library of {size / 1e3:.0f} kB, {time.monotonic() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
