"""`dataclass` as the standard library has it, and a tenth of its time to declare a class.

The standard one writes and compiles up to six methods for every class, half a millisecond each: a fifth of a process
that imports two hundred classes, makes one instance of most of them and compares none. Here the methods are shared, and
`__init__` alone is written for a class, when it is first called with arguments. `fields`, `replace`, `asdict`, pickles,
signatures and subclasses are as ever; `order`, `slots` and `InitVar` are not offered.
"""

from __future__ import annotations

import dataclasses
import inspect
import reprlib
from collections.abc import Callable, Sequence
from dataclasses import MISSING, FrozenInstanceError
from operator import attrgetter
from typing import TYPE_CHECKING, Any


class _MadeAnew:
    """Stands in a parameter list for a default that each instance gets a new one of."""

    def __repr__(self) -> str:
        return "<factory>"


_MADE_ANEW = _MadeAnew()


def _quick_dataclass(
    kind: type | None = None, /, *, frozen: bool = False, eq: bool = True, kw_only: bool = False
) -> Any:
    """The decorator, with or without arguments, which mean what they mean to `dataclasses.dataclass`. Raises what that
    raises."""

    def declared(kind: Any) -> Any:
        declarations = {*vars(kind)} - ({"__hash__"} if "__eq__" in vars(kind) and kind.__hash__ is None else set())
        # Without a text the standard library would write one out of the signature, which takes longest of all.
        kind.__doc__ = kind.__doc__ or f"{kind.__name__}(...)"
        # Fields are collected by the standard library, which knows all about annotations and inheritance. It compiles
        # what refuses assignments; only below other dataclasses does it have to know, as it compares them.
        inherits = any(hasattr(base, "__dataclass_fields__") for base in kind.__mro__[1:])
        standard = dataclasses.dataclass(init=False, repr=False, eq=False, frozen=frozen and inherits, kw_only=kw_only)
        standard(kind)
        if frozen and not inherits:
            _freeze(kind)
        # As there, a method that the class has itself is not replaced.
        fields = dataclasses.fields(kind)
        methods: dict[str, Any] = {"__repr__": _repr}
        if "__init__" not in declarations:
            methods |= {"__init__": _first_init(kind, frozen), "__signature__": _Signature(kind)}
        if eq:
            methods["__eq__"] = _equality([field.name for field in fields if field.compare])
            hashed = [field.name for field in fields if (field.compare if field.hash is None else field.hash)]
            methods["__hash__"] = _hash_of(hashed) if frozen else None
        for name, method in methods.items():
            if name not in declarations:
                setattr(kind, name, method)
        return kind

    return declared if kind is None else declared(kind)


if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass
else:
    dataclass = _quick_dataclass


def _freeze(kind: Any) -> None:
    names = frozenset(field.name for field in dataclasses.fields(kind))

    def __setattr__(self: Any, name: str, value: Any) -> None:
        if type(self) is kind or name in names:
            raise FrozenInstanceError(f"cannot assign to field {name!r}")
        super(kind, self).__setattr__(name, value)

    def __delattr__(self: Any, name: str) -> None:
        if type(self) is kind or name in names:
            raise FrozenInstanceError(f"cannot delete field {name!r}")
        super(kind, self).__delattr__(name)

    for name, method in (("__setattr__", __setattr__), ("__delattr__", __delattr__)):
        if name in vars(kind):
            raise TypeError(f"Cannot overwrite attribute {name} in class {kind.__name__}")
        setattr(kind, name, method)
    # So that the standard library lets frozen classes, and no others, inherit from this one.
    kind.__dataclass_params__.frozen = True


@reprlib.recursive_repr()
def _repr(self: Any) -> str:
    fields = (f"{field.name}={getattr(self, field.name)!r}" for field in dataclasses.fields(self) if field.repr)
    return f"{type(self).__qualname__}({', '.join(fields)})"


def _values_of(names: Sequence[str]) -> Callable[[Any], tuple[Any, ...]]:
    if len(names) > 1:
        return attrgetter(*names)
    return (lambda self: (getattr(self, names[0]),)) if names else lambda self: ()


def _equality(names: Sequence[str]) -> Callable[[Any, Any], Any]:
    values = _values_of(names)

    def __eq__(self: Any, other: Any) -> Any:
        if other.__class__ is not self.__class__:
            return NotImplemented
        return values(self) == values(other)

    return __eq__


def _hash_of(names: Sequence[str]) -> Callable[[Any], int]:
    values = _values_of(names)

    def __hash__(self: Any) -> int:
        return hash(values(self))

    return __hash__


def _first_init(kind: Any, frozen: bool) -> Callable[..., None]:
    """An `__init__` that takes its own place: tables of defaults are filled without it, else it is written and called.
    (A second thread that is here at the same time writes the same.)"""
    fields = dataclasses.fields(kind)
    has_defaults = all(field.default is not MISSING or field.default_factory is not MISSING for field in fields)
    calls: list[None] = []

    def __init__(self: Any, *args: Any, **values: Any) -> None:
        if has_defaults and not (args or values or calls):
            calls.append(None)
            for field in fields:
                if field.init or field.default is MISSING:
                    value = field.default_factory() if field.default_factory is not MISSING else field.default
                    object.__setattr__(self, field.name, value) if frozen else setattr(self, field.name, value)
            if hasattr(self, "__post_init__"):
                self.__post_init__()
            return
        kind.__init__ = written_init(kind, frozen)
        kind.__init__(self, *args, **values)

    return __init__


def written_init(kind: Any, frozen: bool) -> Callable[..., None]:
    """The `__init__` of a class as the standard library writes it, of parameters in its order. Raises TypeError: a
    field without a default after one with one."""
    fields = dataclasses.fields(kind)
    given = [field for field in fields if field.init]
    ordered = [*(field for field in given if not field.kw_only), *(field for field in given if field.kw_only)]
    names: dict[str, Any] = {"_set": object.__setattr__, "_MADE_ANEW": _MADE_ANEW}
    parameters, lines, optional = ["self"], [], ""
    for field in ordered:
        if field.kw_only and "*" not in parameters:
            parameters.append("*")
        # Values travel by name, as their text may be anything.
        names |= {f"_default_{field.name}": field.default, f"_make_{field.name}": field.default_factory}
        default = f"_default_{field.name}" if field.default is not MISSING else "_MADE_ANEW"
        if field.default is MISSING and field.default_factory is MISSING:
            if optional and not field.kw_only:
                raise TypeError(f"non-default argument {field.name!r} follows default argument {optional!r}")
            parameters.append(field.name)
        else:
            optional = optional or field.name
            parameters.append(f"{field.name}={default}")
    for field in fields:
        value = field.name
        if field.default_factory is not MISSING:
            names[f"_make_{field.name}"] = field.default_factory
            made = f"_make_{field.name}()"
            value = f"{made} if {field.name} is _MADE_ANEW else {field.name}" if field.init else made
        elif not field.init:
            continue
        lines.append(f"_set(self, {field.name!r}, {value})" if frozen else f"self.{field.name} = {value}")
    if hasattr(kind, "__post_init__"):
        lines.append("self.__post_init__()")
    exec(f"def __init__({', '.join(parameters)}):\n  " + "\n  ".join(lines or ["pass"]), names)
    init = names["__init__"]
    init.__qualname__ = f"{kind.__qualname__}.__init__"
    init.__annotations__ = {**{field.name: field.type for field in ordered}, "return": None}
    return init


class _Signature:
    """What `inspect.signature` asks a class for: that of the `__init__` that would be written."""

    def __init__(self, kind: Any) -> None:
        self.kind = kind

    def __get__(self, instance: Any, kind: Any) -> inspect.Signature:
        if kind is not self.kind or "__init__" not in vars(kind):
            raise AttributeError("__signature__")
        init = vars(kind)["__init__"]
        written = written_init(kind, True) if init.__code__.co_filename == __file__ else init
        signature = inspect.signature(written)
        return signature.replace(parameters=list(signature.parameters.values())[1:], return_annotation=None)
