"""The local network: Stage II's blocks as the carrier of a local edit, from the pixels of a picture to the colours of
Gaussians (arXiv 2512.05354, 3.2 and 3.3), without pictures of the asset, LRM or Stage I.

    state = network.adapt(network.initial_state(), tokens)     # the picture's patches train the fast weights
    answer = network.read(state, readers)                      # the lift's Gaussians ask what colour they are

Patches and Gaussians tell their places in the same words (`PlaceWaves`), and queries start as the patches' keys, so a
Gaussian first asks for the patch that it lies in. What it reads are the cosines of that patch, which are evaluated at
its place in the patch. T patches, R Gaussians, D width.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from splatpainter.models import checkpoint
from splatpainter.models.local_config import LocalConfig
from splatpainter.models.picture_patches import APPENDED_FEATURE, BANDS, READER_CHANNELS, TOKEN_CHANNELS
from splatpainter.models.refine import AttentionMixer, FastMixer, Memory, RefineBlock, RidgeMixer
from splatpainter.nn.layers import layer_norm

COARSEST = 4.0
"""Longest wavelength of places, half extents of the region's box: two boxes."""
WAVES_SEED = 0
KEY_GAIN = 2.5
"""First size of keys and queries of attention: sharp enough to tell neighbouring patches apart."""
FIRST_GAIN = 0.7
"""Of what the first block reads: its norm has raised places, and with them all else, from rms 0.7 to 1."""
ANSWER_RMS = 0.15
"""What fast weights answer is brought to this size at first, that of what patches hold."""
FEATURE_STD = 0.3
"""Standard deviation of the first weights of other keys."""
MIN_LOG_VARIANCE, MAX_LOG_VARIANCE = -9.0, 0.0
"""Of a colour channel: standard deviations of 0.011 to 1."""


class Patches(NamedTuple):
    """Patches of a region as tensors (picture_patches.PatchTokens)."""

    positions: Tensor
    """[T, 3]."""
    values: Tensor
    """[T, TOKEN_CHANNELS]."""
    weights: Tensor
    """[T]."""
    finest: float
    """Shortest wavelength, in the region's frame."""


class Readers(NamedTuple):
    """Gaussians of a region as tensors (picture_patches.PatchReaders)."""

    positions: Tensor
    """[R, 3]."""
    basis: Tensor
    """[R, BANDS] of `cosine_basis`."""
    facts: Tensor
    """[R, READER_CHANNELS]."""
    before: Tensor
    """[R, 3]."""
    finest: float


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

    directions: Tensor
    """[waves, 3] unit, in which positions are told."""

    def __init__(self, config: LocalConfig) -> None:
        super().__init__()
        self.config, refine = config, config.refine
        self.notes: dict[str, Any] = {}
        # Seeded: places must be told in the same words after every start.
        generator = torch.Generator().manual_seed(WAVES_SEED)
        directions = torch.randn(config.waves, 3, generator=generator, device="cpu")
        self.register_buffer("directions", functional.normalize(directions, dim=1))
        self.position = nn.Linear(2 * config.waves, config.position_width, bias=False)
        self.patch = nn.Linear(TOKEN_CHANNELS, config.content_width)
        self.gaussian = nn.Linear(READER_CHANNELS, config.content_width)
        last = refine.blocks - 1
        self.blocks = nn.ModuleList(RefineBlock(config.dim, refine, last=k == last) for k in range(refine.blocks))
        if refine.detail:
            self.detail_mixer = FastMixer(config.dim, refine, pictures=False, gaussians=False)
            self.norm_refined, self.norm_original = layer_norm(config.dim), layer_norm(config.dim)
        self.norm_out = layer_norm(config.dim)
        self.bands = nn.Linear(config.dim, 3 * BANDS, bias=False)
        self.mix = nn.Sequential(nn.Linear(config.dim + READER_CHANNELS + 3, config.content_width), nn.SiLU())
        self.last = nn.Linear(config.content_width, 1 + 3 + 1)
        if not self.position.weight.is_meta:
            nn.init.orthogonal_(self.position.weight)
            nn.init.zeros_(self.last.weight)
            with torch.no_grad():
                self.last.bias.copy_(torch.tensor([2.0, 0, 0, 0, -4.0]))
                self._start_as_a_memory_of_places()

    def initial_state(self) -> LocalState:
        """The state before any edit."""
        return LocalState(tuple(block.mixer.initial() for block in self._blocks()))

    def adapt(self, state: LocalState, patches: Patches, strength: float | None = None) -> LocalState:
        """The state after a region's patches have taught. strength: overrides config.refine.edit_strength."""
        # Place first, in dimensions of its own, so that keys can hear of it alone.
        x = torch.cat([self._positions(patches.positions, patches.finest), self.patch(patches.values)], 1)
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
        bands = self.bands(x).unflatten(1, (BANDS, 3)).float()
        x = self.norm_out(x)
        # The cosines are evaluated at the Gaussian's own place: a patch is many pixels, and it wants one.
        picture = 0.5 + 2 * (bands * readers.basis[:, :, None]).sum(1)
        gate, rest, spread = self.last(self.mix(torch.cat([x, readers.facts, picture], 1))).float().split([1, 3, 1], 1)
        # A gate to the colour before: what lies hidden or beside the edit should stay.
        colors = torch.lerp(readers.before, picture, torch.sigmoid(gate)) + 0.2 * rest
        middle, half = (MAX_LOG_VARIANCE + MIN_LOG_VARIANCE) / 2, (MAX_LOG_VARIANCE - MIN_LOG_VARIANCE) / 2
        return LocalAnswer(colors, middle + half * torch.tanh((spread[:, 0] - middle) / half))

    def tokens_of(self, readers: Readers) -> Tensor:
        """[R, D] tokens of Gaussians, which know nothing of an edit."""
        return torch.cat([self._positions(readers.positions, readers.finest), self.gaussian(readers.facts)], 1)

    def _positions(self, positions: Tensor, finest: float) -> Tensor:
        """[T, config.position_width] at rms near 1."""
        count = len(self.directions)
        # Between patches there is nothing finer to tell, and finer waves would only alias.
        shortest = min(finest, COARSEST / 2)
        waves = torch.linspace(math.log(COARSEST), math.log(shortest), count, device=positions.device).exp()
        angles = 2 * math.pi * (positions @ self.directions.mT) / waves
        values = math.sqrt(2) * self.position(torch.cat([angles.sin(), angles.cos()], 1))
        return values - values.mean(1, keepdim=True)  # blocks' norms take the mean off all of a token

    def _start_as_a_memory_of_places(self) -> None:
        """First weights with which every block keeps patches by their places and hands a Gaussian that of its own:
        drawn at random instead, nothing is read from the memory before some 1,000 steps have found a common tongue."""
        config = self.config
        # The first dimensions hold the patch as it is, so that reading it back gives its picture.
        held = min(3 * BANDS, config.content_width)
        self.patch.weight[:held] = torch.eye(held, TOKEN_CHANNELS)
        self.patch.bias[:held] = 0
        self.gaussian.weight[:held], self.gaussian.bias[:held] = 0, 0
        bands = slice(config.position_width, config.position_width + held)
        self.bands.weight.zero_()
        self.bands.weight[:held, bands] = torch.eye(held)
        if config.refine.detail:
            self.detail_mixer.ttt.out.weight.zero_()  # the second set starts as the first
        for k, block in enumerate(self._blocks()):
            start_by_place(block.mixer, config.position_width, bands, FIRST_GAIN if k == 0 else 0.0)

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


def start_by_place(mixer: nn.Module, width: int, held: slice, gain: float) -> None:
    """Keys hear of places alone and queries start as keys; what is kept and read of a token is its dimensions `held`,
    times `gain`."""
    # Queries start as keys: a Gaussian then asks for the place that it lies at.
    count = held.stop - held.start
    if isinstance(mixer, AttentionMixer):
        layers = [mixer.rows] + ([] if mixer.pictures is None else [mixer.pictures])
        for layer in layers:
            dim = len(layer.out.weight)
            keys = layer.kv.weight[:dim]
            keys.zero_()
            keys[:, :width] = KEY_GAIN * _turns(dim, width, layer.heads)
            layer.q.weight.copy_(keys)
            layer.kv.weight[dim:] = torch.eye(dim)
            layer.out.weight.zero_()
            layer.out.weight[held, held] = gain * torch.eye(count)
        return
    if isinstance(mixer, RidgeMixer):
        keys, queries, out = mixer.keys.weight, mixer.queries.values(), mixer.out.weight
        mixer.values.weight.copy_(torch.eye(len(out)))
        out.zero_()
        out[held, held] = gain * torch.eye(count)
    else:
        assert isinstance(mixer, FastMixer)
        dim = mixer.ttt.out.in_features
        keys, queries, out = mixer.ttt.kv.weight[:dim], mixer.ttt.queries.values(), mixer.ttt.out.weight
        mixer.ttt.gain.fill_(ANSWER_RMS)
        values = mixer.ttt.kv.weight[dim:]
        values.zero_()
        out.zero_()
        # silu(x) - silu(-x) = x: what is kept with both signs is read as it was.
        both = min(count, dim // 2)
        index = torch.arange(both)
        values[index, held.start + index], values[both + index, held.start + index] = 1, -1
        out[held.start + index, index], out[held.start + index, both + index] = gain, -gain
    nn.init.normal_(keys, std=FEATURE_STD)
    keys[:, width:] = 0
    for query in queries:
        query.weight.copy_(keys)  # type: ignore[union-attr]


def _turns(dim: int, inputs: int, heads: int) -> Tensor:
    """[D, inputs] for each head other orthogonal directions of places."""
    share = dim // heads
    return torch.cat([nn.init.orthogonal_(torch.empty(share, inputs)) for _ in range(heads)])
