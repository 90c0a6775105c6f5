"""Classes that `quick_dataclass` declares behave as those of the standard library, the oracle, line by line."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import pickle
import re
import subprocess
import sys
import textwrap
import types
from pathlib import Path
from typing import Any

import pytest

from splatpainter.system import quick_dataclass

HEAD = """
from __future__ import annotations
from dataclasses import KW_ONLY, field
from typing import ClassVar, Generic, TypeVar
"""
CLASSES = {
    "table": """
        @dataclass(frozen=True)
        class A:
            "Numbers."
            x: float = 1.5
            y: int = 3
        """,
    "required": """
        @dataclass(frozen=True)
        class A:
            x: float
            y: list = field(default_factory=list)
            z: int = field(default=3, compare=False, repr=False)
            kind: ClassVar[str] = "a"
        """,
    "mutable": """
        @dataclass
        class A:
            x: float = 0.0
            y: dict = field(default_factory=dict)
        """,
    "keywords": """
        @dataclass(frozen=True, kw_only=True)
        class A:
            x: float
            y: int = 3
        """,
    "below": """
        @dataclass(frozen=True)
        class Base:
            x: float
            name: str = field(default="a", kw_only=True)
        @dataclass(frozen=True)
        class A(Base):
            y: int = 3
            _: KW_ONLY
            z: int = 4
        """,
    "prepared": """
        @dataclass(frozen=True)
        class A:
            x: float = 2.0
            y: float = field(init=False)
            w: list = field(init=False, default_factory=list)
            v: int = field(init=False, default=8)
            def __post_init__(self):
                object.__setattr__(self, "y", 2 * self.x)
        """,
    "its own methods": """
        @dataclass(frozen=True)
        class A:
            x: float = 2.0
            def __eq__(self, other):
                return True
            def __repr__(self):
                return "mine"
        """,
    "its own init": """
        @dataclass(frozen=True)
        class A:
            x: float = 2.0
            def __init__(self, x):
                object.__setattr__(self, "x", 3 * x)
        """,
    "by identity": """
        @dataclass(frozen=True, eq=False)
        class A:
            x: float = 2.0
            def __str__(self):
                return "a"
        """,
    "generic": """
        T = TypeVar("T")
        @dataclass(frozen=True)
        class A(Generic[T]):
            x: T
            y: "A | None" = None
        """,
    "empty": """
        @dataclass(frozen=True)
        class A:
            pass
        """,
}
LINES = """
A()
A(1.0)
A(1.0, 2)
A(x=1.0)
A(x=1.0, y=5)
A(1.0, x=2.0)
A(1.0, 2, 3, 4, 5)
A(nothing=3)
A(1.0, z=5)
A(1.0, name="b")
A(1.0, y=A(2.0))
A(x=1.0) == A(x=1.0)
A(x=1.0) == A(x=2.0)
A(x=1.0) != 3
A(1.0, z=5) == A(1.0, z=6)
A() == A()
A() is A()
len({A(x=1.0), A(x=1.0)})
len({A(), A()})
A.__hash__ is None
A.__match_args__
setattr(A(x=1.0), "x", 3)
setattr(A(x=1.0), "other", 3)
setattr(A(), "x", 3)
delattr(A(x=1.0), "x")
delattr(A(x=1.0), "other")
vars(A(x=1.0))
vars(A())
dataclasses.replace(A(x=1.0), x=7.0)
dataclasses.replace(A(), x=7.0)
dataclasses.replace(A(x=1.0), v=3)
dataclasses.asdict(A(x=1.0))
[field.name for field in dataclasses.fields(A)]
str(inspect.signature(A))
str(inspect.signature(A(1.0).__init__))
A.__init__.__name__
copy.copy(A(x=1.0))
type("Sub", (A,), {})(1.0).x
setattr(type("Sub", (A,), {})(1.0), "other", 2)
setattr(type("Sub", (A,), {})(1.0), "x", 2)
type("Sub", (A,), {})(1.0) == A(1.0)
dataclasses.make_dataclass("Sub", [("more", int, 3)], bases=(A,), frozen=True)(1.0)
dataclasses.make_dataclass("Sub", [("more", int, 3)], bases=(A,))(1.0)
dataclass(frozen=True)(type("Sub", (A,), {"__annotations__": {"more": int}, "more": 3}))(1.0)
dataclass(type("Sub", (A,), {"__annotations__": {"more": int}, "more": 3}))(1.0)
"""
REFUSED = {
    "a mutable default": "@dataclass\nclass A:\n    x: list = []",
    "an assignment of its own": "@dataclass(frozen=True)\nclass A:\n    def __setattr__(self, name, value): ...",
    "frozen below what is not": "@dataclass\nclass B:\n    x: int = 1\n@dataclass(frozen=True)\nclass A(B): ...",
    "not frozen below what is": "@dataclass(frozen=True)\nclass B:\n    x: int = 1\n@dataclass\nclass A(B): ...",
}


def declared(source: str, decorator: Any) -> dict[str, Any]:
    """The names of a module with these classes; it is registered, as the standard library looks it up."""
    module = types.ModuleType("declared")
    sys.modules["declared"] = module
    names = vars(module)
    names |= {"dataclass": decorator, "copy": copy, "dataclasses": dataclasses, "inspect": inspect}
    exec(HEAD + textwrap.dedent(source), names)
    return names


def answers(names: dict[str, Any], line: str) -> list[str]:
    """What a line says: twice, as the first instance of a class is made another way than the second."""
    out = []
    for _ in range(2):
        try:
            out.append(repr(eval(line, names)))
        except Exception as error:
            out.append(f"{type(error).__name__}: {error}")
    return out


@pytest.mark.parametrize("name", CLASSES)
def test_a_class_behaves_as_one_of_the_standard_library(name: str) -> None:
    for line in LINES.strip().splitlines():
        theirs = answers(declared(CLASSES[name], dataclasses.dataclass), line)
        assert answers(declared(CLASSES[name], quick_dataclass.dataclass), line) == theirs, line


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_declared_is_refused_in_the_same_words(name: str) -> None:
    with pytest.raises((TypeError, ValueError)) as theirs:
        declared(REFUSED[name], dataclasses.dataclass)
    with pytest.raises(theirs.type) as ours:
        declared(REFUSED[name], quick_dataclass.dataclass)
    assert str(ours.value) == str(theirs.value)


@quick_dataclass.dataclass(frozen=True)
class Pair:
    """Known by name, so that it can be pickled."""

    first: Any
    second: int = 2


def test_pickles_and_circles() -> None:
    assert pickle.loads(pickle.dumps(Pair("a"))) == Pair("a")
    pair = Pair(None)
    object.__setattr__(pair, "first", pair)
    assert repr(pair) == "Pair(first=..., second=2)"


def test_declaring_compiles_nothing() -> None:
    """The reason for all of it: of a standard declaration nearly all time is the compiler's."""
    program = """
import sys
from splatpainter.system import quick_dataclass
written = []
sys.addaudithook(lambda event, values: written.append(values) if event == "compile" else None)
@quick_dataclass.dataclass(frozen=True)
class Table:
    share: float = 0.5
assert Table().share == 0.5
print(len(written))
assert Table(0.25).share == Table(share=0.25).share == 0.25
print(len(written))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "1"]


def test_all_of_the_package_declares_by_it() -> None:
    package = Path(quick_dataclass.__file__).parents[1]
    texts = {path: path.read_text(encoding="utf-8") for path in package.rglob("*.py")}
    slow = [path for path, text in texts.items() if re.search(r"^from dataclasses import .*\bdataclass\b", text, re.M)]
    assert [path.name for path in slow] == [] and len(texts) > 300
