"""Walks through the sources, of which the tests of names, imports and encodings look at every line."""

from __future__ import annotations

import ast


def nodes(source: str) -> list[ast.AST]:
    """All of a source's syntax tree, but for what has no content (Load, Store). In half of the time of ast.walk."""
    result: list[ast.AST] = [ast.parse(source)]
    for node in result:
        for value in node.__dict__.values():
            if value.__class__ is list:
                result += [item for item in value if isinstance(item, ast.AST)]
            elif isinstance(value, ast.AST) and value.__dict__:
                result.append(value)
    return result


def statements(source: str) -> list[ast.AST]:
    """All statements of a source, also those within others; of expressions none."""
    result: list[ast.AST] = list(ast.parse(source).body)
    for node in result:
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            result += getattr(node, part, ())
    return result
