"""Which mistakes in core modules no test sees: each mutation is made in a copy of the package, and the tests that
should know better are run on it. Prints survivors; exit code 1 where there are any.

Run: python scripts/mutants.py [WORD ...] [--list]

WORD: only mutations whose file or name holds it. Takes some seconds each. Not part of `make test`; a change of a core
formula comes with its line here.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"splatpainter": ROOT / "src/splatpainter", "splattrain": ROOT / "train/splattrain"}
"""Packages that are copied; files of the first are named without it."""
SLOWEST_SECONDS = 3600.0
"""Of a file of tests without any mutation."""
PATIENCE, LEAST_SECONDS = 10.0, 60.0
"""Tests of a mutation that take this many times as long as without it have noticed it; not before so many seconds."""


@dataclass(frozen=True)
class Mutation:
    """One mistake."""

    name: str
    """What is wrong, in words."""
    file: str
    """Below src/splatpainter, or "splattrain/..."."""
    old: str
    """Text that stands there once."""
    new: str
    tests: tuple[str, ...] = field(repr=False)
    """Files of tests that must see it."""


GAIN = "tests/models/test_gain_of_networks.py"
CARRY = "tests/models/test_edit_propagation.py"
TURNS = "tests/models/test_edits_in_turn.py"
COLORS = "tests/lift/test_color_refine.py"
SHEETS = "tests/lift/test_resurface.py"
GLOBAL = "tests/lift/test_global.py"
TOKENIZER = "tests/models/test_picture_tokenizer.py"
WORTH = "train/tests/test_worth_of_inputs.py"
LIGHTS = "tests/lights/test_lights.py"
UNLIT = "tests/lights/test_unlit.py"
LIGHT_LAYERS = "tests/session/test_light_layers.py"
MODEL = ("tests/models/test_model.py", GAIN)
LOCAL = "tests/models/test_local_network.py"
PAINTED = "train/tests/test_painted_gaussians.py"
ON_ROWS = "train/tests/test_gaussian_edit_task.py"
HELD_OUT = "train/tests/data/test_held_out.py"
CONTRADICTIONS = "tests/lift/test_contradictions.py"
CLOSE_UPS = "tests/lift/test_wide_edit.py"
BODIES = "tests/holes/test_body.py"
GROUNDS = "tests/pictures/test_lost_transparency.py"
GIVEN = "tests/lights/test_given_light.py"
DAMAGED = "tests/pictures/test_damaged.py"
MISTAKEN = "tests/gatekeeper/test_mistaken_pictures.py"
FOREIGN = "tests/session/test_foreign_disks.py"
MUTATIONS = (
    Mutation(
        "the sign of Stage II's answer",
        "models/edit_propagation.py",
        "parts.append(color_change(",
        "parts.append(-color_change(",
        (GAIN,),
    ),
    Mutation(
        "Stage II answers with its first state",
        "models/edit_propagation.py",
        "refiner.read(state, reader_tokens(",
        "refiner.read(model.initial_state(), reader_tokens(",
        (CARRY,),
    ),
    Mutation(
        "every teacher counts fully",
        "models/edit_propagation.py",
        "TEACHER_WEIGHT_SUM / shares.sum().clamp_min(1e-6)",
        "1.0",
        (CARRY,),
    ),
    Mutation(
        "queries and keys are drawn apart",
        "nn/ttt.py",
        "start_alike(self.queries",
        "bool(self.queries",
        (GAIN,),
    ),
    Mutation(
        "attention's queries and keys are drawn apart",
        "models/refine.py",
        "start_alike(self.rows.q",
        "id(self.rows.q",
        (GAIN,),
    ),
    Mutation(
        "readers are told the lift's answer",
        "models/refine.py",
        'config.answers == "teachers" and not teaching',
        'config.answers == "teachers" and False',
        (GAIN,),
    ),
    Mutation(
        "teachers are not told the answer",
        "models/refine.py",
        'config.answers == "teachers" and not teaching',
        'config.answers == "teachers"',
        (GAIN,),
    ),
    Mutation(
        "the extra layer learns from original tokens",
        "models/model.py",
        "state = self.refiner.learn_detail(state, values, strength=strength)\n            detail_latents",
        "state = self.refiner.learn_detail(state, original, strength=strength)\n            detail_latents",
        (GAIN,),
    ),
    Mutation(
        "the extra layer is asked with refined tokens",
        "models/model.py",
        "detail_latents = self.refiner.read_detail(state, original)",
        "detail_latents = self.refiner.read_detail(state, values)",
        (GAIN,),
    ),
    Mutation(
        "the LRM's tokenizer is trained by edits",
        "models/image_tokens.py",
        "with torch.no_grad():  # frozen",
        "with torch.enable_grad():  # frozen",
        (TOKENIZER,),
    ),
    Mutation(
        "the LRM's tokens are those of the picture before",
        "models/image_tokens.py",
        "replace(views, depth=pictures.depth",
        "replace(views, colors=pictures.render, depth=pictures.depth",
        (TOKENIZER,),
    ),
    Mutation(
        "validation is told the same pictures as grey ones",
        "splattrain/stages/lrm.py",
        "torch.full_like(views.colors, 0.5)",
        "views.colors",
        (WORTH,),
    ),
    Mutation(
        "an edit does not keep its state",
        "models/refine.py",
        "return replace(state, blocks=tuple(memories))",
        "return state",
        ("tests/models/test_refine.py",),
    ),
    Mutation(
        "fast weights go the other way",
        "nn/fast_weights.py",
        "w = w + edit_strength * towards",
        "w = w - edit_strength * towards",
        ("tests/nn", GAIN),
    ),
    Mutation(
        "columns of fast weights grow",
        "nn/fast_weights.py",
        "moved.append(w * (norm / w.norm(dim=-2, keepdim=True).clamp_min(1e-5)))",
        "moved.append(w)",
        ("tests/nn",),
    ),
    Mutation(
        "an edit forgets those before it",
        "models/edits_in_turn.py",
        "tuple(left), parents, f",
        "(), parents, f",
        (TURNS,),
    ),
    Mutation(
        "edits are made on top of each other",
        "models/edits_in_turn.py",
        "before = replace(splats, sh=splats.sh - so_far",
        "before = replace(splats, sh=splats.sh - 0 * so_far",
        (TURNS,),
    ),
    Mutation(
        "what was painted in between goes",
        "models/edits_in_turn.py",
        "now = drawn_view(splats, picture.camera).colors\n",
        "now = np.zeros((*picture.mask.shape, 3), np.float32)\n",
        (TURNS,),
    ),
    Mutation(
        "a picture from the same camera is one of two",
        "models/edits_in_turn.py",
        "REPLACED = 0.7",
        "REPLACED = 7.0",
        (TURNS,),
    ),
    Mutation(
        "a look is taken for a light",
        "models/edits_in_turn.py",
        "_unexplained(splats, views) < _unexplained(before, views)",
        "_unexplained(splats, views) < 0",
        (TURNS,),
    ),
    Mutation(
        "a light is taken for a look",
        "models/edits_in_turn.py",
        "_unexplained(splats, views) < _unexplained(before, views)",
        "True",
        (TURNS,),
    ),
    Mutation(
        "what is seen at a slant counts fully",
        "models/edits_in_turn.py",
        "view.weight[ids] * np.maximum(facing, 0)",
        "view.weight[ids]",
        (TURNS,),
    ),
    Mutation(
        "a look is Stage II's alone",
        "models/edit_propagation.py",
        "share = 0.5 + 0.5 * min(",
        "share = 1.0 + 0.0 * min(",
        (CARRY,),
    ),
    Mutation(
        "light is half the lift's",
        "models/edit_propagation.py",
        "LIGHT = (0.1, 0.3)",
        "LIGHT = (2.0, 3.0)",
        (CARRY,),
    ),
    Mutation(
        "normals explain nothing",
        "lift/global_edit.py",
        "np.zeros_like(colors), normals)[:, 7::4]",
        "np.zeros_like(colors), 0 * normals)[:, 7::4]",
        (GLOBAL, CARRY),
    ),
    Mutation(
        "what is hardly shown teaches",
        "models/edit_propagation.py",
        "MIN_TEACHER_PX = 1.0",
        "MIN_TEACHER_PX = 0.0",
        (TURNS,),
    ),
    Mutation(
        "a contradiction is taken for the same edit",
        "models/edits_in_turn.py",
        "CONTRADICTS, HALF_COMMON = 0.45, 0.08",
        "CONTRADICTS, HALF_COMMON = 45.0, 0.08",
        (TURNS,),
    ),
    Mutation(
        "latents that are not there take room",
        "models/encode.py",
        "device=device).expand(len(groups), -1)",
        "device=device).repeat(len(groups), 1)",
        ("tests/models/test_encode.py",),
    ),
    Mutation(
        "places are not told",
        "models/refine.py",
        "/ scale.rms + position_waves(positions, latents.shape[1])",
        "/ scale.rms",
        (GAIN,),
    ),
    Mutation(
        "patches are all of one cell",
        "models/local_network.py",
        "torch.cat([_cell_codes(patches.cells)",
        "torch.cat([_cell_codes(0 * patches.cells)",
        (LOCAL,),
    ),
    Mutation(
        "queries of places start apart",
        "models/local_network.py",
        "query.weight.copy_(keys)",
        "bool(query.weight is keys)",
        (LOCAL,),
    ),
    Mutation(
        "what lies beside the paint is painted",
        "models/local_network.py",
        "readers.before + edited * change",
        "readers.before + change",
        (LOCAL,),
    ),
    Mutation(
        "the local network hears no strength",
        "models/local_network.py",
        "block.adapt(memory, x, None, None, strength, None, None)",
        "block.adapt(memory, x, None, None, None, None, None)",
        (LOCAL,),
    ),
    Mutation(
        "all read the second set",
        "models/local_network.py",
        "readers.facts[:, APPENDED_FEATURE, None] > 0",
        "readers.facts[:, APPENDED_FEATURE, None] > -9",
        (LOCAL,),
    ),
    Mutation(
        "the extra layer of the local network learns nothing",
        "models/local_network.py",
        "self.norm_refined(x), None, strength)",
        "self.norm_refined(x), None, 0.0)",
        (LOCAL,),
    ),
    Mutation(
        "views weigh alike, however sure",
        "models/local_edit_colors.py",
        "sure = np.exp(-answer.log_variance",
        "sure = np.exp(0 * answer.log_variance",
        (LOCAL,),
    ),
    Mutation(
        "the network is deaf to the picture",
        "models/local_edit_colors.py",
        "hold: tuple[float, float] = (0.01, 1.0)",
        "hold: tuple[float, float] = (1e3, 1e6)",
        (LOCAL,),
    ),
    Mutation(
        "of several views the first wins",
        "models/local_edit_colors.py",
        "    for k, view in enumerate(views):\n        hold = np.zeros",
        "    for k, view in reversed(list(enumerate(views))):\n        hold = np.zeros",
        (LOCAL,),
    ),
    Mutation(
        "the memory of the local network is trained",
        "splattrain/stages/painted_gaussians_task.py",
        "weight.requires_grad_(name.startswith(LEARNT))",
        "weight.requires_grad_(True)",
        (PAINTED,),
    ),
    Mutation(
        "hidden Gaussians count like those that show",
        "splattrain/stages/painted_gaussians_task.py",
        "LEAST_COUNT = 0.05",
        "LEAST_COUNT = 50.0",
        (PAINTED,),
    ),
    Mutation(
        "another picture is the same one",
        "splattrain/stages/painted_gaussians_task.py",
        "-bands.flip(2).flip(0).flatten(1)",
        "bands.flatten(1)",
        (PAINTED,),
    ),
    Mutation(
        "Gaussians that teach are asked",
        "splattrain/stages/gaussian_edit_task.py",
        "readers = np.concatenate([rng.permutation(hidden), spare])",
        "readers = np.concatenate([teachers, rng.permutation(hidden), spare])",
        (ON_ROWS,),
    ),
    Mutation(
        "another edit is told as the same one",
        "splattrain/stages/gaussian_edit_task.py",
        "change = (sample if evidence is None else evidence).change",
        "change = sample.change",
        (ON_ROWS,),
    ),
    Mutation(
        "the sign of the hold of colours",
        "lift/colors.py",
        "gain - pull[:, None] * (colors - first)",
        "gain + pull[:, None] * (colors - first)",
        (COLORS,),
    ),
    Mutation("the hold is left out of the divisor", "lift/colors.py", "total + pull, 1e-6", "total, 1e-6", (COLORS,)),
    Mutation("any move is a change", "lift/colors.py", "MIN_CHANGE = 1 / 1024", "MIN_CHANGE = 0.0", (COLORS,)),
    Mutation("small moves are lost", "lift/colors.py", "MIN_CHANGE = 1 / 1024", "MIN_CHANGE = 4 / 1024", (COLORS,)),
    Mutation("colours may be too bright", "lift/colors.py", "MAX_COLOR = 1.3", "MAX_COLOR = 2.6", (COLORS, GLOBAL)),
    Mutation(
        "the sign of a global round",
        "lift/colors.py",
        "run(kernels.step_changes, gain, total, hold, limit, change)",
        "run(kernels.step_changes, -gain, total, hold, limit, change)",
        (COLORS,),
    ),
    Mutation(
        "highlights shine through paint",
        "lift/colors.py",
        "size) * keep).reshape",
        "size) * 1).reshape",
        (COLORS, "tests/lift/test_local.py"),
    ),
    Mutation(
        "edges as wide as the rest",
        "lift/sheets/sheet.py",
        "edge_width: float = 0.6",
        "edge_width: float = 1.0",
        (SHEETS,),
    ),
    Mutation(
        "edges too narrow", "lift/sheets/sheet.py", "edge_width: float = 0.6", "edge_width: float = 0.4", (SHEETS,)
    ),
    Mutation("sheets too faint", "lift/sheets/sheet.py", " opacity: float = 0.97", " opacity: float = 0.5", (SHEETS,)),
    Mutation(
        "what was seen is not trusted",
        "lift/global_edit.py",
        "share = (weight / (weight + options.half_seen))[:, None]",
        "share = (0 * weight)[:, None]",
        (GLOBAL,),
    ),
    Mutation(
        "Gaussians far from the picture are not regressed",
        "models/stored_predictor.py",
        "EVIDENCE_GAIN = 4.0",
        "EVIDENCE_GAIN = 0.0",
        (GAIN, "tests/models/test_predictor.py"),
    ),
    Mutation(
        "the split moves with the number of objects",
        "splattrain/data/object_sources.py",
        'f"{seed}:{name}".encode()',
        'f"{seed}:{name}:{len(names)}".encode()',
        ("train/tests/data/test_object_sources.py", HELD_OUT),
    ),
    Mutation(
        "objects held out are trained on",
        "splattrain/data/held_out.py",
        'return "" if self.share <= share else',
        'return "" if True else',
        (HELD_OUT,),
    ),
    Mutation(
        "only the last stage is asked what it held out",
        "splattrain/data/held_out.py",
        '(*notes.get("history", []), notes)',
        "(notes,)",
        (HELD_OUT,),
    ),
    Mutation(
        "a stage that trained nothing saves",
        "splattrain/loop.py",
        "if step and not self._used:",
        "if step and False:",
        ("train/tests/test_stages.py",),
    ),
    Mutation(
        "light upside down",
        "lights/relight.py",
        "np.clip((new + FLOOR) / (old + FLOOR)",
        "np.clip((old + FLOOR) / (new + FLOOR)",
        (LIGHTS,),
    ),
    Mutation(
        "light may leave nothing",
        "lights/relight.py",
        "np.clip((new + FLOOR) / (old + FLOOR)",
        "np.clip(new / (old + FLOOR)",
        (LIGHTS,),
    ),
    Mutation(
        "light of other lights is taken for the captured one",
        "lights/relight.py",
        "np.maximum((old + FLOOR) * gain - FLOOR, 0)",
        "old",
        (UNLIT,),
    ),
    Mutation(
        "light of layers fades as display colours do",
        "session/kinds/operation_layers.py",
        "if self.relights else mix_sh",
        "if False else mix_sh",
        (LIGHT_LAYERS,),
    ),
    Mutation(
        "light on what was painted is that on nothing",
        "lights/unlit.py",
        "gain[source[rows] < 0] = 1",
        "gain[:] = 1",
        (UNLIT, LIGHT_LAYERS),
    ),
    Mutation(
        "a changed row is not seen",
        "splats.py",
        "if old is new or n == 0:",
        'if old is new or n == 0 or name == "means":',
        ("tests/test_splats.py", "tests/test_receipts.py"),
    ),
    Mutation(
        "untouched rows are hashed once",
        "receipts.py",
        "return digest, rows_sha256(after, rows)",
        "return digest, digest",
        ("tests/test_receipts.py", "tests/test_verify_tampering.py"),
    ),
    Mutation(
        "views that agree contradict each other",
        "lift/contradictions.py",
        "> CONTRADICTIONS.min_share for",
        "< CONTRADICTIONS.min_share for",
        (CONTRADICTIONS,),
    ),
    Mutation(
        "views that contradict each other agree",
        "lift/contradictions.py",
        "    return float((apart > alike).mean())",
        "    return 0.0",
        (CONTRADICTIONS,),
    ),
    Mutation(
        "a change is compared where only one view shows it",
        "lift/contradictions.py",
        "both = (moved[..., 3] > 0.99) & (later.mask > 0)",
        "both = later.mask > 0",
        (CONTRADICTIONS,),
    ),
    Mutation(
        "detail beside itself contradicts",
        "lift/contradictions.py",
        "reach: float = 1 / 8",
        "reach: float = 1 / 1024",
        (CONTRADICTIONS,),
    ),
    Mutation(
        "of edits in turn the first one's changes are forgotten",
        "lift/edits.py",
        "changed[self.ids] = changed[last.ids] = True",
        "changed[last.ids] = True",
        (CONTRADICTIONS,),
    ),
    Mutation(
        "parents of edits in turn are the last one's",
        "lift/edits.py",
        "parents = self.parent_ids(count)[last.parent_ids(len(self.splats))]",
        "parents = last.parent_ids(len(self.splats))",
        (CONTRADICTIONS,),
    ),
    Mutation(
        "a close-up's further rounds are taken away",
        "lift/local/close_up_colors.py",
        "change = rounds * ways[0]",
        "change = -rounds * ways[0]",
        (CLOSE_UPS,),
    ),
    Mutation(
        "a close-up's further rounds are left out",
        "lift/local/close_up_colors.py",
        "change = rounds * ways[0]",
        "change = 0 * ways[0]",
        (CLOSE_UPS,),
    ),
    Mutation(
        "a close-up's further rounds are taken whole",
        "lift/local/close_up_colors.py",
        "change = rounds * ways[0]",
        "change = ways[0]",
        (CLOSE_UPS,),
    ),
    Mutation(
        "a thin object's close-up is paint",
        "lift/local/local_edit.py",
        "    if mask.mean() < CLOSE_UP_FRACTION:",
        "    if True:",
        (CLOSE_UPS,),
    ),
    Mutation(
        "paint on a part of a close-up is detail",
        "lift/local/local_edit.py",
        "> CLOSE_UP_COVER * max(",
        "> 0 * max(",
        (CLOSE_UPS,),
    ),
    Mutation(
        "a view of the whole asset is a close-up",
        "lift/local/local_edit.py",
        "    if inside.mean() > CLOSE_UP_INSIDE:",
        "    if False:",
        (CLOSE_UPS,),
    ),
    Mutation(
        "Gaussians that edits added count in a close-up",
        "lift/local/local_edit.py",
        "means = splats.means[:originals]",
        "means = splats.means",
        (CLOSE_UPS,),
    ),
    Mutation(
        "creases part what stands on a plane",
        "holes/body.py",
        "held_link: float = 0.005",
        "held_link: float = 0.0",
        (BODIES,),
    ),
    Mutation(
        "legs hang together by the ground",
        "holes/body.py",
        " & (side | ~(ground[one] | ground[two]))",
        "",
        (BODIES,),
    ),
    Mutation(
        "a seat is a chair",
        "holes/body.py",
        "hanging_share: float = 0.5",
        "hanging_share: float = 0.0",
        (BODIES,),
    ),
    Mutation(
        "ground is sought around the selection alone",
        "holes/body.py",
        "        ground = ground_of(is_body)\n",
        "",
        (BODIES,),
    ),
    Mutation(
        "a body in crumbs goes",
        "holes/body.py",
        "return body if body[meant].mean() >= BODY.min_covered_share else None",
        "return body",
        (BODIES,),
    ),
    Mutation(
        "a flattened picture's ground is paint",
        "pictures/lost_transparency.py",
        "    return np.where(mask[..., None], picture, render).astype(np.float32)",
        "    return picture",
        (GROUNDS,),
    ),
    Mutation(
        "all of a flattened picture is as it was rendered",
        "pictures/lost_transparency.py",
        "    return np.where(mask[..., None], picture, render).astype(np.float32)",
        "    return render",
        (GROUNDS,),
    ),
    Mutation(
        "a checkerboard has one colour",
        "pictures/lost_transparency.py",
        "    if is_other.mean() < GROUNDS.min_second_share:",
        "    if True:",
        (GROUNDS,),
    ),
    Mutation(
        "a negative stands on a ground of its own",
        "pictures/lost_transparency.py",
        "min_unchanged: float = 0.3",
        "min_unchanged: float = 0.0",
        (GROUNDS,),
    ),
    Mutation(
        "an environment is believed however pictures would have it turned",
        "lights/given_light.py",
        "    if evidence >= best - max(",
        "    if True or evidence >= best - max(",
        (GIVEN,),
    ),
    Mutation(
        "an environment is refused where any turn is likelier",
        "lights/given_light.py",
        "slack: float = 1.0",
        "slack: float = -99.0",
        (GIVEN,),
    ),
    Mutation(
        "pictures alone are believed where they show what was held back best",
        "lights/given_light.py",
        "held_back_loss: float = 2.0",
        "held_back_loss: float = 0.0",
        (GIVEN,),
    ),
    Mutation(
        "a glow is a move",
        "gatekeeper/mistaken_pictures.py",
        "min_moved_explained: float = 0.25",
        "min_moved_explained: float = 0.0",
        (MISTAKEN,),
    ),
    Mutation(
        "a grey glaze is no contrast",
        "gatekeeper/mistaken_pictures.py",
        "GREYED_WORDS if is_grey else",
        "GRADED_WORDS if is_grey else",
        (MISTAKEN,),
    ),
    Mutation(
        "sums of PNG chunks are not looked at",
        "pictures/whole_files.py",
        'int.from_bytes(stored, "big") != total',
        "False",
        (DAMAGED,),
    ),
    Mutation(
        "a zlib stream's sum is not looked at",
        "pictures/whole_files.py",
        "    return unpacked if stream.eof else -1",
        "    return unpacked",
        (DAMAGED,),
    ),
    Mutation(
        "JPEG scans are not walked",
        "pictures/jpeg_data.py",
        "    if not broken:\n",
        "    if True:\n",
        (DAMAGED,),
    ),
    Mutation(
        "a scan that refines has no history",
        "pictures/jpeg_data.py",
        "history = frame.progressive and first > 0",
        "history = False",
        (DAMAGED,),
    ),
    Mutation(
        "a late log is folded into what another program wrote",
        "session/project/project_file.py",
        "if not self._is_settled and not (self._file is not None and self._file.is_overwritten()):",
        "if not self._is_settled:",
        (FOREIGN,),
    ),
    Mutation(
        "a log is never folded",
        "session/project/project_file.py",
        "            self._has_written, self._is_settled = True, False\n",
        "            self._has_written, self._is_settled = True, True\n",
        (FOREIGN,),
    ),
    Mutation(
        "a grey picture is a normal map",
        "splattrain/data/materials.py",
        "MIN_UPRIGHT = 0.5",
        "MIN_UPRIGHT = 0.0",
        ("train/tests/data/test_meshes.py",),
    ),
)


@dataclass(frozen=True)
class Options:
    """Mutations of core modules, and which of them no test sees."""

    words: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Only mutations whose name or file holds one of these words."""
    list: bool = False
    """List the mutations and run nothing."""


def path_of(mutation: Mutation, packages: Mapping[str, Path]) -> Path:
    """Its file. packages: name -> folder."""
    first, _, rest = mutation.file.partition("/")
    return packages[first] / rest if first in packages else packages["splatpainter"] / mutation.file


def survives(mutation: Mutation, copy: Path, seconds: float = SLOWEST_SECONDS) -> bool:
    """Whether the tests pass with this mistake in `copy`, a folder that holds a copy of the package. seconds: those
    that take longer hang. Raises ValueError where the text to be changed does not stand there exactly once."""
    path = path_of(mutation, {name: copy / name for name in PACKAGES})
    text = path.read_text(encoding="utf-8")
    if text.count(mutation.old) != 1:
        raise ValueError(f"{mutation.file}: {mutation.old!r} stands there {text.count(mutation.old)} times, not once")
    path.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8", newline="\n")
    try:
        return passes(mutation.tests, copy, seconds)
    finally:
        path.write_text(text, encoding="utf-8", newline="\n")


def passes(tests: Sequence[str], copy: Path, seconds: float = SLOWEST_SECONDS) -> bool:
    """Whether these tests pass, within so many seconds, with the package in `copy`."""
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, timeout=seconds)
        return done.returncode == 0
    except subprocess.TimeoutExpired:
        return False


def main(options: Options) -> int:
    """Run; the exit code."""
    chosen = [m for m in MUTATIONS if not options.words or any(w in f"{m.file} {m.name}" for w in options.words)]
    if options.list or not chosen:
        print("\n".join(f"{m.file}: {m.name}" for m in chosen) or "no such mutation")
        return 0 if chosen else 2
    survivors = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name, package in PACKAGES.items():
            shutil.copytree(package, copy / name, ignore=shutil.ignore_patterns("__pycache__", "static"))
        took: dict[str, float] = {}
        for test in sorted({test for mutation in chosen for test in mutation.tests}):
            begun = time.monotonic()
            if not passes((test,), copy):
                print(f"{test} fails without any mutation: make it pass first")
                return 2
            took[test] = time.monotonic() - begun
        for mutation in chosen:
            alive = survives(mutation, copy, LEAST_SECONDS + PATIENCE * sum(took[test] for test in mutation.tests))
            survivors += [mutation] if alive else []
            print(f"{'SURVIVES' if alive else 'killed':<9} {mutation.file}: {mutation.name}", flush=True)
    print(f"{len(survivors)} of {len(chosen)} survive")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=Options.__doc__)))
