"""Any program as a source: the view goes into a folder of its own, the program runs, its picture is read back.

    --source command --source-option 'run=python upscale.py {image} {out} --scale {scale}'

The words are split once, before anything is put into them, and no shell sees them: a prompt with quotes, semicolons or
line breaks stays one word. What the template names is what the source takes.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from splatpainter.sources.answer_pictures import (
    alpha_png,
    depth_png,
    image_png,
    mask_png,
    normal_png,
    read_answer_file,
    reference_png,
)
from splatpainter.sources.picture_source import (
    CancelFlag,
    Capabilities,
    PictureAnswer,
    PictureRequest,
    Progress,
    SourceCancelled,
    SourceError,
)
from splatpainter.sources.source_options import SourceDescription, option
from splatpainter.system import processes
from splatpainter.system.quick_dataclass import dataclass

POLL_SECONDS = 0.1
TAIL_BYTES = 8192
"""Bytes at the end of what a program printed that are looked at."""
MAX_REFERENCES = 16
FILES = {
    "image": "image.png",
    "alpha": "alpha.png",
    "mask": "mask.png",
    "depth": "depth.png",
    "normal": "normal.png",
    "camera": "camera.json",
}
"""Placeholder -> file that it names."""
WORDS = ("out", "prompt", "seed", "scale", "references")
PLACEHOLDER = re.compile(r"\{([A-Za-z_]+)\}")


@dataclass(frozen=True)
class CommandOptions:
    """Options of the source `command`."""

    run: str = option(
        "The program and its arguments: {image} {mask} {alpha} {depth} {normal} {camera} are files, {out} the picture "
        "to write, {prompt} {seed} {scale} values, {references} files, one argument each"
    )
    timeout: float = option("Seconds after which the program is ended", 600.0, least=0.1)
    ending: str = option(
        "Kind of the picture that it writes: png, jpg, webp, tif or exr",
        "png",
        choices=("png", "jpg", "webp", "tif", "exr"),
    )
    scales: str = option("Enlargements that it can be asked for, where it takes {scale}", "1,2,4")


DESCRIPTION = SourceDescription(
    name="command",
    summary="any program on this machine",
    options=CommandOptions,
    takes="what its template names: {image} {mask} {depth} {normal} {prompt} {seed} {scale} {references}",
)


def open_source(options: CommandOptions) -> CommandSource:
    """Raises SourceError: a template that cannot be split, has no {out} or unknown names, no such program here."""
    return CommandSource(options)


class CommandSource:
    """A program and its template."""

    name = "command"

    def __init__(self, options: CommandOptions) -> None:
        self.options = options
        # Split once and before anything is put in, so that no value can become a second word.
        self.words = split(options.run)
        # What the template names is what the program takes: there is no other list.
        names = {name for word in self.words for name in PLACEHOLDER.findall(word)}
        allowed = [*FILES, *WORDS]
        if unknown := sorted(names - {*allowed}):
            listed = " ".join(f"{{{name}}}" for name in allowed)
            raise SourceError(f"source command: run has no {{{unknown[0]}}}; there are {listed}")
        if "out" not in names:
            raise SourceError("source command: run needs {out}, the file that the program writes its picture to")
        # The program is fixed by whoever wrote the template, never by a prompt.
        if PLACEHOLDER.search(self.words[0]):
            raise SourceError("source command: run has to begin with a program, not with a placeholder")
        if any("{references}" in word and word != "{references}" for word in self.words):
            raise SourceError("source command: {references} has to be an argument of its own; it becomes one per file")
        # Looked for now: a missing program is known before a view is rendered.
        program = shutil.which(self.words[0])
        if program is None:
            raise SourceError(f"source command: program {self.words[0][:200]!r} not found; give its path")
        # On Windows batch files go through a shell whatever we do, and it would read the prompt.
        if sys.platform == "win32" and program.lower().endswith((".bat", ".cmd")) and "prompt" in names:
            raise SourceError("source command: a shell reads batch files, and prompts with it; run a program")
        self.names = names
        self.capabilities = Capabilities(
            prompt="prompt" in names,
            mask="mask" in names,
            references=MAX_REFERENCES if "references" in names else 0,
            seed="seed" in names,
            maps=frozenset({"depth", "normal"} & names),
            scales=_scales(options.scales) if "scale" in names else (1,),
            max_side_px=8192,
            hint="the program takes what run names: {prompt}, {mask}, {seed}, {scale}, {references}",
        )

    def edit(self, request: PictureRequest, progress: Progress, cancel: CancelFlag) -> PictureAnswer:
        """Run the program once. Raises SourceError with the last line that it printed; SourceCancelled."""
        # A folder of its own for each run: programs write files beside their input, and it goes with them.
        with tempfile.TemporaryDirectory(prefix="splatpainter-command-") as name:
            folder = Path(name)
            out = folder / f"out.{self.options.ending}"
            command = self._command(request, folder, out)
            progress(0.0, Path(self.words[0]).name)
            self._run(command, folder / "printed.txt", progress, cancel)
            # Ended well without a picture: what it printed last says more than any guess.
            if not out.exists():
                line = last_line(folder / "printed.txt")
                raise SourceError(f"source command: {self._program} ended well and wrote no picture to {{out}}{line}")
            image, notes = read_answer_file(out, "command")
        return PictureAnswer(image, model=self._program, seed=request.seed, notes=notes)

    @property
    def _program(self) -> str:
        """The program's name, with that of the script that an interpreter runs: receipts and errors say so."""
        script = self.words[1] if len(self.words) > 1 else ""
        names = [self.words[0], script] if script[:1] not in ("-", "") and Path(script).is_file() else self.words[:1]
        return " ".join(Path(name).name for name in names)

    def _command(self, request: PictureRequest, folder: Path, out: Path) -> list[str]:
        """The words with everything put in; writes the files that they name."""
        # As functions: maps are rendered only where the template names them.
        contents = {
            "image": lambda: image_png(request),
            "alpha": lambda: alpha_png(request),
            "mask": lambda: mask_png(request),
            "depth": lambda: depth_png(request, bits=16),
            "normal": lambda: normal_png(request),
            "camera": lambda: (request.camera.to_json() if request.camera else "{}").encode(),
        }
        # Only what is named is written; a program need not find what it did not ask for.
        for name in FILES:
            if name in self.names:
                (folder / FILES[name]).write_bytes(contents[name]())
        references = [folder / f"reference_{index}.png" for index in range(len(request.references))]
        for path, picture in zip(references, request.references, strict=True):
            path.write_bytes(reference_png(picture))
        # A prompt may be anybody's text; an option of the program it must not become.
        if "{prompt}" in self.words and request.prompt.startswith("-"):
            raise SourceError(
                "source command: a prompt that begins with '-' would be read as an option; write {prompt} as part of "
                "an argument in run (--prompt={prompt}), or begin the prompt with a letter"
            )
        # Values without a file; NUL ends a word on every system.
        values = {
            **{name: str(folder / file) for name, file in FILES.items()},
            "out": str(out),
            "prompt": request.prompt.replace("\0", " "),
            "seed": str(0 if request.seed is None else request.seed),
            "scale": str(request.scale),
        }
        words: list[str] = []
        # References are the one placeholder that becomes several words.
        for word in self.words:
            if word == "{references}":
                words += map(str, references)
            else:
                words.append(PLACEHOLDER.sub(lambda match: values[match[1]], word))
        return words

    def _run(self, command: list[str], printed: Path, progress: Progress, cancel: CancelFlag) -> None:
        # Its own clock: a wall clock may be set while the program runs.
        until = time.monotonic() + self.options.timeout
        with open(printed, "wb") as file:
            try:
                # What it prints goes to a file: a pipe that nobody reads would stop it when full.
                child = processes.begin(command, stdin=subprocess.DEVNULL, stdout=file, stderr=file)
            except OSError as error:
                reason = error.strerror or type(error).__name__
                raise SourceError(f"source command: {self._program} cannot be started ({reason})") from None
        try:
            # Looked at again and again: it may be cancelled, run out of time, or have something to say.
            while True:
                try:
                    code = child.wait(POLL_SECONDS)
                    break
                except subprocess.TimeoutExpired:
                    pass
                if cancel.is_set():
                    raise SourceCancelled
                if time.monotonic() > until:
                    seconds, line = f"{self.options.timeout:g} seconds", last_line(printed)
                    raise SourceError(f"source command: {self._program} did not end within {seconds}{line}")
                _report(printed, progress)
        except BaseException:
            # Whatever ends the wait ends the program too, with all that it has started.
            processes.end(child)
            raise
        processes.kill(child)  # what it may have left behind
        if code != 0:
            how = f"failed with exit code {code}" if code > 0 else f"was ended by {processes.signal_name(code)}"
            raise SourceError(f"source command: {self._program} {how}{last_line(printed)}")


def split(template: str) -> list[str]:
    """The words of a template, as a shell would split them; on Windows backslashes are parts of paths. Raises
    SourceError."""
    # As a shell splits, without a shell: quotes work, and nothing is expanded.
    lexer = shlex.shlex(template, posix=True)
    lexer.whitespace_split, lexer.commenters = True, ""
    if sys.platform == "win32":
        lexer.escape = ""
    try:
        words = list(lexer)
    except ValueError as error:
        raise SourceError(f"source command: run cannot be split into arguments ({str(error).lower()})") from None
    if not words:
        raise SourceError("source command: run is empty; expected a program and its arguments")
    return words


def last_line(printed: Path) -> str:
    """ "; it said: ..." with the last line that is not empty, or ""."""
    line = _last_words(printed)
    return f"; it said: {line}" if line else ""


def _last_words(printed: Path, limit: int = 300) -> str:
    with open(printed, "rb") as file:
        # Only the end: programs may print megabytes.
        file.seek(max(0, printed.stat().st_size - TAIL_BYTES))
        text = file.read(TAIL_BYTES).decode("utf-8", "replace")
    lines = [" ".join(line.split()) for line in re.split(r"[\r\n]+", text)]
    return next((line for line in reversed(lines) if line), "")[:limit]


def _report(printed: Path, progress: Progress) -> None:
    """The last line, and the share that it names ("45%")."""
    if line := _last_words(printed, 80):
        # Programs show their progress in many ways; a share in per cent is what most have in common.
        percent = re.findall(r"(\d{1,3}(?:\.\d+)?) ?%", line)
        progress(min(float(percent[-1]) / 100, 1.0) if percent else 0.0, line)


def _scales(text: str) -> tuple[int, ...]:
    words = [word.strip() for word in text.split(",") if word.strip()]
    if not words or not all(word.isdecimal() and 1 <= int(word) <= 16 for word in words):
        raise SourceError(f"source command: scales: expected whole numbers of 1 to 16 (1,2,4), got {text[:80]!r}")
    return tuple(sorted({int(word) for word in words}))
