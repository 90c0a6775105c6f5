"""Lights on cases of the acceptance protocol: what `light` makes of both environments, of one of them, of pictures.

    python scripts/relight_acceptance.py CASES --environments HDRIS --cli .venv/bin/splatpainter [--only given]

CASES are folders as `make_cases.py` of the protocol makes them; their relight/lights.json names the environment that
the asset was lit by and the one that lights the novel views (SH-2 irradiance, mean luminance 0.8, no shadows). Scored
as there: dB over the object, mean of four novel views. The project is driven by its commands alone, but for
`--cut`; numpy and pillow.

Where imageio reads .hdr through OpenCV, it reads 8 bits: `make_cases.py` then lit the cases by environments cut off at
radiance 1, and HDRIS has to hold such ones (`--cut HDRIS8` writes them and uses them). Lights that no case was made in
cost 2.5 dB on one of six.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

VISIBLE_STEP = 0.02
"""Difference from the white background, from which a pixel of the truth is the object's: the protocol's own."""
DARKEST_ERROR = 1e-8
"""Mean square below which all are equal: the protocol's own."""


@dataclass(frozen=True)
class Case:
    """One asset and its new light."""

    folder: Path
    environments: Path

    @property
    def asset(self) -> str:
        return str(self.folder / "asset.ply")

    def sky(self, which: str) -> str:
        """Of "source" or "target"."""
        return str(
            self.environments / json.loads((self.folder / "relight/lights.json").read_text(encoding="utf-8"))[which]
        )

    def picture(self, count: int) -> list[str]:
        """Options that hand in relit views."""
        views = [self.folder / f"relight/edit_{number}" for number in range(count)]
        pictures = [f"{view}.png" for view in views]
        return ["--match", *pictures, "--match-camera", *(f"{view}.json" for view in views)]


def _environment(case: Case) -> list[str]:
    return ["--hdri", case.sky("target")]


ROWS: dict[str, Callable[[Case], list[str]] | None] = {
    "nothing": None,
    "best gain": None,
    "given": lambda case: [*_environment(case), "--source-light", case.sky("source")],
    "estimated": _environment,
    "picture": lambda case: case.picture(1),
    "picture, environment": lambda case: [*case.picture(1), *_environment(case)],
    "2 pictures": lambda case: case.picture(2),
    "2 pictures, environment": lambda case: [*case.picture(2), *_environment(case)],
}
"""Options of `light` of each row; None: not lit. The truth has no shadows, so none is asked for either."""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--environments", type=Path, required=True)
    parser.add_argument("--cli", required=True)
    parser.add_argument("--cut", type=Path, help="folder for environments cut off at radiance 1, used in their place")
    parser.add_argument("--only", nargs="*", choices=ROWS, default=list(ROWS))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    scores: dict[str, dict[str, float]] = {}
    skies = options.environments if options.cut is None else _cut(options.environments, options.cut)
    for folder in sorted(path for path in options.cases.iterdir() if (path / "relight/lights.json").exists()):
        scores[folder.name] = _scored(Case(folder, skies), options.cli, options.only)
        print(folder.name, ", ".join(f"{row} {value:.2f}" for row, value in scores[folder.name].items()), flush=True)
    if not scores:
        sys.exit(f"{options.cases}: expected folders with relight/lights.json, as make_cases.py writes them; got none")
    if options.json:
        options.json.write_text(json.dumps(scores, indent=1), encoding="utf-8")
    for row in options.only:
        values = np.array([case[row] for case in scores.values()])
        gains = values - np.array([case.get("nothing", np.nan) for case in scores.values()])
        print(f"{row:24s} {values.mean():6.2f} dB  gain {gains.mean():+.2f}, worst {gains.min():+.2f}  ({len(values)})")


def _cut(environments: Path, out: Path) -> Path:
    """The folder `out`, with the .hdr files of another as 8 bits hold them."""
    from splatpainter.lights.sky_maps import SkyMap, read_radiance, write_sky

    out.mkdir(parents=True, exist_ok=True)
    for path in sorted(environments.glob("*.hdr")):
        picture = np.rint(np.minimum(read_radiance(path), 1) * 255) / 255
        write_sky(out / path.name, SkyMap(picture.astype(np.float32), path.name))
    return out


def _scored(case: Case, cli: str, rows: Sequence[str]) -> dict[str, float]:
    cameras = sorted((case.folder / "relight").glob("gt_*.json"))
    truth = np.stack([_read(camera.with_suffix(".png")) for camera in cameras])
    masks = np.abs(truth - 1).max(-1) > VISIBLE_STEP
    out: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as scratch:
        plain = _drawn(cli, case.asset, cameras, Path(scratch) / "plain")
        for number, row in enumerate(rows):
            views, options = plain, ROWS[row]
            if row == "best gain":
                views = _with_best_gain(plain, truth, masks)
            elif options is not None:
                lit = str(Path(scratch) / f"{number}.ply")
                words = [cli, "light", case.asset, *options(case), "--no-shadows", "--up", "+y", "--out", lit]
                # A light that changes nothing is refused; then the asset is as it was.
                if _run(words, "nothing to do"):
                    views = _drawn(cli, lit, cameras, Path(scratch) / f"views{number}")
            out[row] = float(np.mean([_psnr(*one) for one in zip(views, truth, masks, strict=True)]))
    return out


def _run(words: Sequence[str], tolerated: str = "") -> bool:
    """Whether it did what it was asked for; another failure than the one that is tolerated ends the run."""
    done = subprocess.run(words, capture_output=True, text=True, encoding="utf-8")
    if done.returncode and not (tolerated and tolerated in done.stderr):
        sys.exit(f"{' '.join(words)}\n{done.stderr[-600:]}")
    return done.returncode == 0


def _drawn(cli: str, asset: str, cameras: Sequence[Path], out: Path) -> np.ndarray:
    """[V, H, W, 3] 0..1."""
    _run([cli, "render", asset, "--out", str(out), "--camera", *map(str, cameras)])
    return np.stack([_read(path) for path in sorted(out.glob("*.png"))])


def _with_best_gain(views: np.ndarray, truth: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """One gain per channel of display colours that fits the truth best: an upper bound of what needs no light."""
    seen, wanted = views[masks], truth[masks]
    return np.clip(views * ((seen * wanted).sum(0) / np.maximum((seen * seen).sum(0), 1e-9)), 0, 1)


def _psnr(view: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    error = float(((view[mask] - truth[mask]) ** 2).mean()) if mask.any() else 0.0
    return -10 * np.log10(max(error, DARKEST_ERROR))


def _read(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"), np.float64) / 255


if __name__ == "__main__":
    main()
