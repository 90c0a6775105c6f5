"""`splatpainter bench`: tables of measured numbers. The measuring itself is in `evaluate`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from splatpainter.commands import Outcome
from splatpainter.commands.options import parse
from splatpainter.commands.targets import check_folder
from splatpainter.commands.terminal import watched

SUMMARIES = {
    "speed": "time and peak memory of every stage, on scenes of several sizes",
    "lift": "quality of local edits on given assets, with a contact sheet",
    "studio": "what an artist waits for in the studio, and its server's memory",
}
PAPER = {
    "refine": "the paper's Tab. 1: detail from zoomed-in views",
    "relight": "the paper's Tab. 2: light from one, two and four relit views",
    "creative": "the paper's Tab. 3: painted, stickered, lettered and recoloured views",
    "compress": "the paper's Tab. 4: what Stage I keeps of an asset",
    "sequence": "edits in a row: views one after the other, conflicts, forgetting",
    "ablate": "every switch of the design",
    "report": "one HTML page of the paper's tables that were measured",
}


def dispatch(words: Sequence[str]) -> Outcome:
    """`bench NAME ...`. Raises ValueError for another NAME."""
    if not words or words[0] in ("-h", "--help"):
        return Outcome({"benches": SUMMARIES | PAPER}, [_help()])
    if words[0] in PAPER:
        from splatbench import table_commands as bench_paper

        return bench_paper.report(words[1:]) if words[0] == "report" else bench_paper.bench(words[0], words[1:])
    if words[0] not in SUMMARIES:
        raise ValueError(f"splatpainter bench: expected one of {', '.join(SUMMARIES | PAPER)}, got {words[0]!r}")
    return {"speed": _speed, "lift": _lift, "studio": _studio}[words[0]](words[1:])


def _speed(words: Sequence[str]) -> Outcome:
    from splatbench import speed

    @dataclass(frozen=True)
    class Config(speed.SpeedBench):
        """Measure time and peak memory of every stage; write them as a table with the machine named.

        example:
          splatpainter bench speed --rows 10000 100000 --out out/bench-speed
        """

        json: bool = False
        """Print one JSON object instead of text."""

    config = parse(Config, "splatpainter bench speed", words)
    return _outcome(config, speed.run)


def _lift(words: Sequence[str]) -> Outcome:
    from splatbench import local_edits as lift

    @dataclass(frozen=True)
    class Config(lift.LiftBench):
        """Paint on a close-up of every given asset, edit it, and measure how well, how cleanly and how fast.

        example:
          splatpainter bench lift vase.ply assets/ --out out/bench-lift
        """

        assets: Annotated[Positional[tuple[Path, ...]], arg(metavar="ASSET ...", help_behavior_hint="")] = ()
        """Splat files, or folders of them (one file per name up to the first dot); none: the bundled demo asset."""
        json: bool = False
        """Print one JSON object instead of text."""

    config = parse(Config, "splatpainter bench lift", words)
    return _outcome(config, lift.run)


def _studio(words: Sequence[str]) -> Outcome:
    try:
        from splatbench import studio
    except ImportError as error:
        raise ValueError(f"splatpainter bench studio: needs {error.name}; pip install 'splatpainter[studio]'") from None

    @dataclass(frozen=True)
    class Config(studio.StudioBench):
        """Drive the studio's server as a page does; measure every wait, the bytes sent and the server's memory.

        example:
          splatpainter bench studio --edits 200 --clients 20 --out out/bench-studio
        """

        json: bool = False
        """Print one JSON object instead of text."""

    config = parse(Config, "splatpainter bench studio", words)
    return _outcome(config, studio.run)


def _outcome(config: Any, run: Callable[..., list[Any]]) -> Outcome:
    from splatpainter.text_tables import markdown

    check_folder(config.out)
    lines = run(config, _say)
    outcome = Outcome(
        {"out": config.out, "lines": [asdict(line) for line in lines]}, [markdown(lines), f"-> {config.out}"]
    )
    return outcome.as_json() if config.json else outcome


def _say(line: str) -> None:
    if watched():
        print(line, file=sys.stderr, flush=True)


def _help() -> str:
    rows = [f"  {name:<8} {line}" for name, line in (SUMMARIES | PAPER).items()]
    example = "example:\n  splatpainter bench speed --quick\n  splatpainter bench refine --quick"
    return "\n".join(["usage: splatpainter bench NAME ...", "", "benches:", *rows, "", example])
