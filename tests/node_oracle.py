"""The Node oracle: another project's readers and writers of splat files (splat-transform), pinned in tests/node.

A test module that wants it says `pytest_plugins = ["node_oracle"]` and takes the fixture `splat_transform`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

NODE = Path(__file__).resolve().parent / "node"


def _absent(reason: str) -> None:
    """Skip with one line on a contributor's machine; in CI a silent skip would hide a broken harness."""
    if os.environ.get("CI") == "true":
        pytest.fail(f"Node oracle: {reason}")
    pytest.skip(f"Node oracle: {reason}")


@pytest.fixture(scope="session")
def node_modules() -> Path:
    """tests/node/node_modules with what the lock file pins, installed once where Node and npm exist."""
    if not shutil.which("node") or not shutil.which("npm"):
        _absent("node and npm are not installed")
    installed = NODE / "node_modules" / ".package-lock.json"
    if not installed.exists() or installed.stat().st_mtime < (NODE / "package-lock.json").stat().st_mtime:
        command = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error"]
        done = subprocess.run(command, cwd=NODE, capture_output=True, text=True, timeout=300)
        if done.returncode != 0:
            _absent(f"npm ci failed: {' '.join((done.stderr or done.stdout).split())[:200]}")
        installed.touch()
    return NODE / "node_modules"


@pytest.fixture(scope="session")
def splat_transform(node_modules: Path) -> Callable[..., str]:
    """run(*arguments) -> standard output of splat-transform, called with -q -w; an error of its fails the test."""
    script = node_modules / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"

    def run(*arguments: object) -> str:
        command = ["node", str(script), "-q", "-w", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, f"splat-transform {command[4:]}: {done.stderr or done.stdout}"
        return done.stdout

    return run
