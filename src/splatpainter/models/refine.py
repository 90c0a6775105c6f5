"""Stage II: blocks that adapt to an edit's picture tokens and are then read by latents (arXiv 2512.05354, 3.2, 3.3).

The state (fast weights, per block) is a value that goes in and comes out: the second edit starts where the first ended,
and undo is keeping the old value. Pictures never see latents, so a whole edit adapts first and any number of latents
read afterwards, in runs of any size, with the same result. T picture tokens, K latents, D width.
"""

from __future__ import annotations

import math
from dataclasses import field, replace

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from splatpainter.lift.features import LIFT_FEATURES, SEEN_FEATURE
from splatpainter.models.compress import LatentScale
from splatpainter.models.config import RefineConfig
from splatpainter.models.edits_in_turn import EditsSoFar
from splatpainter.models.gaussian_facts import INPUT_CHANNELS as FACT_FEATURES
from splatpainter.models.image_tokens import PictureTokens
from splatpainter.nn.attention import CrossGroups, Groups
from splatpainter.nn.fast_weights import FastWeights
from splatpainter.nn.layers import CrossAttention, SelfAttention, SwiGLU, layer_norm, linear
from splatpainter.nn.precision import exact
from splatpainter.nn.ttt import Stream, TTTLayer, start_alike
from splatpainter.system.quick_dataclass import dataclass

LATENTS_PER_CHUNK = 1 << 12
"""Latents that are worked on at once without gradients: few enough for what they pass through to stay in the caches."""
DRIFT_FEATURES = 7
"""Numbers per latent that say how its Gaussian differs from the one that was encoded
(gaussian_groups.drift_features)."""
SLOWEST_WAVE, FASTEST_WAVE = 4.0, 0.0625
"""Wavelengths of the place's sines, half edges of the asset's cube: twice the cube, and a sixteenth of half of it."""
FADING_RMS = 0.01
"""A term whose numbers are smaller than this is not raised to rms 1: what did not drift stays nothing."""
ANSWER_GAIN = 4.0
"""Changes of colour are told this many times larger, so that they are of the order of the other numbers."""
FIRST_TRUST = 3.0
"""Logarithm of the size of a ridge mixer's features at first: how much a token counts against the penalty."""
Memory = FastWeights | Tensor
"""What a block knows of the edits so far: fast weights, or (cross_attention) the [T, D] tokens of all of them, or
(ridge) the sums of a regression."""


@dataclass(frozen=True)
class RefineState:
    """What the model has learnt from the edits of a session."""

    blocks: tuple[Memory, ...] = field(repr=False)
    """One per block."""
    detail: Memory | None = field(repr=False)
    """Memory of the extra layer for local detail; None where the model has none."""
    so_far: EditsSoFar | None = field(default=None, repr=False)
    """What global edits have made of the asset (models/edits_in_turn.py); None before the first."""


class FastMixer(nn.Module):
    """Memory by test-time training."""

    def __init__(self, dim: int, config: RefineConfig, *, pictures: bool, gaussians: bool) -> None:
        """pictures: whether picture tokens read too (not where nothing reads them afterwards); gaussians: whether
        Gaussians teach."""
        super().__init__()
        self.ttt = TTTLayer(
            dim,
            config.fast_hidden,
            inner_loss=config.inner_loss,
            inner_steps=config.inner_steps,
            newton_schulz_steps=config.newton_schulz_steps,
            edit_strength=config.edit_strength,
            streams=("image", "voxel") if pictures else ("voxel",),
            teachers=_teachers(config, gaussians),
        )

    def initial(self) -> Memory:
        return self.ttt.initial_state()

    def update(
        self,
        memory: Memory,
        tokens: Tensor,
        weights: Tensor | None,
        strength: float | None,
        teacher_tokens: tuple[Tensor, Tensor] | None = None,
    ) -> Memory:
        assert isinstance(memory, FastWeights)
        # Without gradients in parts: the second set learns from every latent of the edit.
        chunk = None if torch.is_grad_enabled() else LATENTS_PER_CHUNK
        return self.ttt.update(
            memory, tokens, weights, teacher_tokens=teacher_tokens, edit_strength=strength, chunk=chunk
        )

    def read_image_tokens(self, memory: Memory, tokens: Tensor) -> Tensor:
        assert isinstance(memory, FastWeights)
        return self.ttt.read(memory, tokens, "image")

    def read_gaussian_tokens(self, memory: Memory, tokens: Tensor) -> Tensor:
        assert isinstance(memory, FastWeights)
        return self.ttt.read(memory, tokens, "voxel")


class AttentionMixer(nn.Module):
    """The ablation: memory is all tokens so far, read by cross-attention; weights and strength mean nothing here."""

    def __init__(self, dim: int, config: RefineConfig, *, pictures: bool, gaussians: bool) -> None:
        super().__init__()
        self.dim = dim
        self.rows = CrossAttention(dim, config.heads)
        if gaussians:
            start_alike(self.rows.q, self.rows.kv)
        self.pictures = CrossAttention(dim, config.heads) if pictures else None

    def initial(self) -> Memory:
        weight = self.rows.out.weight
        return weight.new_zeros(0, self.dim)

    def update(
        self,
        memory: Memory,
        tokens: Tensor,
        weights: Tensor | None,
        strength: float | None,
        teacher_tokens: tuple[Tensor, Tensor] | None = None,
    ) -> Memory:
        assert isinstance(memory, Tensor)
        new = [tokens.to(memory.dtype)] if teacher_tokens is None else [tokens, teacher_tokens[0].to(memory.dtype)]
        return torch.cat([memory, *new])

    def read_image_tokens(self, memory: Memory, tokens: Tensor) -> Tensor:
        assert isinstance(memory, Tensor) and self.pictures is not None
        return self.pictures(tokens, memory, CrossGroups.of([len(tokens)], [len(memory)], tokens.device))

    def read_gaussian_tokens(self, memory: Memory, tokens: Tensor) -> Tensor:
        assert isinstance(memory, Tensor)
        return self.rows(tokens, memory, CrossGroups.of([len(tokens)], [len(memory)], tokens.device))


class RidgeMixer(nn.Module):
    """Memory by a ridge regression on learnt features, solved exactly (a "Mesa" layer, arXiv 2309.05858); it keeps the
    sums that the regression needs, [F, F + D] of F = config.fast_hidden features, so edits add up."""

    def __init__(self, dim: int, config: RefineConfig, *, pictures: bool, gaussians: bool) -> None:
        """gaussians: must be False."""
        super().__init__()
        assert not gaussians, "a ridge mixer has no Gaussians that teach"
        self.strength = config.edit_strength
        self.keys = linear(dim, config.fast_hidden)
        self.values = linear(dim, dim)
        self.queries = nn.ModuleDict(
            {stream: linear(dim, config.fast_hidden) for stream in ("voxel", *(["image"] if pictures else []))}
        )
        self.rates = linear(dim, 1)
        self.out = linear(dim, dim)
        self.trust = nn.Parameter(torch.tensor(FIRST_TRUST))

    def initial(self) -> Memory:
        features, dim = self.keys.weight.shape
        return self.keys.weight.new_zeros(features, features + dim)

    def update(
        self,
        memory: Memory,
        tokens: Tensor,
        weights: Tensor | None,
        strength: float | None,
        teacher_tokens: tuple[Tensor, Tensor] | None = None,
    ) -> Memory:
        assert isinstance(memory, Tensor) and teacher_tokens is None
        # Sums add up over edits, so the order of edits does not matter to the regression.
        counts = 2 * torch.sigmoid(self.rates(tokens).float()) * (self.strength if strength is None else strength)
        counts = counts if weights is None else counts * weights[:, None]
        phi, values = self._features(self.keys, tokens), self.values(tokens).float()
        with exact(memory.device):
            return memory + (phi * counts).mT @ torch.cat([phi, values], 1)

    def read_image_tokens(self, memory: Memory, tokens: Tensor) -> Tensor:
        return self._read(memory, tokens, "image")

    def read_gaussian_tokens(self, memory: Memory, tokens: Tensor) -> Tensor:
        return self._read(memory, tokens, "voxel")

    def _read(self, memory: Memory, tokens: Tensor, stream: str) -> Tensor:
        assert isinstance(memory, Tensor)
        features, queries = len(memory), self._features(self.queries[stream], tokens)
        with exact(memory.device):
            # Solved in float64: the sums of many tokens are far apart in size.
            wide = memory.double()
            gram = wide[:, :features] + torch.eye(features, dtype=wide.dtype, device=wide.device)
            solved = torch.cholesky_solve(wide[:, features:], torch.linalg.cholesky(gram)).float()
            answer = queries @ solved
        return self.out(answer)

    def _features(self, layer: nn.Module, tokens: Tensor) -> Tensor:
        return functional.normalize(functional.silu(layer(tokens)).float(), dim=-1) * self.trust.exp()


def _mixer(
    dim: int, config: RefineConfig, *, pictures: bool, gaussians: bool
) -> FastMixer | AttentionMixer | RidgeMixer:
    kind = {"ttt": FastMixer, "cross_attention": AttentionMixer, "ridge": RidgeMixer}[config.mixer]
    return kind(dim, config, pictures=pictures, gaussians=gaussians)


class RefineBlock(nn.Module):
    """A mixer with one memory for both streams, and an MLP for each; pre-norm, residual."""

    def __init__(self, dim: int, config: RefineConfig, *, last: bool) -> None:
        """last: nothing reads this block's picture tokens, so it has no weights to make them."""
        super().__init__()
        self.last, self.pictures = last, config.picture_tokens
        if config.image_attention:
            self.norm_attention = layer_norm(dim)
            self.attention = SelfAttention(dim, config.heads)
        read = config.picture_tokens and not last
        self.mixer = _mixer(dim, config, pictures=read, gaussians=config.row_tokens > 0)
        if config.picture_tokens:
            self.norm_pictures = layer_norm(dim)
        self.norm_rows = layer_norm(dim)
        self.norm_rows_mlp = layer_norm(dim)
        self.mlp_rows = SwiGLU(dim, config.hidden)
        if read:
            self.norm_pictures_mlp = layer_norm(dim)
            self.mlp_pictures = SwiGLU(dim, config.hidden)

    def adapt(
        self,
        memory: Memory,
        x: Tensor,
        weights: Tensor | None,
        groups: Groups | None,
        strength: float | None,
        teachers: Tensor | None,
        shares: Tensor | None,
    ) -> tuple[Memory, Tensor, Tensor | None]:
        """The memory after the edit, and what the next block learns from: picture tokens [T, D] and teaching latents
        [R, D] or None. groups: pictures; shares: [R] 0..1, how much each of these latents counts."""
        if groups is not None:
            x = x + self.attention(self.norm_attention(x), groups)
        tokens = self.norm_pictures(x) if self.pictures else x
        normalised = None if teachers is None or shares is None else (self.norm_rows(teachers), shares)
        memory = self.mixer.update(memory, tokens, weights, strength, normalised)
        if self.last:
            return memory, x, teachers
        if self.pictures:
            x = x + self.mixer.read_image_tokens(memory, tokens)
            x = x + self.mlp_pictures(self.norm_pictures_mlp(x))
        return memory, x, None if teachers is None else self.read(memory, teachers)

    def read(self, memory: Memory, x: Tensor) -> Tensor:
        """Latents [K, D] after this block."""
        x = x + self.mixer.read_gaussian_tokens(memory, self.norm_rows(x))
        return x + self.mlp_rows(self.norm_rows_mlp(x))


class Refiner(nn.Module):
    """Stage II with its slow weights."""

    def __init__(self, config: RefineConfig, dim: int, token_dim: int = 0) -> None:
        """dim: width of the latents; token_dim: of the LRM's tokens, for a model that reads those of pictures."""
        super().__init__()
        self.config, self.dim = config, dim
        if config.picture_tokens:
            self.pictures = linear(token_dim if config.tokenizer == "lrm" else config.patch**2 * config.channels, dim)
        if config.lift_features:
            self.lift = nn.Linear(LIFT_FEATURES, dim, bias=False)  # torch's own spread: 0.02 would drown 7 numbers
        if config.base == "lift":
            self.drift = nn.Linear(DRIFT_FEATURES, dim, bias=False)
        if config.facts:
            self.facts = nn.Linear(FACT_FEATURES, dim, bias=False)
        last = config.blocks - 1
        self.blocks = nn.ModuleList(RefineBlock(dim, config, last=i == last) for i in range(config.blocks))
        if config.detail:
            self.detail_mixer = _mixer(dim, config, pictures=False, gaussians=False)
            self.norm_refined = layer_norm(dim)
            self.norm_original = layer_norm(dim)

    def initial_state(self) -> RefineState:
        """The state before any edit: the learned first fast weights (the parameters themselves: do not write)."""
        blocks = tuple(block.mixer.initial() for block in self._blocks())
        return RefineState(blocks, self.detail_mixer.initial() if self.config.detail else None)

    def adapt(
        self,
        state: RefineState,
        tokens: PictureTokens | None,
        *,
        teacher_tokens: tuple[Tensor, Tensor] | None = None,
        strength: float | None = None,
    ) -> RefineState:
        """The state after an edit. tokens: None where pictures do not teach. teacher_tokens: ([R, D] latents from
        `prepare` that teach along, see `teacher_ids`, [R] 0..1 how much each counts), for a model with row_tokens;
        strength: overrides config.edit_strength. An edit without tokens changes nothing. Permuting the pictures changes
        the state by rounding only."""
        teachers, shares = teacher_tokens or (None, None)
        groups = weights = None
        if self.config.picture_tokens:
            assert tokens is not None, "a model that pictures teach"
            # Without tokens there is nothing to learn, and the state stays the same bits.
            if len(tokens.pixels) == 0:
                return state
            with exact(tokens.pixels.device):  # float32, so that so is the sum that the blocks add to
                x = self.pictures(tokens.pixels)
            groups = Groups.of(tokens.lengths, x.device) if self.config.image_attention else None
            weights = tokens.weights if self.config.mask_tokens else None
        elif teachers is None:
            return state
        else:
            x = teachers.new_zeros(0, self.dim)
        # Block after block: each learns from what the one before made of the tokens.
        memories = []
        for block, memory in zip(self._blocks(), state.blocks, strict=True):
            if self._recompute():
                step = (memory, x, weights, groups, strength, teachers, shares)
                memory, x, teachers = checkpoint(block.adapt, *step, use_reentrant=False)  # type: ignore[misc]
            else:
                memory, x, teachers = block.adapt(memory, x, weights, groups, strength, teachers, shares)
            memories.append(memory)
        return replace(state, blocks=tuple(memories))

    def teacher_ids(self, lift: Tensor | None) -> Tensor | None:
        """[R] int64 the latents that teach along with the pictures: at most config.row_tokens, those that the edit
        shows most (lift: [K, 13], see `prepare`); None for a model without, or where the edit shows none."""
        if not self.config.row_tokens or lift is None:
            return None
        # The number is bounded so that the cost of an edit does not grow with the asset.
        seen = lift[:, SEEN_FEATURE]
        count = min(self.config.row_tokens, int((seen > 0).sum()))
        return torch.topk(seen, count).indices if count else None

    def prepare(
        self,
        latents: Tensor,
        lift: Tensor | None,
        drift: Tensor | None = None,
        *,
        scale: LatentScale | None = None,
        positions: Tensor | None = None,
        facts: Tensor | None = None,
        teaching: bool = False,
    ) -> Tensor:
        """[K, D] latents with what is known of their Gaussians beyond. lift: [K, 13] colour before, colour after, seen,
        colour predicted (0..1), and unit normal, for a model with lift features; drift: [K, 7] of
        `drift_features`, for one with base "lift" (None: the Gaussians are those that were encoded). Of "normalised"
        inputs: scale, of all latents of the asset, and positions, [K, 3] in the asset's cube, -1..1. facts: [K, 56] of
        `predictor.described_facts`, for a model with facts. teaching: these Gaussians teach, so that they are told the
        lift's answer where config.answers is "teachers". Raises ValueError where they are missing or of another
        shape."""
        config, count = self.config, len(latents)
        normalised = config.inputs == "normalised"
        terms = []
        if config.lift_features:
            _check("lift features", lift, [count, LIFT_FEATURES])
            assert lift is not None
            # As changes, not as two colours: an edit that changes nothing then says zero.
            before, after, seen, predicted, normal = lift.split([3, 3, 1, 3, 3], dim=1)
            gain = ANSWER_GAIN if normalised else 2
            answers = torch.cat([gain * (after - before), seen, gain * (predicted - before)], dim=1)
            if config.answers == "teachers" and not teaching:
                # Readers must not be told what they are to say, or the memory would not be needed.
                answers = torch.zeros_like(answers)
            inputs = torch.cat([2 * before - 1, answers, normal], dim=1)
            terms.append((self.lift, inputs))
        if config.base == "lift" and drift is not None:
            _check("drift", drift, [count, DRIFT_FEATURES])
            terms.append((self.drift, drift))
        if config.facts:
            _check("facts", facts, [count, FACT_FEATURES])
            assert facts is not None
            terms.append((self.facts, facts))
        with exact(latents.device):
            if normalised:
                _check("positions", positions, [count, 3])
                if scale is None:
                    raise ValueError("refine: expected the scale of the asset's latents, got None")
                assert positions is not None
                latents = (latents - scale.mean) / scale.rms + position_waves(positions, latents.shape[1])
            for layer, inputs in terms:
                term = layer(inputs.to(layer.weight.dtype))
                latents = latents + (unit_rms(term) if normalised else term)
        return latents

    def read(self, state: RefineState, latents: Tensor, *, chunk: int | None = None) -> Tensor:
        """Refined latents [K, D]; each depends on the state and on itself alone. latents: [K, D] from `prepare`;
        chunk: latents at once (LATENTS_PER_CHUNK without gradients, else all)."""
        # Latents do not see each other, so that runs of any size give the same.
        size = chunk or (max(len(latents), 1) if torch.is_grad_enabled() else LATENTS_PER_CHUNK)
        parts = []
        for x in latents.split(size):
            for block, memory in zip(self._blocks(), state.blocks, strict=True):
                x = (
                    checkpoint(block.read, memory, x, use_reentrant=False)
                    if self._recompute()
                    else block.read(memory, x)
                )
                assert isinstance(x, Tensor)
            parts.append(x)
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    def learn_detail(self, state: RefineState, refined: Tensor, *, strength: float | None = None) -> RefineState:
        """The state after the extra layer has learnt from the refined latents [K, D] of a local edit."""
        assert self.config.detail and state.detail is not None, "a model without detail layer"
        memory = self.detail_mixer.update(state.detail, self.norm_refined(refined), None, strength)
        return replace(state, detail=memory)

    def read_detail(self, state: RefineState, original: Tensor) -> Tensor:
        """A second set of latents [K, D]: what the extra layer says to the original ones, from `prepare`; each by
        itself."""
        assert state.detail is not None, "a model without detail layer"
        return original + self.detail_mixer.read_gaussian_tokens(state.detail, self.norm_original(original))

    def _blocks(self) -> list[RefineBlock]:
        return [block for block in self.blocks if isinstance(block, RefineBlock)]

    def _recompute(self) -> bool:
        return self.config.checkpoint_activations and torch.is_grad_enabled()


def position_waves(positions: Tensor, dim: int) -> Tensor:
    """[K, D] sines and cosines of positions [K, 3], -1..1 in the asset's cube, at rms 1: per axis D // 6 wavelengths
    from SLOWEST_WAVE to FASTEST_WAVE half edges, evenly in their logarithm ("Fourier features", arXiv 2006.10739); what
    is left of D stays zero."""
    # Waves evenly in their logarithm: the coarse ones tell sides apart, the fine ones neighbours.
    count = max(dim // 6, 1)
    waves = torch.linspace(math.log(SLOWEST_WAVE), math.log(FASTEST_WAVE), count, device=positions.device).exp()
    angles = (2 * math.pi * positions.float()[:, :, None] / waves).flatten(1)  # [K, 3 count]
    values = torch.cat([angles.sin(), angles.cos()], dim=1)[:, :dim]
    return functional.pad(values * math.sqrt(2 * dim / values.shape[1]), (0, dim - values.shape[1]))


def unit_rms(term: Tensor) -> Tensor:
    """Each line of term [K, D] at rms 1; those far below FADING_RMS stay near zero."""
    return term * (term.square().mean(-1, keepdim=True) + FADING_RMS**2).rsqrt()


def _teachers(config: RefineConfig, gaussians: bool) -> tuple[Stream, ...]:
    """Who trains a mixer's memory. gaussians: whether Gaussians do."""
    if not gaussians:
        return ("image",)
    return ("image", "voxel") if config.picture_tokens else ("voxel",)


def _check(what: str, values: Tensor | None, shape: list[int]) -> None:
    if values is None or list(values.shape) != shape:
        raise ValueError(f"refine: expected {what} {shape}, got {None if values is None else list(values.shape)}")
