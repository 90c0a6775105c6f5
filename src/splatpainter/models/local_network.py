"""The local network: Stage II's blocks as the carrier of a local edit, from the pixels of a picture to the colours of
Gaussians (arXiv 2512.05354, 3.2 and 3.3), without pictures of the asset, LRM or Stage I.

    state = network.adapt(network.initial_state(), tokens)     # the picture's patches train the fast weights
    answer = network.read(state, readers)                      # the lift's Gaussians ask what colour they are

Patches and Gaussians tell their places by their cell in the tile (models/picture_patches.py), and queries start as the
patches' keys, so a Gaussian first asks for the patch that it lies in. What it reads are the cosines of that patch,
which are evaluated at its place in the patch, and those of the edit's mask: where the memory holds no edit nothing is
painted. T patches, R Gaussians, D width.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from splatpainter.models import checkpoint
from splatpainter.models.local_config import PLACE_WIDTH, LocalConfig
from splatpainter.models.picture_patches import (
    APPENDED_FEATURE,
    BANDS,
    HELD_CHANNELS,
    READER_CHANNELS,
    SLOTS,
    TOKEN_CHANNELS,
)
from splatpainter.models.refine import AttentionMixer, FastMixer, Memory, RefineBlock, RidgeMixer
from splatpainter.nn.layers import layer_norm
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class FirstWeights:
    """Sizes of the first weights, with which every block is a memory of cells; all of the order 1 after the norm."""

    cell_code: float = 8.0
    """Norm of a cell's code: above what a patch holds, so that the block's norm is much the same for all patches."""
    noise: float = 0.001
    """Standard deviation of the weights that would be 0."""
    bump: float = 4.0
    """Of a hidden unit of fast weights to its cell's key: Muon's step, of length 1, hardly turns it."""
    marker: float = 1.0
    """Of a cell's code in the value of a patch. Muon levels all directions of an edit; where a patch's own cell is by
    far the largest of its value, they are level already, and what it holds stays as it was."""
    content: float = 0.1
    """Of what a patch holds in its value: silu is near a straight line there."""
    carrier: float = 0.15
    """What fast weights answer at each cell before any edit, so that an answer of nothing is not raised to rms 1."""
    spare: float = 4.0
    """Norm of each column of the fast weights in units that no cell uses: columns keep their norm, and those would be
    raised or lowered as a whole otherwise."""
    sharp: float = 2.5
    """Of keys and queries of attention: sharp enough to tell neighbouring patches apart."""


FIRST = FirstWeights()
MIN_LOG_VARIANCE, MAX_LOG_VARIANCE = -9.0, 0.0
"""Of a colour channel: standard deviations of 0.011 to 1."""


class Patches(NamedTuple):
    """Patches of a region as tensors (picture_patches.PatchTokens)."""

    cells: Tensor
    """[T] int64."""
    values: Tensor
    """[T, TOKEN_CHANNELS]."""


class Readers(NamedTuple):
    """Gaussians of a region as tensors (picture_patches.PatchReaders)."""

    cells: Tensor
    """[R] int64."""
    basis: Tensor
    """[R, BANDS] of `cosine_basis`."""
    facts: Tensor
    """[R, READER_CHANNELS]."""
    before: Tensor
    """[R, 3]."""


class LocalAnswer(NamedTuple):
    """What the network says."""

    colors: Tensor
    """[R, 3] base colours."""
    log_variance: Tensor
    """[R] of a channel: how sure it is."""


class LocalState(NamedTuple):
    """What the network has learnt from a region."""

    blocks: tuple[Memory, ...]


class LocalNetwork(nn.Module):
    """Slow weights of the local network."""

    def __init__(self, config: LocalConfig) -> None:
        super().__init__()
        self.config, refine = config, config.refine
        self.notes: dict[str, Any] = {}
        self.patch = nn.Linear(TOKEN_CHANNELS, config.content_width)
        self.gaussian = nn.Linear(READER_CHANNELS, config.content_width)
        last = refine.blocks - 1
        self.blocks = nn.ModuleList(RefineBlock(config.dim, refine, last=k == last) for k in range(refine.blocks))
        if refine.detail:
            self.detail_mixer = FastMixer(config.dim, refine, pictures=False, gaussians=False)
            self.norm_refined, self.norm_original = layer_norm(config.dim), layer_norm(config.dim)
        self.norm_out = layer_norm(config.dim)
        self.bands = nn.Linear(config.dim, HELD_CHANNELS, bias=False)
        self.mix = nn.Sequential(nn.Linear(config.dim + READER_CHANNELS + 4, config.content_width), nn.SiLU())
        self.last = nn.Linear(config.content_width, 1 + 3 + 1)
        if not self.last.weight.is_meta:
            nn.init.zeros_(self.last.weight)
            with torch.no_grad():
                self.last.bias.copy_(torch.tensor([4.0, 0, 0, 0, -4.0]))
                self._start_as_a_memory_of_places()

    def initial_state(self) -> LocalState:
        """The state before any edit."""
        return LocalState(tuple(block.mixer.initial() for block in self._blocks()))

    def adapt(self, state: LocalState, patches: Patches, strength: float | None = None) -> LocalState:
        """The state after a region's patches have taught. strength: overrides config.refine.edit_strength."""
        # Place first, in dimensions of its own, so that keys can hear of it alone.
        x = torch.cat([_cell_codes(patches.cells), self.patch(patches.values)], 1)
        memories = []
        for block, memory in zip(self._blocks(), state.blocks, strict=True):
            memory, x, _ = block.adapt(memory, x, None, None, strength, None, None)
            memories.append(memory)
        return LocalState(tuple(memories))

    def read(self, state: LocalState, readers: Readers, strength: float | None = None) -> LocalAnswer:
        """What Gaussians are after the edit. The extra layer learns from the refined tokens of all of them and is read
        by the original tokens of those that the lift has appended: twice the tokens, two sets (3.3)."""
        x = original = self.tokens_of(readers)
        for block, memory in zip(self._blocks(), state.blocks, strict=True):
            x = block.read(memory, x)
        if self.config.refine.detail:
            # Appended Gaussians are finer than those that they came from: they read a second set.
            memory = self.detail_mixer.update(self.detail_mixer.initial(), self.norm_refined(x), None, strength)
            second = x + self.detail_mixer.read_gaussian_tokens(memory, self.norm_original(original))
            x = torch.where(readers.facts[:, APPENDED_FEATURE, None] > 0, second, x)
        # The cosines are evaluated at the Gaussian's own place: a patch is many pixels, and it wants one.
        bands = self.bands(x).float()
        colors, mask = bands[:, : 3 * BANDS].unflatten(1, (BANDS, 3)), bands[:, 3 * BANDS :]
        picture = 0.5 + 2 * (colors * readers.basis[:, :, None]).sum(1)
        edited = (4 * (mask * readers.basis).sum(1, keepdim=True)).clamp(0, 1)
        reader_inputs = torch.cat([self.norm_out(x), readers.facts, picture, edited], 1)
        gate, rest, spread = self.last(self.mix(reader_inputs)).float().split([1, 3, 1], 1)
        # A gate to the colour before: what lies hidden should stay, as does what the memory holds no edit of.
        change = torch.sigmoid(gate) * (picture - readers.before) + 0.2 * rest
        colors = readers.before + edited * change
        middle, half = (MAX_LOG_VARIANCE + MIN_LOG_VARIANCE) / 2, (MAX_LOG_VARIANCE - MIN_LOG_VARIANCE) / 2
        return LocalAnswer(colors, middle + half * torch.tanh((spread[:, 0] - middle) / half))

    def tokens_of(self, readers: Readers) -> Tensor:
        """[R, D] tokens of Gaussians, which know nothing of an edit."""
        return torch.cat([_cell_codes(readers.cells), self.gaussian(readers.facts)], 1)

    def _start_as_a_memory_of_places(self) -> None:
        """First weights with which every block keeps patches by their cells and hands a Gaussian that of its own: drawn
        at random instead, nothing is read from the memory before some 1,000 steps have found a common tongue."""
        config = self.config
        # The first dimensions hold the patch as it is, so that reading it back gives its picture.
        count = min(HELD_CHANNELS, config.content_width - 1)
        self.patch.weight[:count] = torch.eye(count, TOKEN_CHANNELS)
        # The others balance them: the blocks' norms take the mean off a token, which would shift all cosines.
        self.patch.weight[count:] = -self.patch.weight[:count].sum(0) / (config.content_width - count)
        self.patch.bias.zero_()
        self.gaussian.weight[:count], self.gaussian.bias[:count] = 0, 0
        held = slice(PLACE_WIDTH, PLACE_WIDTH + count)
        self.bands.weight.zero_()
        self.bands.weight[:count, held] = torch.eye(count)
        if config.refine.detail:
            self.detail_mixer.ttt.out.weight.zero_()  # the second set starts as the first
        for k, block in enumerate(self._blocks()):
            start_by_place(block.mixer, held, 1.0 if k == 0 else 0.0)

    def _blocks(self) -> list[RefineBlock]:
        return [block for block in self.blocks if isinstance(block, RefineBlock)]

    def save(self, folder: Path | str, notes: dict[str, Any] | None = None) -> None:
        """Write a checkpoint."""
        checkpoint.save(folder, self.config, self.state_dict(), notes=self.notes if notes is None else notes)

    @staticmethod
    def load(folder: Path | str) -> LocalNetwork:
        """The network of a checkpoint, in eval mode. Raises ValueError as checkpoint.load."""
        saved = checkpoint.load(folder, kind=LocalConfig)
        with torch.device("meta"):
            network = LocalNetwork(saved.config)
        network = network.to_empty(device="cpu")
        checkpoint.fill(network, saved.tensors, str(folder))
        network.notes = saved.notes
        return network.eval()


def start_by_place(mixer: nn.Module, held: slice, gain: float) -> None:
    """Keys hear of cells alone and queries start as keys; what is kept and read of a token is its dimensions `held`,
    times `gain`."""
    count = held.stop - held.start
    if isinstance(mixer, AttentionMixer):
        scale = gain / _norm_scale(len(mixer.rows.out.weight))
        for layer in [mixer.rows] + ([] if mixer.pictures is None else [mixer.pictures]):
            dim = len(layer.out.weight)
            keys = layer.kv.weight[:dim]
            keys.zero_()
            keys[:, :SLOTS] = FIRST.sharp * _turns(dim, SLOTS, layer.heads)
            layer.q.weight.copy_(keys)
            layer.kv.weight[dim:] = torch.eye(dim)
            layer.out.weight.zero_()
            layer.out.weight[held, held] = scale * torch.eye(count)
        return
    if isinstance(mixer, RidgeMixer):
        keys, queries, out = mixer.keys.weight, mixer.queries.values(), mixer.out.weight
        mixer.values.weight.copy_(torch.eye(len(out)))
        scale = gain / _norm_scale(len(out))
    else:
        assert isinstance(mixer, FastMixer)
        dim = mixer.ttt.out.in_features
        keys, queries, out = mixer.ttt.kv.weight[:dim], mixer.ttt.queries.values(), mixer.ttt.out.weight
        scale = gain * _start_fast_weights(mixer, held)
    out.zero_()
    out[held, held] = scale * torch.eye(count)
    nn.init.normal_(keys, std=FIRST.noise)
    keys[:SLOTS, :SLOTS] += torch.eye(SLOTS)
    for query in queries:
        query.weight.copy_(keys)  # type: ignore[union-attr]


def _start_fast_weights(mixer: FastMixer, held: slice) -> float:
    """Each of the first hidden units answers to the key of one cell. What an edit's answer is to be multiplied with to
    be what its patch holds."""
    ttt, dim = mixer.ttt, mixer.ttt.out.in_features
    values = ttt.kv.weight[dim:]
    nn.init.normal_(values, std=FIRST.noise * FIRST.content)
    values[:SLOTS, :SLOTS] += FIRST.marker * torch.eye(SLOTS)
    values[held, held] = FIRST.content * torch.eye(held.stop - held.start)
    for weight in (ttt.w0, ttt.w2):
        nn.init.normal_(weight, std=FIRST.noise)
        weight[0, :SLOTS, :SLOTS] += FIRST.bump * torch.eye(SLOTS)
    spare = torch.randn_like(ttt.w1[0, SLOTS:])
    ttt.w1.zero_()
    ttt.w1[0, SLOTS:] = FIRST.spare * spare / spare.norm(dim=0)
    ttt.w1[0, :SLOTS, :SLOTS] = FIRST.carrier * torch.eye(SLOTS)
    # A patch's answer has the marker as its largest number, and is brought to rms 1 by it.
    return FIRST.marker * FIRST.cell_code * (1 + FIRST.carrier) / (math.sqrt(dim) * 0.5 * FIRST.content)


def _norm_scale(dim: int) -> float:
    """What a block's norm multiplies a token with."""
    return math.sqrt(dim / 2) / FIRST.cell_code


def _cell_codes(cells: Tensor) -> Tensor:
    """[T, PLACE_WIDTH] codes of cells [T]: a dimension for each, and one that balances them."""
    codes = FIRST.cell_code * functional.one_hot(cells, PLACE_WIDTH).float()
    codes[:, SLOTS] = -FIRST.cell_code
    return codes


def _turns(dim: int, inputs: int, heads: int) -> Tensor:
    """[D, inputs] for each head other orthogonal directions of places."""
    share = dim // heads
    return torch.cat([nn.init.orthogonal_(torch.empty(share, inputs)) for _ in range(heads)])
