"""Mitsuba 3 on whatever this machine has: CUDA, LLVM, or the scalar fallback. Knows no meshes and no cameras.

Dr.Jit looks for `libLLVM.so`, a name that distributions give only to development packages; `find_llvm` finds the
runtime library under its versioned names. Environment: DRJIT_LIBLLVM_PATH overrides the search, SPLATPAINTER_THREADS
bounds the threads.
"""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, get_args

from splatpainter.kernels.parallel import THREADS_VARIABLE, threads

Variant = Literal["cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb"]
LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
MIN_LLVM_VERSION = 18
"""Major version. Dr.Jit 1.x aborts the whole process in LLVM 14, 15 and 16 (measured, "cannot select"): they are
passed over, for scalar is slow but not dead."""
LLVM_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64",
    "/usr/lib64/llvm*/lib",
    "/usr/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)


def use_mitsuba(variant: Variant | Literal["auto"] = "auto") -> Any:
    """The `mitsuba` module with a variant set; "auto": the fastest that works here.

    The variant is a global of Mitsuba (per thread): call this before each use. Raises ValueError when Mitsuba is not
    installed, and when a variant asked for by name does not work here."""
    if variant != "auto" and variant not in get_args(Variant):
        raise ValueError(f"expected a Mitsuba variant of auto, {', '.join(get_args(Variant))}, got {variant!r}")
    if LLVM_VARIABLE not in os.environ and (llvm := find_llvm()) is not None:
        os.environ[LLVM_VARIABLE] = str(llvm)  # read by Dr.Jit when it is imported
    try:
        import mitsuba
    except ImportError as error:
        raise ValueError(f"path tracing needs Mitsuba 3 ({error}); pip install 'splatpainter[train]'") from None
    if THREADS_VARIABLE in os.environ:
        import drjit

        drjit.set_thread_count(threads())
    if variant == "auto" and mitsuba.variant() in get_args(Variant):
        return mitsuba
    tried = [variant] if variant != "auto" else available()
    reason: Exception | None = None
    for name in tried:
        try:
            mitsuba.set_variant(name)
            return mitsuba
        except (ImportError, RuntimeError) as error:
            reason = error
    raise ValueError(f"Mitsuba: {tried[-1]} does not work here ({' '.join(str(reason).split())})")


def available() -> list[Variant]:
    """Variants worth trying on this machine, fastest first."""
    names: list[Variant] = ["cuda_ad_rgb"] if has_gpu() else []
    if os.environ.get(LLVM_VARIABLE) or find_llvm() is not None:
        names.append("llvm_ad_rgb")
    return [*names, "scalar_rgb"]


def has_gpu() -> bool:
    """Whether the NVIDIA driver lists a GPU. Asked of nvidia-smi: CUDA itself need not be initialised for that."""
    try:
        done = subprocess.run(["nvidia-smi", "-L"], capture_output=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0 and b"GPU" in done.stdout


def find_llvm(folders: Iterable[str] = LLVM_FOLDERS) -> Path | None:
    """The newest libLLVM in `folders` (absolute, may hold wildcards) that Dr.Jit can use, None where there is none."""
    versions: dict[Path, int] = {}
    for folder in folders:
        for path in Path("/").glob(f"{folder.lstrip('/')}/libLLVM*"):
            version = llvm_version(path)
            if version is not None and version >= MIN_LLVM_VERSION:
                versions[path] = version
    return max(versions, key=lambda path: (versions[path], str(path)), default=None)


def llvm_version(path: Path) -> int | None:
    """Major version by the file's name (libLLVM.so.19.1, libLLVM-19.so.1) or, where that has none, by the folder's or
    the link's target; None when it cannot be told."""
    for text in (path.name, os.path.basename(os.path.realpath(path)), str(path.parent)):
        match = re.search(r"(?:libLLVM(?:\.so\.|[-.])|llvm[-@]?)(\d+)", text)
        if match and (".so" in path.name or path.name.endswith(".dylib")):
            return int(match[1])
    return None
