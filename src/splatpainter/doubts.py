"""What looks wrong about an asset that was read: each doubt in one line, of what was seen, what it means, what to do.

A doubt refuses nothing: the file may be right and unusual. Used by `info`, `render`, `edit` and the other commands that
open an asset, and by the studio when one is opened. What a reader cannot keep or shows otherwise is in
`Source.problems`; files that are no splats at all are refused by io/foreign_files.py. Knows no renderer.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.color import base_color
from splatpainter.io import positions
from splatpainter.io.formats.ply import PlyFile
from splatpainter.io.formats.unwritten import unwritten_rows
from splatpainter.order_statistics import median, quantile
from splatpainter.splats import SH_C0, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_max


@dataclass(frozen=True)
class DoubtThresholds:
    """What makes an asset look wrong. Source: taste, tried on files of other programs."""

    min_drawn_opacity: float = 1 / 255
    """Opacity below which nothing is drawn."""
    min_rows: int = 16
    """Gaussians from which a distribution of values says something."""
    max_sample: int = 1 << 16
    """Gaussians, evenly spread over the rows, that are judged by their distribution."""
    nearly_all: float = 0.999
    """Share of the values that counts as all of them."""
    min_better_fit: float = 4.0
    """Factor by which sizes fit the distance between neighbours better without exp than with it, from which they look
    activated."""
    coarse_step: float = 0.25
    """Sizes of a Gaussian between neighbouring positions from which rounding is seen."""
    bright: float = 4.0
    """Base colour from which, as the median of all, colours are on another scale than 0 to 1."""
    solid: float = 1 - 1e-7
    """Opacity that only logits of 16 and more have: of opacities from 0 to 1 there are none."""
    mostly: float = 0.5
    """Share of all Gaussians that are as solid from which their opacities are on another scale."""
    dark: float = 0.02
    """Base colour up to which all are black."""


DOUBTS = DoubtThresholds()


LOG_FORMATS = ("ply", "compressed.ply")
"""Formats of log-scales and logits in which exporters have stored the values themselves."""


ALL_AT_ONCE = "all moments are shown at once"
OTHER_FALL_OFF = "Gaussians are shown in place of its own fall-off, so it looks blurred or too thin"
OTHER_GAUSSIANS = (
    ("trbf_center", "trbf_scale", "Spacetime Gaussians", ALL_AT_ONCE),
    ("motion_0", "motion_1", "Gaussians that move", ALL_AT_ONCE),
    ("t", "scale_t", "4D Gaussians", ALL_AT_ONCE),
    ("beta", "sb_params_0", "Beta Splatting", OTHER_FALL_OFF),
    ("shape", "opacity", "Generalized Exponential Splatting", OTHER_FALL_OFF),
)
"""(column, another one, whose they are, what is seen of them here)."""


@dataclass(frozen=True)
class Doubt:
    """One doubt about an asset."""

    seen: str
    """What is so, with numbers."""
    meaning: str
    """What that means for the picture."""
    remedy: str
    """What to do."""

    @property
    def line(self) -> str:
        return f"{self.seen}: {self.meaning}; {self.remedy}"


def doubts(splats: Splats) -> tuple[Doubt, ...]:
    """Everything doubtful about an asset as it was read (with its source), the gravest first. Reads no file."""
    with np.errstate(all="ignore"):  # of extreme or damaged Gaussians
        # Where nothing is drawn, every other doubt is about numbers that nobody sees.
        nothing = _nothing_drawn(splats)
        if nothing is not None:  # and why, where a file says it
            reason = _unwritten_rows(splats, splats) or _log_scales_in_glb(splats, splats)
            return (nothing,) if reason is None else (reason, nothing)
        few = _sample(splats)
        looks = (
            *(
                _activated,
                _opacity_scale,
                _unfiltered,
                _other_gaussians,
                _log_scales_in_glb,
                _order_of_harmonics,
                _lossy_planes,
                _rotations_without_alpha,
                _opacities_without_alpha,
                _unwritten_rows,
                _transform_left_out,
                _coarse_positions,
            ),
            *(_changed_as_text, _color_scale, _colors),
        )
        return tuple(doubt for look in looks if (doubt := look(splats, few)) is not None)


def doubts_of_view(splats: Splats, camera: Camera, name: str = "the view") -> tuple[Doubt, ...]:
    """Whether a camera sees any Gaussian; name: of the view, for the line."""
    # Only what could be seen from anywhere: an asset of invisible Gaussians has its own doubt.
    drawn = _drawn(splats)
    if not drawn.any():
        return ()
    arrays = splats.numpy()
    with np.errstate(all="ignore"):
        pixels, depth = camera.within(splats.offset).project(arrays.means[drawn])
        # Three standard deviations, as large as the Gaussian is seen at its depth.
        reach = 3 * row_max(arrays.scales[drawn]) * max(camera.fx, camera.fy) / np.maximum(depth, 1e-30)
        x, y = pixels.T
        across = (x > -reach) & (x < camera.width + reach)
        seen = (depth > 0) & across & (y > -reach) & (y < camera.height + reach)
    if seen.any():
        return ()
    behind = int((depth <= 0).sum())
    where = "all are behind the camera" if behind == len(depth) else "all are beside the picture or behind the camera"
    return (
        Doubt(
            f"{name}: none of {len(depth):,} Gaussians is in view",
            f"the picture is empty ({where})",
            "check that the camera is of this asset, in its axes and units (info shows where it is)",
        ),
    )


def _drawn(splats: Splats) -> np.ndarray:
    """[N] bool: Gaussians that can be seen from somewhere."""
    return splats.drawable & (splats.numpy().opacities >= DOUBTS.min_drawn_opacity)


def _sample(splats: Splats) -> Splats:
    """Some of what is drawn, with its base colours alone: the other bands would be most of what is copied."""
    rows, arrays = np.flatnonzero(_drawn(splats)), splats.numpy()
    rows = rows[:: max(1, len(rows) // DOUBTS.max_sample)]
    return replace(arrays.geometry(rows), sh=arrays.sh[rows, :1])


def _nothing_drawn(splats: Splats) -> Doubt | None:
    count = len(splats)
    if not count:
        return Doubt("the file holds no Gaussian", "every picture of it is empty", "export the asset again")
    drawable = splats.drawable
    if not drawable.any():
        why = "NaN, infinite or out of range, see the problems that info lists"
        return Doubt(
            f"none of {count:,} Gaussians can be drawn ({why})",
            "every picture of it is empty: training or an export went wrong",
            "export the asset again, or take an earlier checkpoint",
        )
    if not _drawn(splats).any():
        return Doubt(
            f"all of {count:,} Gaussians are transparent (opacity below 1/255)",
            "every picture of it is empty",
            "export the asset again; opacities may have been stored on another scale",
        )
    return None


def _activated(splats: Splats, few: Splats) -> Doubt | None:
    """Scales and opacities stored as they are, where logarithms and logits are expected; and colours for f_dc."""
    if splats.source is None or splats.source.format not in LOG_FORMATS or len(few) < DOUBTS.min_rows:
        return None
    # Each of three signs alone is enough; told in one doubt, as one mistake of an exporter makes them all. The reader
    # took exp and the sigmoid already: undone here, as the doubt is about what the file holds, where it may come to it.
    parts: list[tuple[str, str, str, str]] = []
    base, wide = few.sh[:, 0], (few.scales > 1).mean() >= DOUBTS.nearly_all
    if wide and _fits_better_without_exp(few):
        logs = np.log(few.scales.astype(np.float64))
        seen = f"scale_0..2 are all above 0 ({logs.min():.2g} to {logs.max():.2g})"
        parts.append((seen, "log", "sizes", "log for scales"))
    if _has_logits_of_opacities(few.opacities):
        logits = _logits(few.opacities)
        seen = f"opacity is all within 0..1 ({logits.min():.3g} to {logits.max():.3g})"
        parts.append((seen, "logit", "opacities", "logit for opacities"))
    if (
        _has_column(splats, "f_dc_0")
        and base.min() >= 0
        and base.max() <= 1
        and base.min() < 0.25
        and base.max() > 0.75
    ):
        seen = f"f_dc_0..2 are all within 0..1 ({base.min():.2g} to {base.max():.2g})"
        parts.append((seen, "offset and factor of SH", "colours", f"(colour - 0.5) / {SH_C0:.4f} for f_dc"))
    if not parts:
        return None
    seen, steps, wrong, remedies = zip(*parts, strict=True)
    return Doubt(
        ", ".join(seen),
        f"the values look activated (stored without {', '.join(steps)}), so {' and '.join(wrong)} are shown wrong",
        f"export again as INRIA's PLY has it ({', '.join(remedies)})",
    )


def _has_logits_of_opacities(opacities: np.ndarray) -> bool:
    """Whether nearly all logits are within 0 to 1, as opacities are."""
    # The sigmoid of 0 to 1 is 0.5 to 0.73: most assets need no logarithm to be told from that.
    if ((opacities > 0.49) & (opacities < 0.74)).mean() < DOUBTS.nearly_all:
        return False
    logits = _logits(opacities)
    return bool(((logits >= -1e-6) & (logits <= 1 + 1e-6)).mean() >= DOUBTS.nearly_all)


def _logits(opacities: np.ndarray) -> np.ndarray:
    values = opacities.astype(np.float64)
    return np.log(values) - np.log1p(-values)


def _fits_better_without_exp(few: Splats) -> bool:
    """Whether sizes taken as stored fit the distance between Gaussians better than their exp does, as if they lay
    evenly on a sphere of the asset's extent."""
    # Medians, as floaters and background Gaussians are few and extreme.
    points = few.means.astype(np.float64)
    radius = float(median(np.linalg.norm(points - median(points), axis=1)))
    spacing = radius * np.sqrt(4 * np.pi / len(few))
    size = float(median(row_max(few.scales)))
    if not (spacing > 0 and size > 1):
        return False
    return abs(np.log(size / spacing)) > abs(np.log(np.log(size) / spacing)) + np.log(DOUBTS.min_better_fit)


def _log_scales_in_glb(splats: Splats, few: Splats) -> Doubt | None:
    source = splats.source
    if source is None or source.format != "glb":
        return None
    # The reader knows the programs that did so and has undone it; that other programs will not is what is told.
    generator = getattr(source.detail, "log_scales", "")
    if generator:
        return Doubt(
            f"written by {generator}, which stored logarithms as SCALE",
            "read as such here, but programs that follow the standard show Gaussians of wrong sizes",
            "for them, convert it to .ply and that to .glb",
        )
    negative = float((splats.numpy().scales < 0).any(1).mean())
    if negative < 0.5:
        return None
    return Doubt(
        f"SCALE is negative in {100 * negative:.0f} % of the Gaussians",
        "they are probably logarithms, which the standard does not allow, so that most Gaussians are not drawn",
        "export again with a newer program (splat-transform from 2.7.0 on)",
    )


def _order_of_harmonics(splats: Splats, few: Splats) -> Doubt | None:
    source = splats.source
    if source is None or source.format != "ksplat" or not source.detail:
        return None
    return Doubt(
        f"written by {source.detail}, which stores SH of .ksplat channel by channel and not band by band",
        "read as such here, but other viewers show wrong colours from the side",
        "for them, convert it to .ply or .spz",
    )


def _lossy_planes(splats: Splats, few: Splats) -> Doubt | None:
    source = splats.source
    if source is None or source.format != "sog":
        return None
    from splatpainter.io.formats import packing  # of SOG alone

    file = source.detail
    names = [name for name, data in file.container.files.items() if packing.is_lossy_webp(data)]
    if not names:
        return None
    listed = ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
    return Doubt(
        f"{listed}: lossy WebP",
        "SOG keeps numbers in its pixels, which lossy compression changed: positions and colours are scattered",
        "export again with lossless WebP; an image optimiser may have been at the files",
    )


def _rotations_without_alpha(splats: Splats, few: Splats) -> Doubt | None:
    """A rotation's largest component is named by the alpha of its pixel: 255, where an image has none, is z for all."""
    source = splats.source
    if source is None or source.format != "sog" or len(splats) < DOUBTS.min_rows:
        return None
    pixels = source.detail.pixels["quats"]
    # Equal rotations of all Gaussians may well be so.
    if (pixels[:, 3] != 255).any() or (pixels[:, :3] == pixels[0, :3]).all():
        return None
    return Doubt(
        "the image of the rotations has no transparency",
        "which component of each rotation is the largest was lost with it, so that most Gaussians point elsewhere",
        "export again; an image optimiser may have been at the files",
    )


def _opacities_without_alpha(splats: Splats, few: Splats) -> Doubt | None:
    """Opacities are the alpha of the colours' pixels: 1 for all, where an image has none."""
    source = splats.source
    if source is None or source.format != "sog" or len(splats) < DOUBTS.min_rows:
        return None
    colors = source.detail.pixels.get("sh0")
    if colors is None or (colors[:, 3] != 255).any():
        return None
    return Doubt(
        "the image of the colours has no transparency",
        "every Gaussian is opaque, which trained ones are not: their opacities were lost with it",
        "export again, unless all are meant so; an image optimiser may have been at the files",
    )


def _transform_left_out(splats: Splats, few: Splats) -> Doubt | None:
    source = splats.source
    if source is None or source.format != "glb":
        return None
    from splatpainter.io.formats.glb import NOT_APPLIED  # of GLB alone

    if NOT_APPLIED not in source.problems:
        return None
    return Doubt(
        "its node has a mirroring, a shear or a scale that differs between axes",
        "that is kept in the file but not applied: pictures show the asset of other proportions than the file asks",
        "apply the transform in the program that wrote it (Blender: Apply, All Transforms), and export again",
    )


def _unwritten_rows(splats: Splats, few: Splats) -> Doubt | None:
    """Rows of zeros: of a download or copy that was not finished, whose disk space was set aside before."""
    count = unwritten_rows(splats)
    if not count:
        return None
    return Doubt(
        f"{count:,} of {len(splats):,} rows hold zeros alone",
        "they were probably never written, by a download, a copy or a disk that failed: a part of the asset is missing",
        "get the file again",
    )


def _coarse_positions(splats: Splats, few: Splats) -> Doubt | None:
    # In sizes of a Gaussian, as the same step is harmless for a landscape and ruins a cup.
    step = positions.steps_in_sizes(few.world_means, few.scales)
    if step < DOUBTS.coarse_step or _holds_doubles(splats):
        return None
    distinct, rows = len(np.unique(few.means, axis=0)), len(few)
    return Doubt(
        f"positions so far from 0 that float32 has steps of {step:.2g} sizes of a Gaussian there "
        f"({distinct:,} of {rows:,} are distinct)",
        "they were rounded when the file was written, and cannot be restored from it",
        "export again near 0, or as .ply with double x, y, z",
    )


def _holds_doubles(splats: Splats) -> bool:
    record = splats.source.detail if splats.source is not None else None
    if not isinstance(record, PlyFile):
        return any(splats.offset)
    vertex = record.header.element("vertex")
    types = {p.name: p.type for p in vertex.properties} if vertex is not None else {}
    text = record.header.format == "ascii"
    return all(types.get(name) == "f8" or text for name in ("x", "y", "z"))


def _opacity_scale(splats: Splats, few: Splats) -> Doubt | None:
    """Opacities of 0 to 255, or 0 to 100, in place of logits: all but the emptiest are drawn solid."""
    if not _has_column(splats, "opacity"):
        return None
    # In float32 the sigmoid of 16 and more is 1, so what the file held is not seen in it; training gives few of them.
    solid = few.opacities >= DOUBTS.solid
    if len(few) < DOUBTS.min_rows or solid.mean() < DOUBTS.mostly or few.opacities.min() < 0.5:
        return None
    return Doubt(
        f"opacity is 16 or more in {100 * solid.mean():.0f} % of the Gaussians, and nowhere below 0",
        "as logits of opacity that is all solid: opacities of 0 to 255 or 0 to 100 were probably stored as they are",
        "export again as INRIA's PLY has it (logit for opacities)",
    )


def _unfiltered(splats: Splats, few: Splats) -> Doubt | None:
    """Mip-Splatting's column of filter sizes (Yu et al. 2024, eq. 8), which its own viewer adds to scales and takes off
    opacities."""
    if not _has_column(splats, "filter_3D"):
        return None
    return Doubt(
        "has a column filter_3D (Mip-Splatting)",
        "its 3D filter is not applied here, nor in other viewers: Gaussians are shown too small and too opaque",
        "fuse it first (create_fused_ply.py of Mip-Splatting)",
    )


def _other_gaussians(splats: Splats, few: Splats) -> Doubt | None:
    """Columns of Gaussians that move in time, or whose fall-off is another: of Spacetime Gaussians (Li et al. 2024), 4D
    Gaussians (Yang et al. 2024), Deformable Beta Splatting (Liu et al. 2025), Generalized
    Exponential Splatting (Hamdi et al. 2024)."""
    for column, beside, what, effect in OTHER_GAUSSIANS:
        if _has_column(splats, column) and _has_column(splats, beside):
            return Doubt(
                f"has columns {column}, {beside} ({what})",
                f"{effect}; these columns are kept, but neither drawn nor edited",
                "export one moment of it, or train it, as plain 3D Gaussians",
            )
    return None


def _has_column(splats: Splats, name: str) -> bool:
    record = splats.source.detail if splats.source is not None else None
    vertex = record.header.element("vertex") if isinstance(record, PlyFile) else None
    return vertex is not None and name in vertex.names


def _changed_as_text(splats: Splats, few: Splats) -> Doubt | None:
    """Binary data sent as text (FTP, or git without .gitattributes): each line feed has become two bytes."""
    record = splats.source.detail if splats.source is not None else None
    if not isinstance(record, PlyFile) or record.header.format == "ascii" or record.header.newline != b"\r\n":
        return None
    # As many bytes too many as there are line feeds, and none of these alone: by chance 255 of 256 would be.
    data = bytes(record.rows.stored()) if record.after else b""
    feeds = (data + record.after).count(b"\n")
    if not feeds or (data + record.after).count(b"\r\n") != feeds or feeds != len(record.after):
        return None
    return Doubt(
        f"every line feed among the binary numbers follows a carriage return, and {len(record.after):,} bytes are left",
        "the file was sent or stored as text, which moves all numbers behind the first such byte",
        "copy the original again, as binary (in git: *.ply binary in .gitattributes)",
    )


def _color_scale(splats: Splats, few: Splats) -> Doubt | None:
    record = splats.source.detail if splats.source is not None else None
    if not isinstance(record, PlyFile) or record.color_span != 255:
        return None
    vertex = record.header.element("vertex")
    kind = next((p.type for p in vertex.properties if p.name == "red"), "u1") if vertex is not None else "u1"
    if kind == "u1":
        return None
    words = {"f": "floats", "i": "signed integers", "u": "integers of more than 8 bits"}[kind[0]]
    return Doubt(
        f"red, green and blue are {words} of at most 255",
        "they are read as 0..255, which their type does not say: other programs show them black or far too bright",
        "export again with uchar colours or f_dc_0..2",
    )


def _colors(splats: Splats, few: Splats) -> Doubt | None:
    if len(few) < DOUBTS.min_rows:
        return None
    # By median and nearly all, so that a few damaged rows raise no doubt about the asset.
    base = np.asarray(base_color(few.sh))
    middle, most = float(median(base.ravel())), float(quantile(base.ravel(), DOUBTS.nearly_all))
    if middle > DOUBTS.bright:
        return Doubt(
            f"base colours reach {base.max():.3g} (median {middle:.3g}), where 0 to 1 is expected",
            "everything is shown white: colours of 0 to 255 were probably stored without dividing by 255",
            "export again with colours of 0 to 1, or as f_dc_0..2",
        )
    if most <= DOUBTS.dark and splats.sh.shape[1] == 1:
        return Doubt(
            f"all base colours are black (at most {most:.2g})",
            "colours were probably stored on another scale, such as integers of more than 8 bits",
            "export again with uchar red, green, blue or with f_dc_0..2",
        )
    return None
