"""python scripts/release_check.py v0.1.0: is this commit what that tag says?

The tag, the version in the code and the newest heading of CHANGELOG.md must be the same, and nothing may be left under
"Unreleased". Prints one line for each thing that is wrong, and exits with 1 then.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def faults(tag: str, version: str, changelog: str) -> list[str]:
    """tag: "v" and a version; version: of the code; changelog: its Markdown. One line per fault."""
    lines = []
    if tag != f"v{version}":
        lines.append(f"tag: expected v{version}, the version of src/splatpainter/_version.py, got {tag}")
    headings = [(m[1], m.end()) for m in re.finditer(r"^## (\S+).*$", changelog, re.MULTILINE)]
    starts = dict(reversed(headings))
    if version not in starts:
        lines.append(f"CHANGELOG.md: expected a heading '## {version}', got {', '.join(name for name, _ in headings)}")
    if "Unreleased" in starts:
        text = changelog[starts["Unreleased"] :].split("\n## ", 1)[0].strip()
        if text:
            lines.append(
                f"CHANGELOG.md: {len(text.splitlines())} lines stand under Unreleased: move them below {version}"
            )
    return lines


def main() -> int:
    if len(sys.argv) != 2:
        print("expected one tag: python scripts/release_check.py v0.1.0", file=sys.stderr)
        return 2
    code = (ROOT / "src" / "splatpainter" / "_version.py").read_text(encoding="utf-8")
    version = re.search(r'__version__ = "(.*)"', code)
    assert version, "_version.py has no version"
    wrong = faults(sys.argv[1], version[1], (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    print("\n".join(wrong), file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
