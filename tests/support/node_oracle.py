"""The Node oracles: another project's readers and writers of splat files (splat-transform 2 and 3, @adobe/spz) and the
Khronos glTF validator, pinned in tests/support/node.

A test module that wants one says `pytest_plugins = ["tests.support.node_oracle"]` and takes its fixture.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.splats import Axes, Splats

NODE = Path(__file__).resolve().parent / "node"
PATIENCE_SECONDS = 120
"""For one answer."""


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


class Server:
    """A Node program that answers one line of JSON with one line of JSON: Node, and 6 MB of script, start once."""

    def __init__(self, script: Path, *arguments: object) -> None:
        command = ["node", str(script), *map(str, arguments)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(self, question: object) -> Any:
        """The answer. Fails the test where the program has ended, or does not answer in time."""
        assert self.process.stdin is not None and self.process.stdout is not None
        patience = threading.Timer(PATIENCE_SECONDS, self.process.kill)
        patience.start()
        try:
            self.process.stdin.write(json.dumps(question) + "\n")
            self.process.stdin.flush()
            answer = self.process.stdout.readline()
        finally:
            patience.cancel()
        assert answer, f"Node oracle: no answer to {question}; exit code {self.process.poll()}"
        return json.loads(answer)

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


@dataclass(frozen=True)
class SplatTransform:
    """run(*arguments) -> standard output of splat-transform, called with -q -w; an error of its fails the test."""

    server: Server
    spz_axes: Axes
    """Axes of the numbers in the SPZ files that it reads and writes; they do not say."""

    def __call__(self, *arguments: object) -> str:
        words = [str(word) for word in arguments]
        answer = self.server.ask(words)
        assert answer["code"] == 0, f"splat-transform {words}: {answer['errors'] or answer['out']}"
        return answer["out"]


@pytest.fixture(scope="session", params=["2", "3"])
def splat_transform(
    request: pytest.FixtureRequest, node_modules: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[SplatTransform]:
    """Version 2 turns SPZ files to right-up-back, as the format has it; version 3 leaves them right-down-front."""
    packages: dict[str, tuple[str, Axes]]
    packages = {"2": ("@playcanvas/splat-transform", "rub"), "3": ("splat-transform-3", "rdf")}
    name, axes = packages[request.param]
    script = tmp_path_factory.mktemp("splat-transform") / "serve.mjs"
    script.write_text(_SERVE)
    server = Server(script, (node_modules / name / "dist" / "cli.mjs").as_uri())
    yield SplatTransform(server, axes)
    server.close()


# Its command line ends by process.exit, also where all is well: here that ends one answer. Each has words of its own.
_SERVE = """
import { createInterface } from "node:readline";
import { syncBuiltinESMExports } from "node:module";
import process from "node:process";

const exit = process.exit.bind(process);
const answer = process.stdout.write.bind(process.stdout);
let code, out, errors;
process.exit = (status) => {
  code ??= status ?? 0;
  throw new Error("process.exit");
};
process.stdout.write = (text) => { out += text; return true; };
process.stderr.write = (text) => { errors += text; return true; };
syncBuiltinESMExports();
const { main } = await import(process.argv[2]);
for await (const line of createInterface({ input: process.stdin })) {
  [code, out, errors] = [undefined, "", ""];
  process.argv.splice(2, Infinity, "-q", "-w", ...JSON.parse(line));
  try {
    await main();
  } catch (error) {
    if (code === undefined) [code, errors] = [1, errors + error.stack];
  }
  for (const event of ["uncaughtException", "unhandledRejection"]) process.removeAllListeners(event);
  answer(JSON.stringify({ code: code ?? 0, out, errors }) + "\\n");
}
exit(0);
"""


@pytest.fixture(scope="session")
def gltf_validator(
    node_modules: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[[Path], list[dict]]]:
    """run(file) -> messages of the Khronos validator: code, message, severity, pointer."""
    script = tmp_path_factory.mktemp("validator") / "validate.cjs"
    script.write_text(_VALIDATE)
    server = Server(script, node_modules / "gltf-validator")
    yield lambda path: server.ask(str(path))
    server.close()


_VALIDATE = """
const { readFileSync } = require("fs");
const validator = require(process.argv[2]);
require("readline").createInterface({ input: process.stdin }).on("line", async (line) => {
  const report = await validator.validateBytes(new Uint8Array(readFileSync(JSON.parse(line))), { maxIssues: 0 });
  console.log(JSON.stringify(report.issues.messages));
});
"""


@pytest.fixture(scope="session")
def spz_reference(
    node_modules: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[[list[Path]], list[Splats]]]:
    """run(files) -> what the reference implementation (WebAssembly, @adobe/spz) reads from SPZ files, turned to the
    PLY's axes."""
    script = tmp_path_factory.mktemp("spz") / "load.mjs"
    script.write_text(_LOAD_SPZ)
    server = Server(script, node_modules / "@adobe" / "spz" / "dist" / "spz.js")

    def read(files: list[Path]) -> list[Splats]:
        assert server.ask([str(file) for file in files]) == "read"
        return [_spz_values(file) for file in files]

    yield read
    server.close()


def _spz_values(file: Path) -> Splats:
    """What the program below left beside an SPZ file."""
    head = json.loads(Path(f"{file}.json").read_text())
    n, more = head["n"], (head["degree"] + 1) ** 2 - 1
    values = np.fromfile(f"{file}.f32", "<f4")
    sizes = [3 * n, 4 * n, 3 * n, n, 3 * n, 3 * more * n]
    means, xyzw, logs, logits, colors, rest = np.split(values, np.cumsum(sizes)[:-1])
    sh = np.concatenate([colors.reshape(n, 1, 3), rest.reshape(n, more, 3)], 1)
    with np.errstate(over="ignore"):
        opacities = (1 / (1 + np.exp(-logits.astype(np.float64)))).astype(np.float32)
    quats, scales = xyzw.reshape(n, 4)[:, [3, 0, 1, 2]], np.exp(logs.reshape(n, 3))
    return Splats(means.reshape(n, 3), quats, scales, opacities, sh, antialiased=head["antialiased"])


_LOAD_SPZ = """
import fs from "fs";
import { createInterface } from "node:readline";
import { pathToFileURL } from "url";
const spz = await (await import(pathToFileURL(process.argv[2]).href)).default({ print: () => {}, printErr: () => {} });
for await (const line of createInterface({ input: process.stdin })) {
  for (const file of JSON.parse(line)) {
    const c = spz.loadSpzFromBuffer(new Uint8Array(fs.readFileSync(file)), { to: spz.CoordinateSystem.RDF });
    const parts = [c.positions, c.rotations, c.scales, c.alphas, c.colors, c.sh].map((a) => Float32Array.from(a));
    const head = { n: c.numPoints, degree: c.shDegree, antialiased: c.antialiased };
    fs.writeFileSync(file + ".json", JSON.stringify(head));
    fs.writeFileSync(file + ".f32", Buffer.concat(parts.map((a) => Buffer.from(a.buffer))));
  }
  console.log('"read"');
}
"""
