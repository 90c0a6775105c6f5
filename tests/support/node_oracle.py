"""The Node oracles: another project's readers and writers of splat files (splat-transform 2 and 3) and the Khronos glTF
validator, pinned in tests/support/node.

A test module that wants one says `pytest_plugins = ["tests.support.node_oracle"]` and takes its fixture.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from splatpainter.splats import Frame

NODE = Path(__file__).resolve().parent / "node"


def _absent(reason: str) -> None:
    """Skip with one line on a contributor's machine; in CI a silent skip would hide a broken harness."""
    if os.environ.get("CI") == "true":
        pytest.fail(f"Node oracle: {reason}")
    pytest.skip(f"Node oracle: {reason}")


@pytest.fixture(scope="session")
def node_modules() -> Path:
    """tests/support/node/node_modules with what the lock file pins, installed once where Node and npm exist."""
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


@dataclass(frozen=True)
class SplatTransform:
    """run(*arguments) -> standard output of splat-transform, called with -q -w; an error of its fails the test."""

    package: Path
    spz_frame: Frame
    """Axes of the numbers in the SPZ files that it reads and writes; they do not say."""

    def __call__(self, *arguments: object) -> str:
        command = ["node", str(self.package / "bin" / "cli.mjs"), "-q", "-w", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, f"splat-transform {command[4:]}: {done.stderr or done.stdout}"
        return done.stdout


@pytest.fixture(scope="session", params=["2", "3"])
def splat_transform(request: pytest.FixtureRequest, node_modules: Path) -> SplatTransform:
    """Version 2 turns SPZ files to right-up-back, as the format has it; version 3 leaves them right-down-front."""
    if request.param == "2":
        return SplatTransform(node_modules / "@playcanvas" / "splat-transform", "rub")
    return SplatTransform(node_modules / "splat-transform-3", "rdf")


@pytest.fixture(scope="session")
def gltf_validator(node_modules: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], list[dict]]:
    """run(file) -> messages of the Khronos validator: code, message, severity, pointer."""
    script = tmp_path_factory.mktemp("validator") / "validate.cjs"
    script.write_text(_VALIDATE)

    def run(path: Path) -> list[dict]:
        command = ["node", str(script), str(node_modules / "gltf-validator"), str(path)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr or done.stdout
        return json.loads(done.stdout)

    return run


_VALIDATE = """
const validator = require(process.argv[2]);
const bytes = new Uint8Array(require("fs").readFileSync(process.argv[3]));
validator.validateBytes(bytes, { maxIssues: 0 }).then((report) => console.log(JSON.stringify(report.issues.messages)));
"""
