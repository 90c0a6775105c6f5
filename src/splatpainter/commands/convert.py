"""`splatpainter convert`: from one format to another, and what that costs. Renders nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from splatpainter.cameras import AUTO_UP, UPS, orbit_cameras
from splatpainter.commands import Outcome
from splatpainter.commands.info import file_size
from splatpainter.commands.parts.asset_doubts import warn_of_doubts
from splatpainter.commands.parts.option_marks import Argument, Positional
from splatpainter.commands.parts.option_parsing import AssetFile, AxesOption, InAxesOption
from splatpainter.commands.parts.terminal import count, size, stages
from splatpainter.io import axes_are_news, axes_line, chosen_axes, files, read, write, written_axes
from splatpainter.io.axes import AXES
from splatpainter.io.formats import ply
from splatpainter.io.formats.packing import morton_order
from splatpainter.io.losses import MIN_DRAWN_OPACITY, Losses, loss_line, measure, moved_share_sorted
from splatpainter.io.ply_columns import add_columns
from splatpainter.io.write_options import AS_IT_IS, WriteOptions
from splatpainter.kernels.parallel import beside
from splatpainter.output_paths import check_target, placed, splat_format
from splatpainter.splats import Axes, Splats
from splatpainter.system.quick_dataclass import dataclass

HTML = ".html"
SEEN_IN_THE_FILE = {"sh_degree": None, "antialiased": None, "spz_version": None, "mark_axes": None}
"""Options whose losses are seen in what was read again."""
PAGE_BACKGROUND = (0.16, 0.17, 0.18)


@dataclass(frozen=True)
class Config:
    """Convert a splat file; the name of OUT says the format, rows keep their order unless --sort is given.

    Formats: .ply, .compressed.ply, .splat, .spz, .sog, FOLDER/meta.json (SOG), .glb; .ksplat can only be read. OUT.html
    is a page that shows the asset by itself, from disk and without any request.

    example:
      splatpainter convert vase.ply vase.sog
      splatpainter convert vase.ply vase.html
      splatpainter convert vase.ply vase.spz --axes rub    # for the few programs that turn SPZ files
      splatpainter convert vase.ply small.spz --sh-degree 1 --sh-bits 4 --spz-version 4
    """

    asset: AssetFile
    """The file to read."""
    out: Annotated[Positional[Path], Argument(metavar="OUT")]
    """The file to write."""
    in_axes: InAxesOption = "auto"
    """Axes of the file's numbers: rub is y up, rdf y down; auto: what the file says, else what its format has."""
    axes: AxesOption = "auto"
    """Axes of OUT's numbers; auto: those of ASSET if both are of one format, else what OUT's format has."""
    sh_degree: Annotated[int | None, Argument(metavar="0-4")] = None
    """Leave out SH bands above this degree; default: what ASSET has."""
    antialiased: Annotated[Literal["auto", "yes", "no"], Argument(metavar="auto|yes|no")] = "auto"
    """Mark OUT as trained antialiased (Mip-Splatting), or as not; auto: as ASSET is marked."""
    spz_version: Annotated[int | None, Argument(metavar="2|3|4")] = None
    """Version of an .spz: 3 opens in nearly every program, 2 in GaussianSplats3D too, 4 is about a tenth smaller;
    default: that of ASSET, else 3."""
    sh_bits: Annotated[int | None, Argument(metavar="4-8")] = None
    """Bits of each SH coefficient of an .spz; 4 gives the smallest file; default: 7."""
    sh_palette: Annotated[int | None, Argument(metavar="64-65536")] = None
    """Most SH vectors of a .sog; fewer make it smaller; default: half as many as rows, or more."""
    mark_axes: Annotated[Literal["auto", "yes", "no"], Argument(metavar="auto|yes|no")] = "auto"
    """Whether an .spz names its axes; few programs obey that, and some turn it twice. auto: those that are not the
    PLY's, and of ASSET's own where it does."""
    sort: bool = False
    """Put rows that are near to each other together (Morton order): a .compressed.ply of an asset with a scattered sky
    becomes far finer, other files a little smaller. Row numbers are then others, so that no receipt of ASSET fits."""
    remove_hidden: bool = False
    """Leave out Gaussians that no renderer draws: those of an opacity below 1/255."""
    normals: bool = False
    """In a .ply: write nx, ny, nz, outwards, for programs that light splats; usually zeros or nothing."""
    thickness: bool = False
    """In a .ply: a column `thickness`, from each row through the solid to its other side, world units."""
    occlusion: bool = False
    """In a .ply: a column `occlusion`, 0 (open) to 1: what the asset itself hides of the sky above each row."""
    turning: bool = False
    """In an .html: the asset turns until the user touches it."""
    lenient: bool = False
    """Also open a file that was cut off after its last complete row; what is left of the cut part is kept."""
    overwrite: bool = False
    """Replace OUT if it exists."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Read, write, and read again to see what arrived."""
    # A page is written by another way and cannot be read back, so nothing below holds for it.
    options = write_options(config)
    if config.out.suffix.lower() == HTML:
        return _page(config, options)
    # Options that the format cannot have are refused before the asset is read.
    entry = splat_format(config.out)
    options.check(entry.write_options, str(config.out))
    if config.turning:
        raise ValueError(f"{config.out}: --turning is for OUT.html")
    # Further columns are a matter of PLY files; other formats have no place for them.
    columns = [name for name in ("normals", "thickness", "occlusion") if getattr(config, name)]
    if columns and entry.key != "ply":
        raise ValueError(f"{config.out}: --{columns[0]} is for OUT.ply")
    check_target(config.out, config.overwrite, [config.asset])
    # Written aside and read again before it has its name: what is lost is measured and not guessed.
    with stages(3) as bar:
        bar.enter("reading")
        before = read(config.asset, axes=config.in_axes, lenient=config.lenient)
        before_size = file_size(config.asset)
        # Until the block ends the file has no name, so a failure leaves nothing behind.
        with placed(config.out) as partial:
            bar.enter("writing")
            chosen = chosen_rows(before, config)
            # Hashes leave Python alone, so they are taken beside what follows: of the asset where OUT is likely to be
            # the same file, else of what was read again.
            hashed = None
            if chosen is before and options == AS_IT_IS and before.source and before.source.format == entry.key:
                hashed = beside(lambda: before.sha256)
            write(partial, chosen, axes=config.axes, options=options)
            bar.enter("checking")
            # Read with the axes that it was written with, or the comparison would find everything turned.
            taken = written_axes(before, entry.key, config.axes)
            # They describe the surface of what was written, so they come after the rows and their order.
            if columns:
                written = read(partial, axes=taken, lenient=True, offset=before.offset).source
                assert written is not None
                add_columns(partial, surface_columns(chosen, columns, AXES[written.axes]))
            after = read_again(partial, before, entry.key, taken)
            if hashed is None or after is not before:
                hashed = beside(lambda: after.sha256)
            # Against what was asked for: bands of SH that were left out on purpose are listed by the options.
            measured = measure(options.applied(chosen), after)
    # Said after the work: an odd asset is converted all the same.
    doubtful = warn_of_doubts(before, config.asset)
    assert before.source is not None and after.source is not None
    record = {
        "input": {
            "file": config.asset,
            "format": before.source.format,
            "bytes": before_size,
            "rows": len(before),
            "frame": before.source.axes,
        },
        "output": {
            "file": config.out,
            "format": entry.key,
            "bytes": file_size(config.out),
            "rows": len(after),
            "sha256": hashed(),
            "frame": after.source.axes,
        },
        # First what was measured, then what the options left out.
        "lost": losses(before, after, measured, config.sort) + replace(options, **SEEN_IN_THE_FILE).lines(before),
        "losses": measured.record(),
        "doubts": doubtful,
    }
    # Most files lie as their format usually does; only what is unusual is worth a line.
    show_axes = axes_are_news(before.source) or axes_are_news(after.source)
    lines = [
        f"{config.asset} -> {config.out}",
        f"{count(len(after), 'Gaussian')}; {size(before_size)} -> {size(record['output']['bytes'])}",
        *([f"axes: {axes_line(before.source)} -> {axes_line(after.source)}"] if show_axes else []),
        *(f"lost: {line}" for line in record["lost"] or ["nothing"]),
    ]
    return Outcome(record, lines)


def read_again(path: Path, before: Splats, key: str, axes: Axes) -> Splats:
    """What a new file of the format `key` holds. Where it is byte for byte the file that `before` was read from, and
    taken alike, that is known already."""
    source = before.source
    if source is not None and source.format == key and not source.problems and chosen_axes(before) == axes:
        # A PLY has all its bytes in memory; to compare takes a quarter of the time of a hash.
        is_copy = path.is_file() and (
            ply.is_copy(source.detail, path) if key == "ply" else files.file_sha256(path) == source.sha256
        )
        if is_copy:
            return before
    return read(path, axes=axes, lenient=True, offset=before.offset)


def write_options(config: Config) -> WriteOptions:
    """What the options ask for."""
    marks = {"auto": None, "yes": True, "no": False}
    return WriteOptions(
        config.sh_degree,
        marks[config.antialiased],
        config.spz_version,
        config.sh_bits,
        config.sh_palette,
        marks[config.mark_axes],
    )


def chosen_rows(splats: Splats, config: Config) -> Splats:
    """The rows that are written, in their order in OUT. Raises ValueError where all are hidden."""
    # Too faint to be drawn by any renderer; without them the file shows the same.
    visible = splats.opacities >= MIN_DRAWN_OPACITY
    if config.remove_hidden and not visible.all():
        # A file of no Gaussians would be the likely sign of a wrong option.
        if not visible.any():
            raise ValueError(f"{config.asset}: all of its Gaussians are hidden, nothing is left to write")
        splats = splats.take(visible)
    # Nearby rows together: several formats code neighbours by their differences.
    return splats.take(morton_order(splats.means)) if config.sort else splats


def surface_columns(splats: Splats, names: list[str], signs: tuple[int, int, int]) -> dict[str, np.ndarray]:
    """Columns of a PLY: normals (nx, ny, nz, in the axes of the file: `signs`), thickness, occlusion."""
    # Imported here: few conversions look at a surface, and none of them should wait for it.
    from splatpainter.lights.prepared import lit_surface
    from splatpainter.surface.proxy_mesh import thickness

    # One surface for all columns; shadows take the longest and are left out where nobody asks.
    surface = lit_surface(splats, shadows="occlusion" in names)
    out: dict[str, np.ndarray] = {}
    if "normals" in names:
        # Directions turn with the axes of the file, lengths do not.
        out |= {f"n{axis}": surface.facing.normals[:, k] * np.float32(signs[k]) for k, axis in enumerate("xyz")}
    if "thickness" in names:
        out["thickness"] = thickness(splats, surface.facing.normals)
    if "occlusion" in names:
        out["occlusion"] = surface.closed.clip(0, 1).astype(np.float32)
    return out


def _page(config: Config, options: WriteOptions) -> Outcome:
    """A page that shows the asset; nothing can be read back from it."""
    # Imported here: converting from file to file needs nothing of the studio's.
    from splatpainter.server.html_viewer import HTML_OPTIONS, html_viewer

    options.check(HTML_OPTIONS, str(config.out))
    # A page shows the asset; which way its numbers point is not to be seen in it.
    if config.axes != "auto":
        raise ValueError(f"{config.out}: a page has no axes of its own; leave out --axes")
    check_target(config.out, config.overwrite, [config.asset])
    with stages(2) as bar:
        bar.enter("reading")
        asset = read(config.asset, axes=config.in_axes, lenient=config.lenient)
        # Rows and bands are chosen first, for every byte of a page is loaded before it shows anything.
        splats = options.applied(chosen_rows(asset, config))
        bar.enter("writing")
        (camera,) = orbit_cameras(splats, 1, size=800, background=PAGE_BACKGROUND)
        data = html_viewer(splats, camera, UPS[AUTO_UP], config.asset.name, turning=config.turning)
        with files.writing(config.out) as file:
            file.write(data)
    record = {
        "input": {"file": config.asset, "bytes": file_size(config.asset), "rows": len(asset)},
        "output": {"file": config.out, "format": "html", "bytes": len(data), "rows": len(splats)},
    }
    return Outcome(record, [f"{config.asset} -> {config.out}", f"{count(len(splats), 'Gaussian')}; {size(len(data))}"])


def losses(before: Splats, after: Splats, measured: Losses, in_other_order: bool = False) -> list[str]:
    """What the new file does not hold, one line each, first what was measured."""
    assert before.source is not None and after.source is not None
    key = after.source.format
    # Positions are coded in blocks of neighbours there, so the order of rows decides how fine they are. Sorting works
    # on large arrays and finding a better format on small ones, mostly in Python: one beside the other.
    could_sort = key == "compressed.ply" and measured.severity >= 1 and measured.moved_share and not in_other_order
    share_sorted = beside(lambda: moved_share_sorted(before)) if could_sort else None
    lines = [loss_line(before, key, measured)] if measured.line else []
    # Only where sorting would help much is it worth a word.
    if share_sorted is not None and (in_order := share_sorted()) * 2 < measured.moved_share:
        lines[0] += f" (with --sort {100 * in_order:.2g} % move by more than one size)"
    # From here on what was lost is a matter of fact and needs no measure.
    if in_other_order:
        lines.append("the order of the rows")
    if len(after) != len(before):
        lines.append(f"{len(before):,} Gaussians became {len(after):,}")
    if after.sh_degree != before.sh_degree:
        lines.append(f"SH degree {before.sh_degree} became {after.sh_degree}")
    if before.antialiased and not after.antialiased:
        lines.append("the mark that says: trained antialiased")
    if before.color_space != after.color_space:
        lines.append(f"colour space {before.color_space} became {after.color_space}")
    # Only those that became transparent by writing: others were so before.
    hidden = int((~before.drawable).sum()) - int((~after.drawable).sum())
    if hidden > 0:
        lines.append(f"{count(hidden, 'Gaussian')} with NaN or zero scale became transparent")
    return lines
