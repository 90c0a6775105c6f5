"""Compile the native kernels into src/splatpainter/kernels: python native/build.py

Needs pip's `ziglang` (clang for every system, nothing else) or a C++17 compiler: CXX, else ziglang where it is
installed, else clang++ or g++. Every subject (native/*.cpp) is compiled once per kind of CPU; what did not change since
the last time is not compiled again.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HERE = Path(__file__).resolve().parent
PACKAGE = HERE.parent / "src" / "splatpainter" / "kernels"
OBJECTS = HERE.parent / "build" / "native"
LIBRARIES = {
    "linux": "splatpainter_kernels.so",
    "macos": "splatpainter_kernels.dylib",
    "windows": "splatpainter_kernels.dll",
}
# The same bits from every compiler on every CPU: no fused multiply-adds but written ones, no reordered sums.
EXACT = ["-ffp-contract=off", "-fno-fast-math", "-fno-math-errno", "-fno-trapping-math"]
COMMON = [
    "-std=c++17",
    "-O3",
    "-fvisibility=hidden",
    "-fno-exceptions",
    "-fno-rtti",
    "-fno-threadsafe-statics",
    "-fno-unwind-tables",
    "-fno-asynchronous-unwind-tables",
]
WARNINGS = ["-Wall", "-Wextra", "-Wno-psabi", "-Wno-unused-function", "-Wno-unknown-warning-option", "-Wno-pass-failed"]
V4 = ["-mprefer-vector-width=512"]
# Of three copies of every kernel that of the oldest machines is kept small.
BASE = ["-fno-unroll-loops"]
KINDS_X86 = {
    "gcc": {"base": ["-march=x86-64-v2"], "v3": ["-march=x86-64-v3"], "v4": ["-march=x86-64-v4", *V4]},
    "zig": {"base": ["-mcpu=x86_64_v2", *BASE], "v3": ["-mcpu=x86_64_v3"], "v4": ["-mcpu=x86_64_v4", *V4]},
}
PLATFORMS = {
    "x86_64-linux-gnu.2.17": "manylinux2014_x86_64",
    "aarch64-linux-gnu.2.17": "manylinux2014_aarch64",
    "aarch64-macos.11.0": "macosx_11_0_arm64",
    "x86_64-macos.11.0": "macosx_11_0_x86_64",
    "x86_64-windows-gnu": "win_amd64",
}
"""zig's name of a target -> the wheel's tag: what is built for users."""


def sources() -> list[Path]:
    """Every file that the library is made of, in a fixed order."""
    return sorted(path for path in HERE.rglob("*") if path.suffix in (".h", ".cpp"))


def hash_of_sources() -> str:
    """The same in splatpainter/kernels/library.py, which compares it with the library's in a checkout."""
    digest = hashlib.sha256()
    for path in sources():
        digest.update(path.relative_to(HERE).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:32]


def default_compiler() -> str:
    if os.environ.get("CXX"):
        return os.environ["CXX"]
    if importlib.util.find_spec("ziglang"):
        return "zig"
    for name in ("clang++", "g++", "c++"):
        if shutil.which(name):
            return name
    raise SystemExit("native/build.py: expected a C++ compiler, found none; `python -m pip install ziglang` brings one")


def target_here() -> str:
    """zig's name of this machine and system."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    if sys.platform == "darwin":
        return f"{machine}-macos.11.0"
    if sys.platform == "win32":
        return f"{machine}-windows-gnu"
    return f"{machine}-linux-gnu.2.17"


def build(
    target: str = "",
    compiler: str = "",
    objects: Path | None = None,
    flags: tuple[str, ...] = (),
    link: tuple[str, ...] = (),
    only_base: bool = False,
) -> Path:
    """Compile and link; returns the library, in `objects` (default: build/native/TARGET). target: zig's name of the
    system to compile for (default: this one). only_base: without the copies for newer CPUs."""
    compiler = compiler or default_compiler()
    zig = compiler == "zig"
    if target and not zig:
        raise SystemExit("native/build.py: other systems need zig (`python -m pip install ziglang`)")
    target = target or target_here()
    system = target.split("-")[1].split(".")[0]
    x86 = target.startswith("x86_64")
    command = [sys.executable, "-m", "ziglang", "c++", "-target", target] if zig else compiler.split()
    linker = [sys.executable, "-m", "ziglang", "cc", "-target", target] if zig else compiler.split()
    common = [
        *COMMON,
        *EXACT,
        *WARNINGS,
        *flags,
        *(["-DSP_X86"] if x86 and not only_base else []),
        *([] if system == "windows" else ["-fPIC"]),
    ]
    kinds = KINDS_X86["zig" if zig else "gcc"] if x86 else {"base": []}
    kinds = {"base": kinds["base"]} if only_base else kinds
    objects = (objects or OBJECTS / target).resolve()
    objects.mkdir(parents=True, exist_ok=True)

    subjects = sorted(path.stem for path in HERE.glob("*.cpp") if path.stem != "library")
    names = " ".join(f"X({subject})" for subject in subjects)
    strings = ["-DSP_SUBJECTS(X)=" + names, f'-DSP_SOURCES="{hash_of_sources()}"']
    work = [
        (f"{subject}.cpp", objects / f"{subject}_{kind}.o", [*machine, f"-DSP_TARGET={kind}", f"-DSP_KIND_{kind}"])
        for subject in subjects
        for kind, machine in kinds.items()
    ]
    work.append(("library.cpp", objects / "library.o", [*kinds["base"], "-DSP_TARGET=base", *strings]))

    def compiled(item: tuple[str, Path, list[str]]) -> Path:
        source, out, extra = item
        words = [*command[-2:], *common, *extra, source]
        if not _is_current(out, words):
            # From within the folder: what is compiled is then the same wherever the checkout lies.
            files = ["-MMD", "-MF", str(out.with_suffix(".d")), "-c", source, "-o", str(out)]
            subprocess.run([*command, *common, *extra, *files], check=True, cwd=HERE)
            out.with_suffix(".key").write_text(_key(out, words), encoding="utf-8")
        return out

    # Long ones first.
    work.sort(key=lambda item: -sum(path.stat().st_size for path in (HERE / item[0]).with_suffix("").glob("*.h")))
    with ThreadPoolExecutor(_cpus()) as pool:
        files = list(pool.map(compiled, work))
    library = objects / LIBRARIES[system]
    # No C++ runtime, and on Linux no C library to link against: memcpy and the like are in every process. zig would
    # first compile what is not asked for, which takes from 15 seconds to minutes.
    bare = ["-nostdlib"] if system == "linux" and not link else []
    strip = [] if link else ["-s"]
    subprocess.run([*linker, "-shared", *bare, *strip, *link, "-o", str(library), *map(str, files)], check=True)
    return library


def _cpus() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _key(out: Path, words: list[str]) -> str:
    """Hash of the options and of all files here that the compiler read."""
    rule = out.with_suffix(".d").read_text(encoding="utf-8").replace("\\\n", " ")
    digest = hashlib.sha256("\0".join(words).encode())
    for name in rule.split(": ", 1)[1].split():
        path = (HERE / name).resolve()
        if HERE in path.parents:
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _is_current(out: Path, words: list[str]) -> bool:
    try:
        return out.exists() and out.with_suffix(".key").read_text(encoding="utf-8") == _key(out, words)
    except (OSError, IndexError):
        return False


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--compiler", default="", help="zig, or a command like g++")
    parser.add_argument("--target", default="", help="zig's name of another system: aarch64-macos.11.0")
    parser.add_argument("--out", type=Path, default=PACKAGE, help="folder that the library is copied to")
    parser.add_argument("--checked", action="store_true", help="check every index, and stop at the first wrong one")
    parser.add_argument("--base", action="store_true", help="without the copies for newer CPUs: a third of the time")
    parser.add_argument("--sanitize", default="", help="address,undefined: needs g++ or clang++")
    args = parser.parse_args()
    start = time.monotonic()
    flags, link, kind = [], [], args.target or target_here()
    if args.checked:
        flags, kind = ["-DSP_CHECKED", "-O1"], kind + "-checked"
    if args.sanitize:
        link = [f"-fsanitize={args.sanitize}"]
        flags, kind = (
            [*flags, *link, "-O1", "-fno-omit-frame-pointer", "-g"],
            kind + "-" + args.sanitize.replace(",", "-"),
        )
    if args.base:
        kind += "-base"
    if args.compiler:
        kind += "-" + args.compiler.split()[0].rsplit("/", 1)[-1]
    library = build(args.target, args.compiler, OBJECTS / kind, tuple(flags), tuple(link), args.base)
    args.out.mkdir(parents=True, exist_ok=True)
    copy = args.out / library.name
    shutil.copyfile(library, copy.with_suffix(".new"))
    os.replace(copy.with_suffix(".new"), copy)  # a process that has the old one open goes on with it
    print(f"{copy} ({copy.stat().st_size / 1e3:.0f} kB, {time.monotonic() - start:.1f} s)")


if __name__ == "__main__":
    main()
