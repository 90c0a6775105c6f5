"""The programs that are tried, and how each is made to tell what it reads."""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from read_package import ply_columns

HERE = Path(__file__).resolve().parent
PYTHON_PACKAGES = ("gsply", "zstandard", "gaussforge", "usd-convert-gsplat", "usd-core")
BLENDER_PACKAGES = ("bpy",)
"""Blender as a module, 350 MB, in an environment of its own: it wants its own versions of numpy and USD."""
ENVIRONMENTS = {"bpy": "blender"}
"""Folders of environments, where not "python"."""
BLENDER = "Blender (points)"
NODE_PACKAGES = (
    "@playcanvas/splat-transform",
    "splat-transform-2=@playcanvas/splat-transform@2",
    "@playcanvas/supersplat-viewer",
    "playcanvas",  # which it runs on
    "three",
    "@sparkjsdev/spark",
    "@mkkellogg/gaussian-splats-3d",
    "@babylonjs/core",
    "@babylonjs/loaders",
    "@adobe/spz",  # Babylon.js loads these two by itself, from a server
    "fflate",
)
ABSENT = {
    "SuperSplat's editor": "npm view @playcanvas/supersplat: 404; its viewer is tried, and it reads and writes through "
    "splat-transform",
    "ComfyUI core": "pip: no matching distribution found for comfyui; comfyui-... are its clients and nodes",
    "Houdini, Unreal, Scaniverse": "no packages of npm or pip",
}
"""Programs that this script cannot try -> why."""
PATIENCE_SECONDS = 60
"""For one file."""
SERVED_TYPES = {".mjs": "text/javascript", ".js": "text/javascript", ".wasm": "application/wasm"}
Answers = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Program:
    """One program at one version."""

    title: str
    read: Callable[[Path, list[str]], Answers]
    """(folder of files, their names) -> for each name what compare.compared takes, and maybe "picture": PNG bytes."""


def python_programs(work: Path, versions: dict[str, str]) -> list[Program]:
    """Each in its own process of an environment below `work`."""

    def read(name: str, files: Path, names: list[str]) -> Answers:
        environment = work / ENVIRONMENTS.get(name, "python")
        interpreter = next(p for p in (environment / "bin/python", environment / "Scripts/python.exe") if p.exists())
        words = [str(interpreter), str(HERE / "read_package.py"), name, str(files), *names]
        done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_SECONDS * len(names))
        if done.returncode:
            raise RuntimeError(done.stderr.strip()[-300:])
        return json.loads(done.stdout.strip().splitlines()[-1])

    titles = {"gsply": "gsply", "gaussforge": "GaussForge", "usd-convert-gsplat": "usd-convert-gsplat", "bpy": BLENDER}
    named = [(name, title) for name, title in titles.items() if name in versions]
    return [Program(f"{title} {versions[name]}", partial(read, name)) for name, title in named]


def node_programs(work: Path, versions: dict[str, str]) -> list[Program]:
    """splat-transform, by the PLY that it makes of each file."""

    def read(package: str, files: Path, names: list[str]) -> Answers:
        answers: Answers = {}
        cli = work / "node_modules" / package / "dist" / "cli.mjs"
        runner = work / "run-cli.mjs"
        runner.write_text(f"const {{ main }} = await import({json.dumps(cli.as_uri())});\nawait main();\n")
        for name in names:
            target = files / f"{name}.{package.rpartition('/')[2]}.ply"
            words = ["node", str(runner), "-q", "-w", str(files / name), str(target)]
            done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_SECONDS)
            if done.returncode or not target.exists():
                lines = (done.stderr or done.stdout).strip().splitlines()
                said = [line for line in lines if "error" in line.lower() or "unsupported" in line.lower()] or lines
                answers[name] = {"error": " ".join(said[:1])[:160] or "no reason given"}
            else:
                answers[name] = ply_columns(target.read_bytes())
        return answers

    names = ("@playcanvas/splat-transform", "splat-transform-2")
    return [Program(f"splat-transform {versions[name]}", partial(read, name)) for name in names]


def viewers(work: Path, _: dict[str, str]) -> list[Program]:
    """Viewers for the web, in headless Chromium. Raises RuntimeError, ImportError: it or Playwright is absent."""
    import shutil

    import playwright.sync_api  # noqa: F401

    names = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
    browser = next(filter(None, map(shutil.which, names)), None)
    if browser is None:
        raise RuntimeError("no Chromium on this machine")
    packages = {
        "three": ("three", "three.js"),
        "spark": ("@sparkjsdev/spark", "Spark"),
        "gaussian-splats-3d": ("@mkkellogg/gaussian-splats-3d", "GaussianSplats3D"),
        "babylon": ("@babylonjs/core", "Babylon.js"),
        "supersplat": ("@playcanvas/supersplat-viewer", "SuperSplat's viewer"),
    }
    out = []
    for name, (package, title) in packages.items():
        record = json.loads((work / "node_modules" / package / "package.json").read_text())
        out.append(Program(f"{title} {record['version']}", partial(_read_in_page, work, browser, name)))
    return out


def _read_in_page(work: Path, browser: str, program: str, files: Path, names: list[str]) -> Answers:
    from playwright.sync_api import sync_playwright

    class Handler(SimpleHTTPRequestHandler):
        extensions_map = SimpleHTTPRequestHandler.extensions_map | SERVED_TYPES

        def translate_path(self, path: str) -> str:
            path = path.partition("?")[0].lstrip("/")
            root = {"node_modules": work, "files": files.parent}.get(path.partition("/")[0], HERE)
            return str(root / path)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    flags = ["--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--ignore-gpu-blocklist"]
    answers: Answers = {}
    try:
        with sync_playwright() as playwright:
            chromium = playwright.chromium.launch(executable_path=browser, args=flags)
            for name in names:
                page = chromium.new_page(viewport={"width": 200, "height": 200})
                page.goto(f"http://127.0.0.1:{server.server_port}/viewers.html?program={program}&file={name}")
                try:
                    page.wait_for_function("window.done", timeout=PATIENCE_SECONDS * 1000)
                    answers[name] = page.evaluate("window.answer")
                    if "error" not in answers[name] and not page.evaluate("window.notDrawn"):
                        answers[name]["picture"] = page.screenshot()
                except Exception as error:
                    answers[name] = {"error": str(error).splitlines()[0][:160]}
                page.close()
            chromium.close()
    finally:
        server.shutdown()
    return answers
