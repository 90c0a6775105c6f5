"""Training on a machine that starts bare, has Python with PyTorch, no internet, and takes and gives back little, a few
minutes at a time.

    scripts/pack_training.py pack --out packed.tar --meshes meshes/ --wheels wheels/ [--run runs/refine]  here
    bash run.sh refine --minutes 8 ...                      there, where packed.tar was unpacked; makes back/part-*.bin
    scripts/pack_training.py unpack back/ --run runs/refine                                              here again

docs/TRAINING.md describes the whole round.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import struct
import sys
import tarfile
from pathlib import Path

MIB = 1 << 20
ROOT = Path(__file__).resolve().parents[1]
RUN_FILES = ("state", "model", "log.csv", "validation.csv", "recipe.json", "sheets")
"""What of a run travels."""
RUN = """#!/bin/bash
# usage: bash run.sh STAGE [options of `splatpainter train STAGE`]; OUT, if set, is the folder whose files come back.
set -euo pipefail
cd "$(dirname "$0")"
if compgen -G "wheels/*.whl" > /dev/null; then
  python3 -m pip install -q --no-index --no-deps --no-compile --no-cache-dir --upgrade --target site wheels/*.whl
fi
export PYTHONPATH="$PWD/src:$PWD/site" PYTHONUNBUFFERED=1
[ -d perceptual ] && export SPLATPAINTER_PERCEPTUAL="$PWD/perceptual"
stock=()
for kind in environments decals fonts textures; do [ -d "$kind" ] && stock+=("--$kind" "$kind"); done
data=(); [ -d meshes ] && data=(--data meshes)
start=(); [ -d weights ] && start=(--weights weights)
status=0
python3 -m splatpainter train "$@" "${data[@]}" "${stock[@]}" "${start[@]}" --out run --resume --compact-state \\
  2>&1 | tee train.log || status=$?
cp train.log run/ 2>/dev/null || true
python3 scripts/pack_training.py split run --out "${OUT:-back}"
exit $status
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    pack_ = commands.add_parser("pack", help="code, data and wheels into one tar file")
    pack_.add_argument("--out", type=Path, required=True)
    pack_.add_argument("--meshes", type=Path, help="folder of GLB files; none: train with --data procedural:N")
    pack_.add_argument("--texture", type=int, default=256, help="largest edge of a texture, pixels")
    pack_.add_argument("--most", type=float, default=40.0, help="MiB of meshes; the smallest go first")
    for kind in ("environments", "decals", "fonts", "textures", "perceptual"):
        pack_.add_argument(f"--{kind}", type=Path)
    pack_.add_argument("--wheels", type=Path, nargs="*", default=[], help=".whl files, or folders of them")
    pack_.add_argument("--run", type=Path, help="folder of a run to go on with")
    pack_.add_argument("--weights", type=Path, help="checkpoint to start from")
    pack_.add_argument("--limit", type=float, default=63.0, help="MiB of the whole")
    split_ = commands.add_parser("split", help="a run as files of bounded size")
    split_.add_argument("run", type=Path)
    split_.add_argument("--out", type=Path, required=True)
    split_.add_argument("--size", type=float, default=15.0, help="MiB of a file")
    split_.add_argument("--files", type=int, default=8)
    unpack_ = commands.add_parser("unpack", help="a run from these files")
    unpack_.add_argument("parts", type=Path)
    unpack_.add_argument("--run", type=Path, required=True)
    given = parser.parse_args()
    try:
        {"pack": pack, "split": lambda a: split(a.run, a.out, a.size, a.files), "unpack": unpack}[given.command](given)
    except (ValueError, OSError) as error:
        sys.exit(f"pack_training: {error}")


def pack(given: argparse.Namespace) -> None:
    """Write the tar file. Raises ValueError where it would be larger than the limit, naming its largest parts."""
    sizes: dict[str, int] = {}
    with tarfile.open(given.out, "w") as tar:

        def add(name: str, data: bytes) -> None:
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            tar.addfile(entry, io.BytesIO(data))
            sizes[name.split("/")[0]] = sizes.get(name.split("/")[0], 0) + len(data)

        def add_tree(folder: Path, under: str) -> None:
            for file in sorted(folder.rglob("*")):
                if file.is_file() and "__pycache__" not in file.parts:
                    add(f"{under}/{file.relative_to(folder).as_posix()}", file.read_bytes())

        add("run.sh", RUN.encode())
        add_tree(ROOT / "src" / "splatpainter", "src/splatpainter")
        add("scripts/pack_training.py", Path(__file__).read_bytes())
        if given.meshes:
            reduced = sorted(
                ((reduce_glb(f.read_bytes(), given.texture), f) for f in given.meshes.rglob("*.glb")),
                key=lambda x: len(x[0]),
            )
            room = given.most * MIB
            for data, file in reduced:
                room -= len(data)
                if room >= 0:
                    add(f"meshes/{file.relative_to(given.meshes).as_posix()}", data)
        for kind in ("environments", "decals", "fonts", "textures", "perceptual", "weights"):
            if getattr(given, kind):
                add_tree(getattr(given, kind), kind)
        for path in given.wheels:
            for wheel in sorted(path.glob("*.whl")) if path.is_dir() else [path]:
                add(f"wheels/{wheel.name}", wheel.read_bytes())
        if given.run:
            for name in RUN_FILES[:-1]:  # sheets need not travel back
                part = given.run / name
                add_tree(part, f"run/{name}") if part.is_dir() else add(f"run/{name}", part.read_bytes())
    listed = ", ".join(f"{name} {size / MIB:.1f}" for name, size in sorted(sizes.items(), key=lambda x: -x[1]))
    if given.out.stat().st_size > given.limit * MIB:
        given.out.unlink()
        raise ValueError(f"expected at most {given.limit} MiB, got {listed}; lower --most or --texture")
    print(f"{given.out}: {given.out.stat().st_size / MIB:.1f} MiB ({listed})")


def split(run: Path, out: Path, size: float, files: int) -> None:
    """A run's tar file in parts of `size` MiB. Without its sheets, and then without its model (which the state holds
    too), where all would be too much. Raises ValueError where the state alone is."""
    names = [name for name in (*RUN_FILES, "train.log") if (run / name).exists()]
    packed = b""
    for left_out in ((), ("sheets",), ("sheets", "model")):
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w:gz", compresslevel=1) as tar:
            for name in names:
                if name not in left_out:
                    tar.add(run / name, name)
        packed = buffer.getvalue()
        if len(packed) <= files * size * MIB:
            break
    else:
        raise ValueError(
            f"{run}: expected at most {files} x {size} MiB, got {len(packed) / MIB:.1f}; train with --compact-state"
        )
    out.mkdir(parents=True, exist_ok=True)
    step = int(size * MIB)
    for k in range(0, max(len(packed), 1), step):
        (out / f"part-{k // step}.bin").write_bytes(packed[k : k + step])
    print(f"{out}: {len(packed) / MIB:.1f} MiB in {-(-len(packed) // step)} files")


def unpack(given: argparse.Namespace) -> None:
    """Put a run together from its parts. Its old state stays until all of the new one is there."""
    parts = sorted(given.parts.glob("part-*.bin"))
    if not parts:
        raise ValueError(f"{given.parts}: holds no part-*.bin")
    fresh = given.run.with_name(given.run.name + ".part")
    shutil.rmtree(fresh, ignore_errors=True)
    try:
        with tarfile.open(fileobj=io.BytesIO(b"".join(p.read_bytes() for p in parts)), mode="r:gz") as tar:
            tar.extractall(fresh, filter="data")
    except (tarfile.TarError, EOFError) as error:
        raise ValueError(f"{given.parts}: parts are missing or damaged ({error}); copy all of them again") from None
    for item in fresh.iterdir():
        old = given.run / item.name
        if item.name == "sheets" and old.is_dir():
            shutil.copytree(item, old, dirs_exist_ok=True)
            continue
        old.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(old) if old.is_dir() else old.unlink(missing_ok=True)
        item.replace(old)
    shutil.rmtree(fresh)
    print(f"{given.run}: {', '.join(sorted(p.name for p in given.run.iterdir()))}")


def reduce_glb(data: bytes, edge: int) -> bytes:
    """A GLB with its pictures at most `edge` pixels wide and high, as JPEG (PNG where they are transparent). One that
    cannot be read comes back as it is: training skips and counts it."""
    from PIL import Image

    try:
        magic, _, _, length, kind = struct.unpack_from("<4sIIII", data)
        assert magic == b"glTF" and kind == 0x4E4F534A
        scene = json.loads(data[20 : 20 + length])
        start = 20 + length + 8
        views = scene.get("bufferViews", [])
        held = [data[start + v.get("byteOffset", 0) :][: v["byteLength"]] for v in views]
        for image in scene.get("images", []):
            if "bufferView" not in image:
                continue
            picture = Image.open(io.BytesIO(held[image["bufferView"]]))
            see_through = picture.mode in ("RGBA", "LA", "PA") or "transparency" in picture.info
            picture = picture.convert("RGBA" if see_through else "RGB")
            picture.thumbnail((edge, edge), Image.Resampling.LANCZOS)
            buffer = io.BytesIO()
            form = "PNG" if see_through else "JPEG"
            picture.save(buffer, form, **({} if see_through else {"quality": 88}))
            held[image["bufferView"]], image["mimeType"] = buffer.getvalue(), f"image/{form.lower()}"
    except Exception:  # whatever a broken file makes a decoder raise
        return data
    body = b""
    for view, part in zip(views, held, strict=True):
        view["byteOffset"], view["byteLength"], view["buffer"] = len(body), len(part), 0
        body += part + b"\0" * (-len(part) % 4)
    scene["buffers"] = [{"byteLength": len(body)}]
    text = json.dumps(scene, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(body)
    head = struct.pack("<4sIIII", b"glTF", 2, total, len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", len(body), 0x004E4942) + body


if __name__ == "__main__":
    main()
