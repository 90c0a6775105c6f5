"""Options that several operations share: how pictures are painted, and which picture source is asked. Each is declared
here once; an operation that means something else by one declares it again, with its own words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpainter.gatekeeper.strictness import Strictness
from splatpainter.lift.options import LOCAL_DEFAULTS, LocalOptions
from splatpainter.nn.precision import Precision
from splatpainter.operations.operation import Operation, Tools, Wording, parameter
from splatpainter.painting.edited_picture import Method, Mode
from splatpainter.sources.picture_source import MAX_PROMPT_CHARACTERS
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.ranges import same_range

if TYPE_CHECKING:
    from splatpainter.painter import Painter
    from splatpainter.sources.picture_source import PictureSource


@dataclass(frozen=True, kw_only=True)
class ViewLimits(Operation):
    """What one view may paint."""

    angle_limit: float = same_range(LocalOptions, "angle_limit", LOCAL_DEFAULTS.angle_limit)
    """Degrees between the line of sight and the surface's normal from which paint of a local edit fades; 0: no
    limit."""
    depth_edge_limit: float = same_range(LocalOptions, "depth_edge_limit", LOCAL_DEFAULTS.depth_edge_limit)
    """Pixels beside an edge in depth that a local edit leaves out; 0: none."""

    def limited(self, painter: Painter) -> Painter:
        """The painter with these limits. Raises ValueError: out of range."""
        limits = {"angle_limit": self.angle_limit, "depth_edge_limit": self.depth_edge_limit}
        local = replace(painter.settings.local_options or LOCAL_DEFAULTS, **limits)
        return painter.with_settings(local_options=local)


@dataclass(frozen=True, kw_only=True)
class PaintingOptions(ViewLimits):
    """How pictures are painted."""

    method: Method = "auto"
    """Method of the edit: lift (analytic, under a second), corrected (the lift, in colours that a small network adapts
    to views from beside; local edits only), fit (the lift, then some seconds of optimisation: nearer to the picture;
    local edits only), ttt (the networks of PRESET); auto: ttt where trained weights are better, else corrected in local
    edits and lift in others."""
    preset: str = parameter("auto", metavar="NAME|DIR")
    """Weights: compact, rows, paper, local, a folder of weights, or lift (none); auto: compact where its weights are,
    else lift. Local edits by ttt are those of local, unless the weights have learnt local ones."""
    precision: Precision = "auto"
    """Arithmetic of the networks; auto: what SPLATPAINTER_PRECISION says, else bfloat16 where the machine has it."""
    polish: bool = False
    """After the networks, two colour rounds of the lift: nearer to the picture, further from what the networks have
    learnt."""

    def painter(self, mode: Mode, tools: Tools) -> Painter:
        """Who paints in a mode. Raises ValueError: weights that are missing or wrong, networks that would leave the
        edit to the lift."""
        # A host that has a painter (the studio, a batch) has loaded its weights already, with its own settings.
        if tools.painter is not None:
            return tools.painter
        from splatpainter.painter import Painter

        # Before any weights are read, which takes seconds: networks that would not be used are refused by their files.
        self._refuse_idle_networks(mode, tools.wording)
        painter = Painter.load(self.preset, modes=[mode], polish=self.polish, precision=self.precision)
        painter = self.limited(painter).with_settings(aside=tools.aside)
        method, reason = painter.choose(self.method, mode)
        # On a copy of the asset no Gaussian could be verified, and every file is verified that is written here.
        if method == "ttt" and painter.model is not None and painter.model.config.representation == "copy":
            raise ValueError(
                f"preset '{painter.preset}': paints on a copy of the asset (representation copy), of which no "
                "Gaussian could be verified; use it from Python, or a preset of representation native"
            )
        # Rounds of the lift after the lift are the lift: the option would do nothing.
        if self.polish and method != "ttt":
            remark = f" ({reason})" if self.method == "ttt" else ""
            polish = tools.wording.option("polish")
            line = f"{polish} is for method ttt alone: it adds rounds of the lift{remark}"
            raise tools.wording.error(self.kind, line)
        return painter

    def _refuse_idle_networks(self, mode: Mode, wording: Wording) -> None:
        """Raises ValueError where networks are asked for that would leave the edit to the lift; their weights are not
        read for that."""
        from splatpainter.models import checkpoint, weights

        # Global edits and other methods have their networks, or want none.
        if self.method != "ttt" or mode != "local":
            return
        # The local weights serve any preset of this package, so it is enough that they are whole.
        local = weights.find(weights.LOCAL)
        if local is not None and self.preset in ("auto", weights.LOCAL, *weights.NAMES):
            checkpoint.check_files(local)
            return
        folder = weights.find("compact" if self.preset == "auto" else self.preset) or Path(self.preset)
        # No such folder, which loading says in its own words; or weights that do make local edits.
        if not (folder / checkpoint.INDEX).is_file() or weights.is_local(folder):
            return
        if not checkpoint.config(folder).edits_locally:
            method = wording.option("method")
            line = (
                f"{method} ttt: the networks of preset '{self.preset}' make global edits alone, and those of preset "
                f"'{weights.LOCAL}' are not there; use {method} lift, or {wording.option('preset')} FOLDER with "
                "weights of train rows --recipe paint or train refine"
            )
            raise wording.error(self.kind, line)


@dataclass(frozen=True, kw_only=True)
class GateOptions(Operation):
    """Which pictures are let through."""

    strictness: Strictness = parameter("normal", option="source_strictness")
    """Which pictures of a source, and painted photographs, are refused. strict: edges agree by less than 0.7 of 1,
    moved by over 1 %, turned by over 0.5 degrees, 0.25 stops off, over 10 % changed outside the mask, or cropped;
    normal: less than 0.38, over 10 %, 6 degrees, 1.5 stops; loose: less than 0.2, over 30 %, 12 degrees."""


@dataclass(frozen=True, kw_only=True)
class PictureSourceOptions(GateOptions):
    """Which picture source is asked, and for what."""

    source: str = parameter("", metavar="NAME")
    """Picture source that is asked (`splatpainter source list`)."""
    options: Any = parameter((), metavar="KEY=VALUE ...", option="source_option", words=tuple[str, ...])
    """Options of the source; `splatpainter source list` names them. Keys come from the environment alone."""
    prompt: str = parameter("", metavar="TEXT", max_length=MAX_PROMPT_CHARACTERS)
    """What the source should do to the view, for sources that take a prompt."""
    seed: int | None = parameter(None, metavar="N", ge=0, le=2**64 - 1)
    """Random seed, for sources that take one."""
    size: int | None = parameter(None, metavar="PX")
    """Pixels of the longer side of the views that are sent; default: what the cameras say."""

    def __post_init__(self) -> None:
        from splatpainter.sources.source_options import option_words

        super().__post_init__()
        # Options come as words from the command line and as a mapping from YAML; the rest of the code knows mappings.
        if not isinstance(self.options, Mapping):
            object.__setattr__(self, "options", option_words(self.options))
        # YAML also has lists, dates and null; a source gets words.
        for key, value in self.options.items():
            if not isinstance(value, str | int | float):
                raise ValueError(f"expected text or a number as the option {key!r:.40}")

    def opened_source(self, tools: Tools, **more: str) -> PictureSource:
        """The source, with its options and these. Raises SourceError: there is none, or it cannot be had so."""
        return tools.open_source(self.source, {**{key: str(value) for key, value in self.options.items()}, **more})

    def calls(self) -> int:
        """How often the source is asked, as far as that is known without the asset."""
        return 1

    def refuse_options_without_source(self, wording: Wording, names: tuple[str, ...]) -> None:
        """Raises ValueError where one of these fields is set although no source is named."""
        for name in names:
            # Only what was set is named: defaults are no mistake.
            if not self.source and name in self.changes():
                line = f"{wording.option(name)} is for pictures that a source makes; give {wording.option('source')} "
                raise wording.error(self.kind, f"{line}NAME too")
