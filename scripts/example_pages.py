"""docs/guide/examples.md from the numbered examples: python scripts/example_pages.py"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HEAD = """# Examples

Eight short programs, each whole. They take an asset and a folder, and write what they make into the folder:

    python examples/01_paint.py demo/asset.ply out

`splatpainter demo --out demo` makes that asset. Two larger ones are folders of their
own: [a picture source](../recipes/own_source.md) in thirty lines (`examples/own_source`), and the still life
that makes the demo asset (`examples/still_life`).
"""


def page() -> str:
    parts = [HEAD]
    for path in sorted((ROOT / "examples").glob("0*.py")):
        code = path.read_text(encoding="utf-8").strip()
        title = (ast.get_docstring(ast.parse(code)) or path.stem).split("\n")[0]
        parts.append(f"## {title}\n\n`examples/{path.name}`\n\n```python\n{code}\n```\n")
    return "\n".join(parts)


if __name__ == "__main__":
    (ROOT / "docs" / "guide" / "examples.md").write_text(page(), encoding="utf-8", newline="\n")
