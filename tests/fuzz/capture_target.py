"""Captures: JSON of trainers and viewers bent as trees, COLMAP's models as bytes, lenses included."""

from __future__ import annotations

import json
import random
import tempfile
from pathlib import Path

import numpy as np

from splatpainter.cameras import look_at
from splatpainter.captures import captured_views
from splatpainter.captures.colmap import MODELS, read_points
from splatpainter.captures.inria import training_arguments
from tests.support.capture_folders import opengl_pose, write_colmap, write_inria, write_table

from .mutations import bend_bytes, bend_json, json_bytes, maybe
from .target import Fault, Target, Verdict, refusal

NAMES = ("a.jpg", "b.png")
KINDS = ("cameras.json", "transforms.json", "camera_path.json", "bin", "txt")


class CaptureTarget(Target):
    """A folder with one kind of cameras in it, at times with cfg_args or a data parser's frame beside them."""

    name = "capture"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.cameras = [look_at(eye, (0, 0, 0), width=24, height=16, fov=45) for eye in ((0, 1, 3), (2, 0, 1))]
        path = [{"camera_to_world": opengl_pose(c).ravel().tolist(), "fov": 45.0} for c in self.cameras]
        self.trees = {
            "camera_path.json": {"camera_path": path, "render_width": 24, "render_height": 16},
            "dataparser_transforms.json": {"transform": np.eye(4)[:3].tolist(), "scale": 0.5},
        }
        with tempfile.TemporaryDirectory() as made:
            write_inria(Path(made), self.cameras, NAMES)
            extra = {"k1": 0.1, "p1": 0.01, "camera_model": "OPENCV", "applied_transform": np.eye(4)[:3].tolist()}
            write_table(Path(made), self.cameras, NAMES, **extra)
            for name in ("cameras.json", "transforms.json"):
                self.trees[name] = json.loads((Path(made) / name).read_text())

    def make(self, rng: random.Random) -> dict[str, bytes]:
        kind = rng.choice(KINDS)
        files = {}
        if kind in ("bin", "txt"):
            number = rng.choice([number for number, model in MODELS.items() if model.lens is not None])
            count = max(0, MODELS[number].parameters - 4)
            bend = [rng.uniform(-0.5, 0.5) for _ in range(count)]
            with tempfile.TemporaryDirectory() as made:
                model = (number, MODELS[number].name)
                points = np.array([[0.0, 1, 2, 3, 4, 5]])
                write_colmap(Path(made), self.cameras, NAMES, ending=kind, model=model, bend=bend, points=points)
                for file in sorted(Path(made).iterdir()):
                    data = file.read_bytes()
                    files[file.name] = bend_bytes(rng, data) if maybe(rng, 0.4) else data
        else:
            tree = json.loads(json.dumps(self.trees[kind]))
            files[kind] = json_bytes(rng, bend_json(rng, tree) if maybe(rng, 0.8) else tree)
            if maybe(rng, 0.3):
                tree = json.loads(json.dumps(self.trees["dataparser_transforms.json"]))
                files["dataparser_transforms.json"] = json_bytes(rng, bend_json(rng, tree))
            if maybe(rng, 0.3):
                text = b"Namespace(source_path='/data/x', images='images', white_background=True)"
                files["cfg_args"] = bend_bytes(rng, text)
        return files

    def check(self, files: dict[str, bytes], rng: random.Random) -> Verdict:
        for old in self.folder.iterdir():
            old.unlink()
        for name, data in files.items():
            (self.folder / name).write_bytes(data)
        training_arguments(self.folder)
        path = self.folder / "camera_path.json" if "camera_path.json" in files else self.folder
        try:
            views = captured_views(path, self.folder)
            points, colors = read_points(self.folder)
        except ValueError as error:
            refusal(error, str(self.folder))
            return Verdict(refused=1)
        if points.shape != colors.shape or not (np.isfinite(points).all() and np.isfinite(colors).all()):
            raise Fault(f"points of shape {points.shape}, colours of shape {colors.shape}, or not finite")
        for view in views:
            if not np.isfinite(view.camera.world_to_camera).all():
                raise Fault(f"a camera that is not finite: {view.camera}")
            if view.picture() is not None:
                raise Fault(f"a photograph where there is none: {view.picture()}")
            for all_of_it in (True, False):
                try:
                    window = view.pinhole(all_of_it=all_of_it)
                except ValueError as error:
                    refusal(error)
                    continue
                if view.lens is not None and not 0 < window.width <= 2 * view.camera.width + 2:
                    raise Fault(f"a window of {window.width}x{window.height} of {view.camera}")
        return Verdict(opened=1)


TARGETS = {"capture": CaptureTarget}
