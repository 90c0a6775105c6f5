"""docs/reference/cli.md from the commands' own help: python scripts/cli_reference.py"""

from __future__ import annotations

import contextlib
import io
import os
import re
from pathlib import Path

os.environ |= {"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}  # before tyro looks

from splatpainter.cli import main
from splatpainter.commands import SUMMARIES

HEAD = """# Command line

Made from `--help`. Every command takes `--json` (one JSON object instead of text); exit codes: 0 done; 1 done, and
not all is well (`verify` found a difference, a job of `batch` failed, `data check` found damage, a table of `bench`
lacks figures); 2 bad input or options; 70 a fault of ours; 130 Ctrl-C; 143 terminated.
"""
TARGET = Path(__file__).resolve().parents[1] / "docs" / "reference" / "cli.md"


def help_of(*words: str) -> str:
    """What `splatpainter WORDS --help` prints."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        main([*words, "--help"])
    return re.sub(r"\x1b\[[0-9;]*m", "", text.getvalue()).strip()


def subcommands(text: str) -> list[str]:
    """Names that a help lists where a command consists of commands: the lines of its lists but for that of examples."""
    if not re.match(r"usage: splatpainter \w+ [A-Z]+ \.\.\.", text):
        return []
    return re.findall(r"^  (\w+) +(?!\w+ --|-)\S", text.split("\nexample", 1)[0].split("\n\n", 1)[1], re.MULTILINE)


def reference() -> str:
    parts = [HEAD]
    for name, summary in SUMMARIES.items():
        text = help_of(name)
        parts.append(f"\n## {name}\n\n{summary[0].upper()}{summary[1:]}.\n\n```text\n{text}\n```\n")
        for inner in subcommands(text):
            parts.append(f"\n### {name} {inner}\n\n```text\n{help_of(name, inner)}\n```\n")
    return "".join(parts)


if __name__ == "__main__":
    TARGET.write_text(reference(), encoding="utf-8", newline="\n")
