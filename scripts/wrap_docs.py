"""Markdown prose in lines that a diff can show: python scripts/wrap_docs.py [--check] [FILE ...]

Wraps paragraphs and list items that have a line of more than MAX_COLUMNS characters; tables, code, headings, HTML and
paragraphs that are within it stay as they are. Without files: every Markdown file of the repository that is not made by
a program. --check: writes nothing, prints what it would wrap, exit code 1 where there is anything.
"""

from __future__ import annotations

import re
import subprocess
import sys
import textwrap
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MAX_COLUMNS = 110
GENERATED = {"docs/reference/cli.md", "docs/interop.md"}
"""Made from the help and by scripts/interop."""
MARKER = re.compile(r"^( *)([-*+]|\d+[.)]) +")
FENCE = re.compile(r"^ *(```|~~~)")
VERBATIM = re.compile(r"^ *(\||#|<|\[[^\]]+\]: |---|===|!!!|\?\?\?)")
"""Tables, headings, HTML, definitions of links, rules, admonitions."""
AMBIGUOUS = re.compile(r" (?=(?:[-*+#>|]|\d+[.)])(?: |$))")
"""A space before what would be a list, a heading or a quotation at the start of a line."""


def main(words: list[str]) -> int:
    check = "--check" in words
    files = [Path(word) for word in words if word != "--check"] or documents()
    wrong = 0
    for path in files:
        before = path.read_text(encoding="utf-8")
        after = wrapped(before)
        if after != before:
            wrong += 1
            print(f"{path}: lines of more than {MAX_COLUMNS} characters")
            if not check:
                path.write_text(after, encoding="utf-8", newline="\n")
    return int(check and wrong > 0)


def documents() -> list[Path]:
    names = subprocess.run(
        ["git", "ls-files", "*.md"], cwd=ROOT, check=True, capture_output=True, encoding="utf-8"
    ).stdout
    return [ROOT / name for name in names.splitlines() if name not in GENERATED and (ROOT / name).is_file()]


def wrapped(text: str) -> str:
    lines, out, k, in_list = text.split("\n"), list[str](), 0, False
    while k < len(lines):
        line = lines[k]
        if FENCE.match(line):
            end = next((j for j in range(k + 1, len(lines)) if FENCE.match(lines[j])), len(lines) - 1)
            out += lines[k : end + 1]
            k = end + 1
        elif not line.strip() or VERBATIM.match(line) or (line.startswith("    ") and not in_list):
            out.append(line)
            in_list = in_list and (not line.strip() or line.startswith("  "))
            k += 1
        else:
            end = k + 1
            while end < len(lines) and continues(lines[end]):
                end += 1
            in_list = bool(MARKER.match(line)) or (in_list and line.startswith("  "))
            out += paragraph(lines[k:end])
            k = end
    return "\n".join(out)


def continues(line: str) -> bool:
    """Whether a line goes on with the paragraph before it."""
    return bool(line.strip()) and not (MARKER.match(line) or FENCE.match(line) or VERBATIM.match(line))


def paragraph(lines: list[str]) -> list[str]:
    """One paragraph or list item; as it is where no line is too long, or a line ends with a break."""
    if all(len(line) <= MAX_COLUMNS for line in lines) or any(line.endswith(("  ", "\\")) for line in lines[:-1]):
        return lines
    marker = MARKER.match(lines[0])
    first = marker[0] if marker else re.match(r" *", lines[0])[0]  # type: ignore[index]
    rest = " " * len(first) if marker else first
    words = " ".join(line.strip() for line in lines)[len(first.strip()) :].strip()
    glued = AMBIGUOUS.sub("\0", words)
    found = textwrap.wrap(
        glued, MAX_COLUMNS, initial_indent=first, subsequent_indent=rest, break_long_words=False, break_on_hyphens=False
    )
    return [line.replace("\0", " ") for line in found]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
