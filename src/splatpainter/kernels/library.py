"""The kernels compiled ahead of time (native/): `run(kernels.project_gaussians, *arguments)`.

The shared library lies beside this file. It says itself what each kernel's parameters are, so nothing is declared
twice; arguments are checked against that before a kernel sees them. A kernel with float32 and float64 forms is chosen
by its first array of floats. Kernels run without the GIL.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

CPU_VARIABLE = "SPLATPAINTER_CPU"
"""Name of a kind of CPU ("base", "v3", "v4"): for tests of what other machines run."""
LIBRARY_VARIABLE = "SPLATPAINTER_KERNELS"
"""Path of another build of the library (checked, sanitized): for tests."""
LIBRARY = {"darwin": "splatpainter_kernels.dylib", "win32": "splatpainter_kernels.dll"}.get(
    sys.platform, "splatpainter_kernels.so"
)
BUILD = "run `make native` (or `python native/build.py` after `python -m pip install ziglang`)"
MAX_DIMENSIONS = 4
_NUMBERS = {"q": "q", "?": "?7x", "d": "d", "f": "d"}
"""dtype of a parameter that is a number -> struct's letter of it; a float travels as a double."""


def _listed_address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def _read_address(array: np.ndarray) -> int:
    return ctypes.c_size_t.from_address(id(array) + object.__basicsize__).value


def _reads_addresses() -> bool:
    """Whether numpy's arrays begin with what every object begins with, and then the address of their data: all do, as
    numpy's C interface has it (PyArrayObject_fields in ndarraytypes.h), where `id` is where an object lies."""
    array = np.zeros((3, 2))[1:]
    return sys.implementation.name == "cpython" and _read_address(array) == _listed_address(array)


address_of = _read_address if _reads_addresses() else _listed_address
"""The address of an array's first number: read in a fifth of the time in which numpy lists it, a thousand times an
edit."""


class _KernelRow(ctypes.Structure):
    _fields_ = [("name", ctypes.c_char_p), ("signature", ctypes.c_char_p), ("call", ctypes.c_void_p)]


class _TargetRow(ctypes.Structure):
    _fields_ = [("name", ctypes.c_char_p), ("tables", ctypes.POINTER(ctypes.POINTER(_KernelRow)))]


_ENTRY = ctypes.CFUNCTYPE(None, ctypes.c_char_p, ctypes.c_int64, ctypes.c_int64)


class _Parameter:
    """What one argument must be."""

    def __init__(self, word: str):
        # "f2w16": float32, two dimensions, written, 16 columns; "q0": a number.
        self.dtype, self.dimensions, self.written = np.dtype(word[0]), int(word[1]), word[2] == "w"
        self.columns = int(word[3:] or 0)
        self.number = "" if self.dimensions else _NUMBERS[word[0]]
        self.rest = (0,) * (MAX_DIMENSIONS - self.dimensions)

    def __str__(self) -> str:
        if not self.dimensions:
            return f"a number ({self.dtype})"
        shape = ["?"] * self.dimensions
        if self.columns:
            shape[-1] = str(self.columns)
        return f"{'a writable' if self.written else 'a'} C-contiguous {self.dtype} array of shape [{', '.join(shape)}]"

    def words(self, value: Any) -> tuple[Any, ...]:
        """Address and shape as a kernel reads them. Raises TypeError for another kind of array."""
        if not self.dimensions:
            return 0, value, 0, 0, 0
        if value is None:
            return 0, 0, 0, 0, 0
        # Everything a kernel trusts is checked here: a wrong stride would read somebody else's memory. Most dtypes are
        # the very object: an edit packs a thousand arguments.
        shape, dtype, flags = value.shape, value.dtype, value.flags
        if (
            not isinstance(value, np.ndarray)
            or (dtype is not self.dtype and dtype != self.dtype)
            or len(shape) != self.dimensions
            or not (flags.carray if self.written else flags.c_contiguous and flags.aligned)
            or (self.columns and shape[-1] != self.columns)
        ):
            raise TypeError
        return address_of(value), *shape, *self.rest


class _Form:
    """A kernel for one dtype."""

    def __init__(self, signature: str, address: int):
        self.parameters = [_Parameter(word) for word in signature.split()]
        self.layout = struct.Struct("<" + "".join(f"q{p.number or 'q'}qqq" for p in self.parameters))
        self.entry = _ENTRY(address)


class Kernel:
    """One kernel in all its dtypes: kernel(*arguments, thread, threads)."""

    def __init__(self, name: str):
        self.name = name
        self._listed: dict[str, tuple[str, int]] = {}
        """Its forms as the library lists them, by the letter of the dtype that tells them apart: most are not asked
        for, and to read the signatures of all takes longer than a small edit's kernels."""
        self._forms: dict[str, _Form] = {}
        self._chooser = 0

    def __repr__(self) -> str:
        return f"<native kernel {self.name}>"

    def add(self, signature: str, address: int, *, instead: bool = False) -> None:
        """instead: of none; a form of that dtype that is there stays."""
        # float32 and float64 forms share a name; their first array of floats tells them apart.
        floats = [(at, word[0]) for at, word in enumerate(signature.split()) if word[0] in "fd" and word[1] != "0"]
        self._chooser, char = floats[0] if floats else (0, "")
        if char not in self._listed:
            self._listed[char] = signature, address
        elif not instead:
            raise ValueError(f"kernel {self.name}: listed twice in native/")

    def bind(self, *arguments: Any) -> Callable[[int, int], None]:
        """The call of these arguments by (thread, threads). Arrays must be C-contiguous and of the kernel's dtypes and
        dimensions (None: an array without entries); nothing is converted. Raises TypeError for others."""
        # Arguments are packed once; each thread then calls with its number alone.
        form = self._form(arguments)
        words: list[Any] = []
        at = 0
        try:
            for parameter in form.parameters:
                words += parameter.words(arguments[at])
                at += 1
        except (TypeError, AttributeError):
            described = _described(arguments[at])
            raise TypeError(f"{self.name}: argument {at}: expected {form.parameters[at]}, got {described}") from None
        try:
            packed = form.layout.pack(*words)
        except (struct.error, TypeError):
            numbers = [(at, value) for at, value in enumerate(arguments) if not form.parameters[at].dimensions]
            listed = ", ".join(
                f"argument {at}: {form.parameters[at]}, got {_described(value)}" for at, value in numbers
            )
            raise TypeError(f"{self.name}: expected numbers: {listed}") from None

        def call(thread: int, threads: int, _arrays: tuple[Any, ...] = arguments) -> None:  # arrays live as long as it
            form.entry(packed, thread, threads)

        return call

    def __call__(self, *arguments: Any) -> None:
        self.bind(*arguments[:-2])(arguments[-2], arguments[-1])

    def _form(self, arguments: tuple[Any, ...]) -> _Form:
        # All forms of a kernel have equally many arguments.
        first = self._of_dtype(next(iter(self._listed)))
        if len(arguments) != len(first.parameters):
            raise TypeError(f"{self.name}: expected {len(first.parameters)} arguments, got {len(arguments)}")
        if len(self._listed) == 1:
            return first
        dtype = getattr(arguments[self._chooser], "dtype", None)
        char = getattr(dtype, "char", "")
        if char not in self._listed:
            raise TypeError(f"{self.name}: argument {self._chooser}: expected a float32 or float64 array, got {dtype}")
        return self._of_dtype(char)

    def _of_dtype(self, char: str) -> _Form:
        form = self._forms.get(char)
        if form is None:
            form = self._forms[char] = _Form(*self._listed[char])
        return form


class Kernels:
    """The kernels of one library for one kind of CPU, as attributes."""

    def __init__(self, path: Path, cpu: str = ""):
        """cpu: "base", "v3", "v4"; default: the best for this machine. Raises OSError where the library is missing,
        not loadable, or older than the sources of its checkout, ValueError for a kind that this machine has not."""
        # Kinds of CPU, best first; the library itself knows which of them this machine is.
        self._library = _loaded(path)
        targets = (_TargetRow * 4)()
        self._library.splatpainter_targets(targets)
        names = [row.name.decode() for row in targets if row.name]
        self.cpus: tuple[str, ...] = tuple(names)
        """Kinds of CPU that this machine is one of, the best first."""
        self.cpu: str = cpu or names[0]
        """The one in use."""
        self.version: str = self._library.splatpainter_sources().decode()[:12]
        """First digits of `hash_of_sources`."""
        if self.cpu not in names:
            raise ValueError(f"{CPU_VARIABLE}: expected one of {', '.join(names)}, got {cpu!r}")
        self._kernels: dict[str, Kernel] = {}
        for kernel, signature, address in _rows(targets[names.index(self.cpu)].tables):
            self._kernels.setdefault(kernel, Kernel(kernel)).add(signature, address)
        # What this kind lacks (FLOAT_FIRST, SP_KERNELS_TO_V3, SP_KERNELS_TO_BASE in native/kernels.h) is that of the
        # next one, with the same bits.
        for target in targets[names.index(self.cpu) + 1 : len(names)]:
            for kernel, signature, address in _rows(target.tables):
                self._kernels.setdefault(kernel, Kernel(kernel)).add(signature, address, instead=True)

    def __getattr__(self, name: str) -> Kernel:
        try:
            return self.__dict__["_kernels"][name]
        except KeyError:
            raise AttributeError(f"no kernel {name!r} in native/") from None

    def __dir__(self) -> list[str]:
        return sorted(self._kernels)


class _Current:
    """The kernels in use; loaded when first asked for."""

    def __getattr__(self, name: str) -> Any:
        return getattr(current(), name)


kernels: Any = _Current()
"""`kernels.NAME`: the kernel of that name in native/."""
_chosen: Kernels | None = None


def current() -> Kernels:
    """Those in use: of the variables SPLATPAINTER_KERNELS and SPLATPAINTER_CPU, or this package's for this machine."""
    return _chosen or _default()


@contextlib.contextmanager
def using(cpu: str) -> Iterator[Kernels]:
    """Run the kernels of another kind of CPU, in all threads: for tests."""
    global _chosen
    before, _chosen = _chosen, Kernels(_path(), cpu)
    try:
        yield _chosen
    finally:
        _chosen = before


@functools.cache
def _default() -> Kernels:
    return Kernels(_path(), os.environ.get(CPU_VARIABLE, ""))


def _path() -> Path:
    return Path(os.environ.get(LIBRARY_VARIABLE) or Path(__file__).with_name(LIBRARY))


def _loaded(path: Path) -> ctypes.CDLL:
    if not path.exists():
        raise OSError(f"{path}: the compiled kernels are missing; in a checkout, {BUILD}")
    try:
        library = ctypes.CDLL(os.fspath(path))
        library.splatpainter_sources.restype = ctypes.c_char_p
    except (OSError, AttributeError) as error:
        raise OSError(f"{path}: the compiled kernels cannot be loaded ({error}); in a checkout, {BUILD}") from None
    # In a checkout a stale library would give wrong answers without a word.
    sources = Path(__file__).resolve().parents[3] / "native"
    if (sources / "build.py").exists() and library.splatpainter_sources().decode() != hash_of_sources(sources):
        raise OSError(f"{path}: the compiled kernels are older than {sources}; {BUILD}")
    return library


def version() -> str:
    """Of the core in use: the first digits of `hash_of_sources`. Cores of one version give the same bytes on every
    machine."""
    return current().version


def hash_of_sources(folder: Path) -> str:
    """Of all C++ files, as native/build.py puts it into the library."""
    digest = hashlib.sha256()
    # Names and contents, as native/build.py hashes them.
    for path in sorted(path for path in folder.rglob("*") if path.suffix in (".h", ".cpp")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:32]


def _rows(tables: Any) -> Iterator[tuple[str, str, int]]:
    """(name, signature, address) of every kernel of one kind of CPU."""
    at = 0
    while tables[at]:
        row = 0
        while tables[at][row].name:
            yield tables[at][row].name.decode(), tables[at][row].signature.decode(), tables[at][row].call
            row += 1
        at += 1


def _described(value: Any) -> str:
    if not isinstance(value, np.ndarray):
        return f"{type(value).__name__} {value!r}"[:80]
    flags = value.flags
    kind = [
        word
        for word, holds in (("not contiguous", not flags.c_contiguous), ("read-only", not flags.writeable))
        if holds
    ]
    return f"{value.dtype} {list(value.shape)}" + (f" ({', '.join(kind)})" if kind else "")
