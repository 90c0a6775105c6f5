"""Programs that stand in for the systems of docs/ADAPTERS.md: they have their arguments and file names, check what they
are given with plain numpy (nothing of the package), and answer with a file that the test has made."""

from __future__ import annotations

import json
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest
from splatbench.cases import Budget

from benchmarks.tests.support.blobs import ASSET, COLORS, MEANS, PAINTED
from splatpainter.voxels.grid import bounding_cube

CHECKS = '''
import json, math, os, shutil, sys
from pathlib import Path
import numpy as np
from PIL import Image

BLOBS = json.loads(os.environ["BLOBS"])  # means, colors, Gaussians, cube corner and edge


def answer(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(os.environ["ANSWER"], path)


def ply(path):
    head, body = Path(path).read_bytes().split(b"end_header\\n", 1)
    lines = [line.split() for line in head.splitlines()]
    count = next(int(w[2]) for w in lines if w[:2] == [b"element", b"vertex"])
    kinds = {b"float": "<f4", b"uchar": "u1"}
    columns = [(w[2].decode(), kinds[w[1]]) for w in lines if w[0] == b"property" and w[1] in kinds]
    return np.frombuffer(body, columns, count)


def middles():
    """Blobs in the frame that TRELLIS wants, written out: the cube's middle at 0, its edge 1, y up turned to z up."""
    x, y, z = ((np.array(BLOBS["means"]) - BLOBS["lo"]) / BLOBS["size"] - 0.5).T
    return np.stack([x, -z, y], 1)


def shows(picture, x, y, depth):
    """The nearest blob's colour is where it is in the picture (no other blob is before it)."""
    k = int(np.argmin(depth))
    column, row = int(x[k]), int(y[k])
    error = abs(picture[row, column, :3] / 255.0 - BLOBS["colors"][k]).max()
    assert error < 0.06, f"blob {k} expected at {column}, {row}: off by {error:.3f}"


def seen_opengl(points, pose, fx, fy, cx, cy):
    """(x, y, depth) pixels of points by an OpenGL camera-to-world matrix."""
    pose = np.array(pose)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    return fx * local[:, 0] / -local[:, 2] + cx, fy * -local[:, 1] / -local[:, 2] + cy, -local[:, 2]


def check_trellis(folder, count):
    """As TRELLIS's encoder reads a folder of renders."""
    folder = Path(folder)
    told = json.loads((folder / "transforms.json").read_text())
    assert len(told["frames"]) == count, len(told["frames"])
    for frame in told["frames"]:
        picture = np.array(Image.open(folder / frame["file_path"]))
        size = picture.shape[0]
        assert picture.shape == (size, size, 4) and (picture[..., 3] == 0).any() and (picture[..., 3] > 240).any()
        focal = size / 2 / math.tan(frame["camera_angle_x"] / 2)
        where = np.array(frame["transform_matrix"])[:3, 3]
        assert abs(np.linalg.norm(where) - 2) < 1e-6 and abs(frame["camera_angle_x"] - math.radians(40)) < 1e-9
        shows(picture, *seen_opengl(middles(), frame["transform_matrix"], focal, focal, size / 2, size / 2))
    voxels = ply(folder / "voxels.ply")
    points = np.stack([voxels[a] for a in "xyz"], 1).astype(float)
    steps = (points + 0.5) * 64 - 0.5
    assert abs(steps - np.round(steps)).max() < 1e-3 and abs(points).max() < 0.5
    gaps = np.linalg.norm(points[:, None] - middles()[None], axis=2)
    assert gaps.min(0).max() < 1 / 64 and gaps.min(1).max() < 0.15, "voxels lie where the blobs are"
    assert len(ply(folder / "mesh.ply")) >= 8


def check_nerfstudio(folder):
    folder = Path(folder)
    told = json.loads((folder / "transforms.json").read_text())
    for frame in told["frames"]:
        picture = np.array(Image.open(folder / frame["file_path"]))
        assert picture.shape == (frame["h"], frame["w"], 3) and (picture[0, 0] == 0).all()
        lens = (frame["fl_x"], frame["fl_y"], frame["cx"], frame["cy"])
        shows(picture, *seen_opengl(np.array(BLOBS["means"]), frame["transform_matrix"], *lens))
    points = ply(folder / told["ply_file_path"])
    assert abs(np.stack([points[a] for a in "xyz"], 1) - BLOBS["rows"]).max() < 1e-5
    colors = np.stack([points[a] for a in ("red", "green", "blue")], 1)
    assert abs(colors / 255.0 - np.repeat(BLOBS["colors"], len(colors) // 5, 0)).max() < 0.01
    return len(told["frames"])


def check_edit(render, edited, mask):
    render, edited, mask = (np.array(Image.open(p)).astype(int) for p in (render, edited, mask))
    assert mask.ndim == 2 and set(np.unique(mask)) == {0, 255} and render.shape == edited.shape == (*mask.shape, 3)
    changed = abs(render - edited).max(-1) > 2
    assert changed.any() and not changed[mask == 0].any()


def rotation(w, x, y, z):
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                     [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                     [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])


def check_colmap(folder):
    model = Path(folder) / "sparse" / "0"
    lines = (model / "images.txt").read_text().split("\\n")
    lenses = {w[0]: w for w in map(str.split, (model / "cameras.txt").read_text().splitlines())}
    count = 0
    while lines and lines[0]:
        words, points = lines.pop(0).split(), lines.pop(0)
        assert points == "" and len(words) == 10
        _, kind, width, height, fx, fy, cx, cy = lenses[words[8]]
        assert kind == "PINHOLE" and float(cx) == int(width) / 2 and float(cy) == int(height) / 2
        turn, shift = rotation(*map(float, words[1:5])), np.array(words[5:8], float)
        local = np.array(BLOBS["means"]) @ turn.T + shift
        x = float(fx) * local[:, 0] / local[:, 2] + float(cx)
        y = float(fy) * local[:, 1] / local[:, 2] + float(cy)
        shows(np.array(Image.open(Path(folder) / "images" / words[9])), x, y, local[:, 2])
        count += 1
    for line in (model / "points3D.txt").read_text().splitlines():
        words = line.split()
        assert len(words) == 8 and all(0 <= int(c) <= 255 for c in words[4:7])
    return count
'''

VOXHAMMER = """
import argparse
parser = argparse.ArgumentParser()
for name in ("input_model", "mask_model", "image_dir", "output_dir", "render_dir"):
    parser.add_argument(f"--{name}", required=True)
args = parser.parse_args()
assert Path("assets/preset/preset_grid64.ply").exists()
check_trellis(args.render_dir, 7)
images = Path(args.image_dir)
check_edit(images / "2d_render.png", images / "2d_edit.png", images / "2d_mask.png")
data = Path(args.mask_model).read_bytes()
length = int.from_bytes(data[12:16], "little")
position = next(a for a in json.loads(data[20 : 20 + length])["accessors"] if a["type"] == "VEC3")
x, y, z = ((np.array(BLOBS["means"][BLOBS["painted"]]) - BLOBS["lo"]) / BLOBS["size"] - 0.5)
inside = (np.array(position["min"]) < [x, y, z]) & ([x, y, z] < np.array(position["max"]))
assert inside.all(), "the region holds the painted blob, y up"
assert (np.array(position["max"]) - position["min"] < 0.4).all(), "and not the others"
print("STEP 4: 3D Editing")
answer(Path(args.output_dir) / "output.glb")
"""

VINEDRESSER = """
import argparse
parser = argparse.ArgumentParser()
parser.add_argument("--input_file", required=True)
parser.add_argument("--editing_prompt", required=True)
args = parser.parse_args()
name = args.input_file.split("/")[-1].split(".")[0]
assert args.editing_prompt == "Paint it: \\"red\\"", args.editing_prompt
assert os.path.exists(f"outputs/img_Enc/{name}") and os.path.exists(f"outputs/slat/{name}_feats.pt")
assert Image.open(f"outputs/img_edit/img/{name}_editedImg.png").size == (518, 518)
int(open(f"outputs/img_edit/ID/{name}_editImgID.txt").read())
os.makedirs("PartField/data", exist_ok=True)
assert os.path.exists("PartField/configs/demo.yaml") and os.listdir("PartField/clustering_results/ply") == []
assert os.system("python PartField_segmentation.py") == 0
for part in ("feats", "coords"):
    answer(Path(f"outputs/slat/{name}_edited_{part}.pt"))
"""

ENCODE = """
def encode_into_SLAT(name):
    check_trellis(f"outputs/img_Enc/{name}", int(os.environ["VIEWS"]))
    Path(f"outputs/slat/{name}_feats.pt").write_text("latents")
"""

TORCH = """
from pathlib import Path
from types import SimpleNamespace


class cuda:
    is_available = staticmethod(lambda: False)


def device(name):
    return SimpleNamespace(type=name)


def load(path, map_location, weights_only):
    assert map_location.type == "cpu" and weights_only
    return Path(path).read_bytes()
"""

PIPELINES = """
import os
from pathlib import Path


class Decoded:
    def __init__(self, slat): self.slat = slat
    def save_ply(self, path, transform="turned"):
        assert transform is None, "Gaussians in TRELLIS's own frame"
        Path(path).write_bytes(self.slat.feats)


class TrellisTextTo3DPipeline:
    @staticmethod
    def from_pretrained(name):
        assert name == "JeffreyXiang/TRELLIS-text-xlarge" and os.path.exists(f"{name}/pipeline.json")
        return TrellisTextTo3DPipeline()
    def to(self, device): assert device.type in ("cpu", "cuda")
    def decode_slat(self, slat, formats):
        assert formats == ["gaussian"] and slat.coords is not None
        return {"gaussian": [Decoded(slat)]}
"""

DGE = """
assert sys.argv[1:4] == ["--config", "configs/dge.yaml", "--train"] and os.path.exists("configs/dge.yaml")
assert os.path.exists("load/prompt_library.json")
given = {word.split("=", 1)[0]: json.loads(word.split("=", 1)[1]) for word in sys.argv[4:]}
assert given["system.prompt_processor.prompt"] == "Paint it: \\"red\\"" and given["use_timestamp"] is False
assert check_colmap(given["data.source"]) == 9
asset = ply(given["system.gs_source"])
assert abs(np.stack([asset[a] for a in "xyz"], 1) - BLOBS["rows"]).max() == 0
assert given["trainer.max_steps"] == 1500 and given["seed"] == 3
Path("edit_cache").mkdir(exist_ok=True)
answer(Path(given["exp_root_dir"]) / "dge" / given["tag"] / "save" / "last.ply")
"""

TRAIN = """
method, words = sys.argv[1], sys.argv[2:]
given = dict(zip(words[::2], words[1::2], strict=True))
assert given["--viewer.quit-on-train-completion"] == "True" and given["--pipeline.model.background-color"] == "black"
base = Path(given["--output-dir"]) / given["--experiment-name"] / method / given["--timestamp"]
models = base / "nerfstudio_models"
models.mkdir(parents=True)
first = 0
if method == "splatfacto":
    assert check_nerfstudio(given["--data"]) == 9 and given["--max-num-iterations"] == "20000"
    last = 19999
else:
    assert method == "igs2gs" and given["--pipeline.prompt"] == "Paint it: \\"red\\""
    loaded = sorted(os.listdir(given["--load-dir"]))[-1]
    assert loaded == "step-000019999.ckpt"
    last = 20000 + int(os.environ.get("STEPS", "7500")) - 1
    (base / "config.yml").write_text("method: igs2gs")
    shutil.copy(os.environ["PARSER"], base / "dataparser_transforms.json")
(models / f"step-{last:09d}.ckpt").write_text("weights")
"""

EXPORT = """
assert sys.argv[1] == "gaussian-splat"
given = dict(zip(sys.argv[2::2], sys.argv[3::2], strict=True))
assert Path(given["--load-config"]).read_text() == "method: igs2gs"
answer(Path(given["--output-dir"]) / "splat.ply")
"""


def write(path: Path, text: str, checks: bool = True) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text((CHECKS if checks else "") + textwrap.dedent(text))
    return path


def checkouts(folder: Path) -> dict[str, str]:
    """Stand-in checkouts of each system that has one; system -> table of the adapters file (device cpu)."""
    hammer, vine, edge, plugin = (folder / name for name in ("hammer", "vine", "dge", "plugin"))
    write(hammer / "inference.py", VOXHAMMER)
    for file in ("voxhammer/a", "trellis/a", "assets/preset/preset_grid64.ply"):
        write(hammer / file, "", checks=False)
    write(vine / "main.py", VINEDRESSER)
    write(vine / "PartField_segmentation.py", "", checks=False)
    write(vine / "PartField" / "configs" / "demo.yaml", "", checks=False)
    write(vine / "data" / "owl.glb", "", checks=False)
    write(vine / "JeffreyXiang" / "TRELLIS-text-xlarge" / "pipeline.json", "{}", checks=False)
    write(vine / "encode_asset" / "encode_into_SLAT.py", ENCODE)
    write(vine / "trellis" / "__init__.py", "", checks=False)
    write(vine / "trellis" / "pipelines.py", PIPELINES, checks=False)
    write(vine / "torch.py", TORCH, checks=False)
    sparse = "class SparseTensor:\n    def __init__(self, feats, coords): self.feats, self.coords = feats, coords\n"
    write(vine / "trellis" / "modules" / "sparse.py", sparse, checks=False)
    write(edge / "launch.py", DGE)
    write(edge / "configs" / "dge.yaml", "", checks=False)
    write(edge / "load" / "prompt_library.json", "{}", checks=False)
    for file in ("threestudio/a", "gaussiansplatting/a"):
        write(edge / file, "", checks=False)
    write(plugin / "nerfstudio" / "scripts" / "train.py", TRAIN)
    write(plugin / "nerfstudio" / "scripts" / "exporter.py", EXPORT)
    head = f"python = {str(sys.executable)!r}\ndevice = 'cpu'\nsize = 48\ntimeout_seconds = 60\n"
    prompt = "prompts = { stroke = 'Paint it: \"red\"' }\n"
    return {
        "voxhammer": head + f"repository = '{hammer}'\nviews = 7\n",
        "vinedresser3d": head + prompt + f"repository = '{vine}'\n",
        "dge": head + prompt + f"repository = '{edge}'\nviews = 9\narguments = ['trainer.max_steps=1500']\n",
        "instruct-gs2gs": head + prompt + "views = 9\n",
        "relitlrm": head,
    }


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Budget]:
    """Stand-ins of all systems; a function that writes the adapters file for one of them."""
    lo, size = bounding_cube(ASSET)
    scene = {"means": MEANS.astype("float32").tolist(), "colors": COLORS.tolist(), "painted": PAINTED}
    scene["rows"] = ASSET.means.tolist()
    scene["rows"] = ASSET.means.tolist()
    monkeypatch.setenv("BLOBS", json.dumps(scene | {"lo": lo.tolist(), "size": size}))
    monkeypatch.setenv("ANSWER", str(tmp_path / "answer"))
    monkeypatch.setenv("GEMINI_API_KEY", "not a real one")
    tables = checkouts(tmp_path)

    def file(name: str, more: str = "", views: int = 9) -> Budget:
        path = tmp_path / "adapters.toml"
        path.write_text(f"[{name}]\n{tables[name]}{more}\n".replace("views = 9", f"views = {views}"))
        return Budget(adapters=path, scratch=tmp_path / "scratch", seed=3)

    return file
