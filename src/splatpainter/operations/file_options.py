"""How the file that operations are applied to is read and written, and what is refused before that. Loads nothing that
edits: a refusal need not wait for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from splatpainter.operations.operation import Operation, Wording, check_operations
from splatpainter.output_paths import check_target, receipt_of, splat_format
from splatpainter.splats import Axes
from splatpainter.system.atomic import clash
from splatpainter.system.quick_dataclass import dataclass

Worder = Callable[[Operation], Wording]
"""How errors name an operation's options."""


@dataclass(frozen=True)
class FileOptions:
    """How an asset is read and written."""

    in_axes: Axes = "auto"
    """Axes of the numbers in the file that is read."""
    axes: Axes = "auto"
    """Axes of the numbers in the file that is written."""
    lenient: bool = False
    """Also open a file that was cut off after its last complete row."""
    receipt: Path | None = None
    """Where the receipt goes; None: beside the file (`receipt_of`)."""
    overwrite: bool = False
    """Replace the file and its receipt if they exist."""


AS_USUAL = FileOptions()


def check_to_file(
    asset: Path, operations: Sequence[Operation], out: Path, options: FileOptions, wording: Worder
) -> None:
    """Raises ValueError: options that cannot be, names of files that may not be written."""
    check_operations(operations, wording)
    # Files that are read must not be overwritten, whichever operation reads them.
    inputs = [path for operation in operations for path in operation.files()]
    for path in (path for operation in operations for path in operation.outputs()):
        check_target(path, options.overwrite, [asset], inputs)
    check_outputs(out, options.receipt or receipt_of(out), options.overwrite, asset, inputs)


def check_outputs(out: Path, receipt: Path, overwrite: bool, asset: Path, inputs: Sequence[Path]) -> None:
    """Refuse OUT and the receipt before any work is done. inputs: other files that are read. Raises ValueError."""
    # Inputs are protected from both outputs; OUT may replace what --overwrite allows.
    splat_format(out)
    check_target(out, overwrite, [asset], inputs)
    check_target(receipt, overwrite, [], [asset, *inputs])
    # Names that differ in case alone are one file on some systems.
    if clash(receipt, out):
        raise ValueError(f"{receipt}: OUT and the receipt need different names, not only in upper and lower case")
