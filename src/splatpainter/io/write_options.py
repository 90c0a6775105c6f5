"""What is chosen when a file is written: less than the asset holds, or another coding. Knows no format's bytes.

    io.write("vase.spz", splats, options=WriteOptions(sh_degree=1, spz_version=4))

Without a choice every format writes what it always does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from typing import Any

from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

MAX_SH_DEGREE = 4
SPZ_VERSIONS = (2, 3, 4)
SH_BITS = (4, 8)
"""Least and most bits of an SH coefficient in SPZ."""
SH_PALETTE = (64, 65536)
"""Least and most SH vectors of a SOG palette."""
WRITER_KEYWORDS = {"spz_version": "version", "sh_bits": "sh_bits", "sh_palette": "sh_palette", "mark_axes": "mark"}
"""Option -> what the writer of its format calls it; the others change what every writer gets."""


@dataclass(frozen=True)
class WriteOptions:
    """Choices of one file; None: as the asset has it, or as its format is usually written."""

    sh_degree: int | None = None
    """0 to 4: bands above it are left out. An asset of a lower degree keeps its own."""
    antialiased: bool | None = None
    """The mark that says whether viewers have to make up for the blur of pixels as Mip-Splatting was trained."""
    spz_version: int | None = None
    """2, 3 (zip) or 4 (zstd: a tenth smaller; newer, not every viewer opens it)."""
    sh_bits: int | None = None
    """4 to 8 bits of each SH coefficient of SPZ; usually 7."""
    sh_palette: int | None = None
    """64 to 65,536 SH vectors that a SOG file may hold; usually half as many as rows, or more."""
    mark_axes: bool | None = None
    """Whether an SPZ file names its axes (extension 0xADBE0003); usually only those that are not the PLY's."""

    @property
    def chosen(self) -> dict[str, Any]:
        """Name -> value of what is not None."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    def check(self, holds: Sequence[str], what: str) -> None:
        """Raises ValueError: a value out of range, or an option that is none of `holds`. what: the file, for errors."""
        ranges = {
            "sh_degree": range(MAX_SH_DEGREE + 1),
            "spz_version": SPZ_VERSIONS,
            "sh_bits": range(SH_BITS[0], SH_BITS[1] + 1),
            "sh_palette": range(SH_PALETTE[0], SH_PALETTE[1] + 1),
        }
        for name, value in self.chosen.items():
            if name not in holds:
                listed = ", ".join(holds) or "none"
                raise ValueError(f"{what}: {name} is not an option of this format; it has {listed}")
            valid = ranges.get(name)
            if valid is not None and (type(value) is not int or value not in valid):
                raise ValueError(f"{what}: expected {name} of {valid[0]} to {valid[-1]}, got {value!r}")
            if valid is None and type(value) is not bool:
                raise ValueError(f"{what}: expected {name} to be true or false, got {value!r}")

    def applied(self, splats: Splats) -> Splats:
        """The Gaussians with what all formats alike leave out or mark."""
        if self.sh_degree is not None and self.sh_degree < splats.sh_degree:
            splats = replace(splats, sh=splats.sh[:, : (self.sh_degree + 1) ** 2])
        if self.antialiased is not None and self.antialiased != splats.antialiased:
            splats = replace(splats, antialiased=self.antialiased)
        return splats

    def keywords(self) -> dict[str, Any]:
        """What the format's own writer takes."""
        return {WRITER_KEYWORDS[name]: value for name, value in self.chosen.items() if name in WRITER_KEYWORDS}

    def lines(self, splats: Splats) -> list[str]:
        """What a file of these Gaussians has less or otherwise by choice, one line each."""
        out = []
        if self.sh_degree is not None and self.sh_degree < splats.sh_degree:
            out.append(f"SH above degree {self.sh_degree} was left out (the asset has degree {splats.sh_degree})")
        if self.antialiased is not None and self.antialiased != splats.antialiased:
            out.append(f"marked as {'' if self.antialiased else 'not '}trained antialiased")
        if self.spz_version is not None:
            out.append(f"SPZ version {self.spz_version}")
        if self.sh_bits is not None:
            out.append(f"SH in {self.sh_bits} bits")
        if self.sh_palette is not None:
            out.append(f"at most {self.sh_palette:,} SH vectors")
        if self.mark_axes is not None:
            out.append(f"axes {'' if self.mark_axes else 'not '}marked")
        return out

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> WriteOptions:
        """The inverse of `chosen`. Raises ValueError."""
        names = tuple(entry.name for entry in fields(WriteOptions))
        if unknown := sorted(set(record) - set(names)):
            raise ValueError(f"expected options of {', '.join(names)}, got {str(unknown[0])[:40]!r}")
        options = WriteOptions(**record)
        options.check(names, "options")
        return options


AS_IT_IS = WriteOptions()
