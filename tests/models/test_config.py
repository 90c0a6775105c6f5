"""Model configs: JSON round trip, strictness, and what the presets say."""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import pytest

from splatpainter.models import config as module
from splatpainter.models.config import PRESETS, CompressConfig, LrmConfig, ModelConfig, RefineConfig
from tests.support.model_scenes import shallow


@pytest.mark.parametrize("name", PRESETS)
def test_json_round_trip(name: str) -> None:
    config = PRESETS[name]
    assert config.preset == name
    assert ModelConfig.from_json(config.to_json()) == config
    changed = shallow(replace(config, refine=replace(config.refine, image_channels=("mask", "edited"))), 3)
    assert changed != config
    assert ModelConfig.from_json(changed.to_json()) == changed


def test_the_paper_preset_is_the_papers() -> None:
    """Supplement, Network Implementation and Training."""
    paper = PRESETS["paper"]
    assert (paper.lrm.dim, paper.lrm.layers, paper.lrm.heads, paper.lrm.patch, paper.lrm.image_size) == (
        1024,
        24,
        16,
        8,
        512,
    )
    stage1 = paper.compress
    assert (stage1.dim, stage1.heads, stage1.encoder_layers, stage1.decoder_layers) == (512, 8, 6, 6)
    assert (stage1.keep, stage1.resolution, paper.representation) == (0.25, 128, "copy")
    assert (paper.refine.blocks, paper.refine.fast_hidden, paper.refine.mixer) == (8, 2048, "ttt")


@pytest.mark.parametrize(
    ("path", "value", "complaint"),
    [
        (("refine", "inner_step"), 3, "unknown key 'refine.inner_step'"),
        (("lrm", "layers"), None, "missing key 'lrm.layers'"),
        (("lrm", "layers"), 2.5, "expected int as 'lrm.layers', got 2.5"),
        (("lrm", "layers"), True, "expected int as 'lrm.layers', got True"),
        (("lrm", "layers"), 0, "expected layers of at least 1, got 0"),
        (("lrm", "views"), 17, "expected at most 16 canonical views, got 17"),
        (("refine", "inner_loss"), "huber", "expected one of dot, l2 as 'refine.inner_loss', got 'huber'"),
        (("refine", "image_channels"), "edited", "expected a list as 'refine.image_channels'"),
        (("refine", "image_channels"), ["mask"], "expected image_channels with 'edited'"),
        (("compress", "grouping"), ["x"], "as 'compress.grouping', got a list of 1"),
        (("compress", "heads"), 7, "expected dim a multiple of heads"),
        (("compress",), 3, "expected an object as 'compress', got 3"),
        (("sh_degree",), 5, "expected sh_degree 0..4, got 5"),
    ],
)
def test_a_wrong_key_is_named(path: tuple[str, ...], value: object, complaint: str) -> None:
    data = json.loads(PRESETS["compact"].to_json())
    section = data
    for name in path[:-1]:
        section = section[name]
    if value is None:
        del section[path[-1]]
    else:
        section[path[-1]] = value
    with pytest.raises(ValueError) as caught:
        ModelConfig.from_json(json.dumps(data), "there/model.json")
    message = str(caught.value)
    assert complaint in message and message.startswith("there/model.json") and "\n" not in message


@pytest.mark.parametrize("text", ["", "[1]", "{" * 100_000, "null", "1" * (1 << 21)])
def test_what_is_no_config_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ValueError, match=r"^config: [^\n]*$"):
        ModelConfig.from_json(text)


def test_every_field_says_what_it_is() -> None:
    """The dataclass is the documentation: a docstring line follows every field."""
    lines = Path(module.__file__).read_text(encoding="utf-8").splitlines()
    for kind in (LrmConfig, CompressConfig, RefineConfig, ModelConfig):
        assert is_dataclass(kind)
        start = lines.index(f"class {kind.__name__}:")
        for entry in fields(kind):
            at = next(i for i in range(start, len(lines)) if lines[i].startswith(f"    {entry.name}:"))
            assert lines[at + 1].lstrip().startswith('"""'), f"{kind.__name__}.{entry.name}"


def test_a_residual_on_the_lift_has_no_second_set_and_no_absolute_decoder() -> None:
    compact = PRESETS["compact"]
    with pytest.raises(ValueError, match="expected detail=False with base='lift'"):
        replace(compact.refine, base="lift")
    refine = replace(compact.refine, base="lift", detail=False)
    assert ModelConfig.from_json(replace(compact, refine=refine).to_json()).refine.base == "lift"
    with pytest.raises(ValueError, match="expected a residual decoder"):
        replace(compact, refine=refine, decoder="absolute")


def test_without_latents_gaussians_need_places_of_their_own() -> None:
    compact = PRESETS["compact"]
    with pytest.raises(ValueError, match="expected inputs='normalised' and representation='native'"):
        replace(compact, refine=replace(compact.refine, latents=False, inputs="raw"))
    with pytest.raises(ValueError, match="expected inputs='normalised' and representation='native'"):
        replace(compact, refine=replace(compact.refine, latents=False), representation="copy")
    assert not replace(compact, refine=replace(compact.refine, latents=False)).refine.latents
