"""What was called otherwise before, and may still be called so: keywords of functions, attributes of values."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")


def formerly(**old: str) -> Callable[[Callable[_Parameters, _Result]], Callable[_Parameters, _Result]]:
    """A function whose keywords may be given by their old names, too: `formerly(axes="frame")` lets callers write
    `frame=` for `axes=`. Its signature, and what type checkers know, has the present names alone. It raises TypeError
    where one value is given by both."""

    def decorated(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
        @functools.wraps(function)
        def call(*arguments: _Parameters.args, **keywords: _Parameters.kwargs) -> _Result:
            for present, before in old.items():
                if before in keywords:
                    if present in keywords:
                        raise TypeError(
                            f"{function.__name__}: {present} was given twice, also by its old name {before}"
                        )
                    keywords[present] = keywords.pop(before)
            return function(*arguments, **keywords)

        return call

    return decorated


def formerly_called(present: str) -> Any:
    """An attribute under its old name: `frame = formerly_called("axes")` in a class answers with `axes`."""
    return property(operator.attrgetter(present), doc=f"The old name of `{present}`.")
