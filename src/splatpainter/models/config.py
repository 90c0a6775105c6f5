"""Sizes and switches of the model: frozen dataclasses, the presets `paper` and `compact`, and their JSON.

The dataclass is the command line, the JSON in the checkpoint and the documentation. The defaults are the paper's
(arXiv 2512.05354). Every switch of the ablation tables is a field here. Knows no torch.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import field
from typing import Any, ClassVar, Literal, TypeVar

from splatpainter.lift.options import ResidualBase
from splatpainter.system import jsonio
from splatpainter.system.quick_dataclass import dataclass

Grouping = Literal["feats_query", "latent_query", "voxel_mean"]
Mixer = Literal["ttt", "cross_attention", "ridge"]
InnerLoss = Literal["dot", "l2"]
ImageChannels = Literal["edited", "rays", "render", "geometry", "mask", "normals"]
Representation = Literal["native", "copy"]
Decoder = Literal["residual", "bounded", "absolute"]
Inputs = Literal["raw", "normalised"]
Answers = Literal["all", "teachers"]
Tokenizer = Literal["linear", "lrm"]
_Config = TypeVar("_Config")

CHANNELS: dict[str, int] = {"edited": 3, "rays": 6, "render": 3, "geometry": 4, "mask": 1, "normals": 3}
"""Channels per pixel of each group that an image token of an edit can hold."""
MISSING_KEY_DEFAULTS: dict[str, Any] = {
    "predict": {"features": 0, "hidden": 128, "alone": False},
    "refine.inputs": "raw",
    "refine.answers": "all",
    "refine.facts": False,
    "refine.picture_tokens": True,
    "refine.latents": True,
    "refine.tokenizer": "linear",
}
"""Keys that older checkpoints lack, and what they mean there."""
MAX_CONFIG_BYTES = 1 << 20
"""Bytes; no honest config is longer."""


@dataclass(frozen=True)
class LrmConfig:
    """The Gaussian LRM (GS-LRM, Zhang et al. 2024): canonical views in, patch tokens and one Gaussian per pixel out."""

    patch: int = 8
    """Pixels per edge of a patch."""
    dim: int = 1024
    """Width of a token."""
    layers: int = 24
    """Transformer blocks over the tokens of all views."""
    heads: int = 16
    """Attention heads per block; dim is a multiple of it."""
    hidden: int = 4096
    """Hidden width of each block's MLP."""
    sh_degree: int = 3
    """Degree of the spherical harmonics of the predicted Gaussians, 0..4."""
    views: int = 9
    """Canonical views that an asset is rendered from, 1..16."""
    image_size: int = 512
    """Edge of a canonical view, pixels; a multiple of patch."""
    geometry: bool = False
    """Also see rendered depth and alpha and predict offsets from that depth: geometry is given, not guessed."""
    checkpoint_activations: bool = False
    """Recompute each block in the backward pass: less memory, one more forward pass."""

    def __post_init__(self) -> None:
        _positive(self, "patch", "dim", "layers", "heads", "hidden", "views", "image_size")
        _multiple(self, "dim", "heads")
        _multiple(self, "image_size", "patch")
        _degree(self)
        if self.views > 16:
            raise ValueError(f"config: expected at most 16 canonical views, got {self.views}")


@dataclass(frozen=True)
class CompressConfig:
    """Stage I, the transformer inside each voxel: Gaussians with their LRM tokens in, latents out."""

    dim: int = 512
    """Width of a latent, in Stage I and Stage II."""
    heads: int = 8
    """Attention heads; dim is a multiple of it."""
    encoder_layers: int = 6
    """Self-attention layers over all Gaussians of a voxel."""
    decoder_layers: int = 6
    """Self-attention layers over the kept Gaussians of a voxel."""
    hidden: int = 1344
    """Hidden width of the SwiGLU MLPs; the paper is silent: 8/3 of dim (Shazeer 2020), to a multiple of 64."""
    keep: float = 0.25
    """Share of a voxel's Gaussians that `copy` keeps, K = max(floor(keep * N_k), 1); `native` keeps all."""
    grouping: Grouping = "feats_query"
    """feats_query: the kept Gaussians' own codes query their voxel. Ablations: latent_query (learned queries) and
    voxel_mean (VoxelAtt: every kept Gaussian gets the mean of its voxel's tokens, no attention between Gaussians)."""
    latent_queries: int = 64
    """Learned queries of latent_query; the k-th kept Gaussian of a voxel asks with query k modulo this."""
    resolution: int = 128
    """Voxels per edge of the asset's bounding cube."""
    min_opacity: float = 0.005
    """`copy` drops the LRM's Gaussians at or below this opacity before anything else; the paper is silent."""
    largest_group: int = 0
    """Voxels with more Gaussians are cut into runs of at most this many Gaussians of falling opacity; 0: never (the
    paper)."""
    checkpoint_activations: bool = False
    """Recompute each layer in the backward pass."""

    def __post_init__(self) -> None:
        _positive(self, "dim", "heads", "hidden", "latent_queries", "resolution")
        _positive(self, "encoder_layers", "decoder_layers", "largest_group", least=0)
        _multiple(self, "dim", "heads")
        if not 0 < self.keep <= 1:
            raise ValueError(f"config: expected keep above 0 and at most 1, got {self.keep}")


@dataclass(frozen=True)
class RefineConfig:
    """Stage II: blocks that adapt to the edited pictures and are read by picture tokens and by latents."""

    blocks: int = 8
    """Blocks of (mixer, MLP)."""
    mixer: Mixer = "ttt"
    """ttt: fast weights trained by the edit. Ablations: cross_attention, latents attend to the pictures' tokens; ridge:
    a regression on learnt features, solved exactly (Mesa), of the local network (models/local_network.py) alone."""
    fast_hidden: int = 2048
    """Hidden width of the fast SwiGLU network."""
    hidden: int = 1344
    """Hidden width of the slow SwiGLU MLPs, one for pictures and one for latents per block."""
    heads: int = 8
    """Attention heads of cross_attention and of image_attention; the TTT layer has one."""
    patch: int = 8
    """Pixels per edge of a picture token."""
    tokenizer: Tokenizer = "linear"
    """What makes a token of a picture's patch. linear: a map of its pixels (image_channels) that Stage II trains. lrm
    (the paper): the LRM's own, as Stage I leaves it, which no edit and no training of Stage II changes; then a linear
    map to the width of Stage II. It reads what the LRM reads of a view, whatever image_channels says, so it needs an
    LRM (latents) of patches of this size."""
    image_channels: tuple[ImageChannels, ...] = ("edited", "rays")
    """What a picture token holds: the edited colours, the rays, and beyond the paper the current render, its positions
    and alpha ("geometry"), the edit mask, and the normals of those positions."""
    image_attention: bool = False
    """Self-attention inside each picture before the TTT layer, as LaCT has it for novel view synthesis."""
    mask_tokens: bool = False
    """Tokens train the fast weights in proportion to their share of edited pixels; False: all alike."""
    lift_features: bool = False
    """Latents also get the analytic lift's answer (colour before and after, how much of the Gaussian was seen, the
    colour that its regression predicts) and the Gaussian's normal, turned outwards."""
    row_tokens: int = 0
    """Gaussians that teach the fast weights along with the pictures, those that the edit shows most; 0: none (the
    paper). They carry the lift's answer, so what is seen of an edit is learnt in the form in which unseen Gaussians
    are then asked about it."""
    inputs: Inputs = "raw"
    """What Stage II makes of what it is given. raw (the paper): the sum of latents and of what is known beyond them.
    normalised: latents centred and scaled over the asset, every further term at rms 1, and sines of the Gaussian's
    place; without it, latents that hardly differ between Gaussians (0.15 % of the power in the first weights) leave
    adaptation nothing to tell them apart by."""
    answers: Answers = "all"
    """Whose inputs hold the lift's answer. all: every Gaussian's. teachers: only those of the Gaussians that teach, so
    that what others learn of the edit comes through the memory alone; global edits are then what that memory predicts
    for Gaussians that no picture shows (models/edit_propagation.py)."""
    facts: bool = False
    """Gaussians also come with what the predictor knows of them (predictor.gaussian_facts: normal, size, the light that
    reaches them)."""
    latents: bool = True
    """Whether Gaussians are told by what the LRM and Stage I know of them. False: by what is known without (place,
    colour, normal, facts); such a model has neither network, and an asset needs no encoding."""
    picture_tokens: bool = True
    """Whether tokens of the edited pictures teach; without them only Gaussians do (row_tokens), which no renderer is
    needed to train (`train rows`)."""
    base: ResidualBase = "own"
    """What the decoder's residual is added to. own: the Gaussian as it is (the paper): untrained weights leave the
    asset as it is, and detail comes from the second set. lift: the analytic lift's answer, with the Gaussians that the
    lift splits and appends: untrained weights return the lift; there is no second set (detail=False). The presets say
    own; the config in a checkpoint says what its weights were trained for, and wins over the preset of its name."""
    detail: bool = True
    """An extra layer that makes a second set of latents for local edits (the count doubles there)."""
    inner_loss: InnerLoss = "l2"
    """What the fast weights minimise: l2, |f(k) - v|^2 / 2 (the paper's equation), or dot, -<f(k), v> (LaCT's code)."""
    inner_steps: int = 1
    """Updates per edit, 1..16."""
    newton_schulz_steps: int = 5
    """Iterations that orthogonalise an update; 0: plain gradient ascent."""
    edit_strength: float = 1.0
    """Factor on every update of the fast weights; 1 is the paper's."""
    checkpoint_activations: bool = False
    """Recompute each block in the backward pass."""

    def __post_init__(self) -> None:
        _positive(self, "blocks", "fast_hidden", "hidden", "heads", "patch")
        _positive(self, "newton_schulz_steps", "row_tokens", least=0)
        # What does not go together is refused here: a model that was trained in vain costs hours.
        if self.row_tokens and not self.lift_features:
            raise ValueError("config: expected row_tokens only with lift_features")
        if self.row_tokens and self.mixer != "ttt" and self.picture_tokens:
            raise ValueError("config: expected row_tokens only with mixer='ttt', or without picture_tokens")
        if not self.row_tokens and (not self.picture_tokens or self.answers == "teachers"):
            raise ValueError("config: expected row_tokens above 0 with answers='teachers' or without picture_tokens")
        if not 1 <= self.inner_steps <= 16:
            raise ValueError(f"config: expected inner_steps 1..16, got {self.inner_steps}")
        if not 0 <= self.edit_strength < float("inf"):
            raise ValueError(f"config: expected an edit_strength of 0 or more, got {self.edit_strength}")
        if "edited" not in self.image_channels or len(set(self.image_channels)) < len(self.image_channels):
            raise ValueError(f"config: expected image_channels with 'edited', each once, got {self.image_channels}")
        if self.base == "lift" and self.detail:
            raise ValueError("config: expected detail=False with base='lift': there the lift adds Gaussians")

    @property
    def channels(self) -> int:
        """Channels per pixel of a picture token."""
        return sum(CHANNELS[name] for name in self.image_channels)


@dataclass(frozen=True)
class PredictConfig:
    """What Gaussians that no picture shows become in a global edit: features for a regression (models/predictor.py)."""

    features: int = 0
    """Features per Gaussian, for lightness and hue each; 0: no predictor, the lift's regression (as in the paper)."""
    hidden: int = 128
    """Width of the network that makes the features."""
    alone: bool = False
    """The predictor alone makes global edits, without Stage II and without encoding the asset (`native` only)."""

    def __post_init__(self) -> None:
        _positive(self, "features", least=0)
        _positive(self, "hidden")


@dataclass(frozen=True)
class ModelConfig:
    """The whole model."""

    format: ClassVar[str] = "splatpainter model"
    """Format name in its checkpoints."""
    preset: str = "paper"
    """Name under which checkpoints of this model are found."""
    representation: Representation = "copy"
    """native: the voxels hold the user's own Gaussians, all kept; copy: the LRM's Gaussians, thinned out (the
    paper)."""
    sh_degree: int = 3
    """Degree of the spherical harmonics that Stage I sees and the decoder changes, 0..4; higher bands of a Gaussian
    stay."""
    lrm: LrmConfig = field(default_factory=LrmConfig)
    """The Gaussian LRM."""
    compress: CompressConfig = field(default_factory=CompressConfig)
    """Stage I."""
    refine: RefineConfig = field(default_factory=RefineConfig)
    """Stage II."""
    predict: PredictConfig = field(default_factory=PredictConfig)
    """The predictor of unseen Gaussians, beyond the paper."""
    decoder: Decoder = "residual"
    """residual: on the Gaussian's own attributes, centres in voxels, zero at first, so that an untrained model is the
    identity; bounded: likewise, centres in the Gaussian's own size and all of it within limits, so that Gaussians far
    finer than any in training stay in place; absolute: the paper's, relative to nothing but the voxel."""

    def __post_init__(self) -> None:
        _degree(self)
        if self.compress.dim % self.refine.heads:
            sizes = f"{self.compress.dim} and {self.refine.heads}"
            raise ValueError(f"config: expected compress.dim a multiple of refine.heads, got {sizes}")
        if self.refine.tokenizer == "lrm":
            if not (self.refine.latents and self.refine.picture_tokens):
                raise ValueError("config: expected latents and picture_tokens with tokenizer='lrm'")
            if self.refine.patch != self.lrm.patch:
                sizes = f"{self.refine.patch} and {self.lrm.patch}"
                raise ValueError(f"config: expected refine.patch of lrm.patch with tokenizer='lrm', got {sizes}")
        if not self.refine.latents and (self.refine.inputs != "normalised" or self.representation != "native"):
            raise ValueError("config: expected inputs='normalised' and representation='native' with latents=False")
        if self.refine.base == "lift" and self.decoder == "absolute":
            raise ValueError("config: expected a residual decoder with refine.base='lift', got 'absolute'")

    @property
    def predictor_only(self) -> bool:
        """Whether global edits need neither Stage II nor an encoded asset: the predictor makes them, or, while it is
        untrained, the lift's own regression."""
        return self.predict.alone and self.predict.features > 0 and self.representation == "native"

    @property
    def edits_locally(self) -> bool:
        """Whether Stage II makes local edits. One that only shown Gaussians teach (`train rows`) has learnt what
        pictures do not show, in global edits alone: local ones are then the lift's."""
        return self.refine.answers != "teachers" or self.refine.picture_tokens

    @property
    def carries(self) -> bool:
        """Whether Stage II alone says what becomes of Gaussians that no picture of a global edit shows, in place of the
        lift's regression (models/edit_propagation.py)."""
        # An absolute decoder says colours and no changes, and there is nothing in them to carry on.
        native = self.representation == "native" and self.decoder != "absolute"
        return native and not self.edits_locally and not self.predictor_only

    def to_json(self) -> str:
        """Every field, nested as here, two spaces per level."""
        return json.dumps(dataclasses.asdict(self), indent=2)

    @staticmethod
    def from_json(text: str, where: str = "config") -> ModelConfig:
        """Parse what `to_json` wrote. Raises ValueError naming `where` and the key that is unknown, missing or of the
        wrong kind."""
        return read_json(ModelConfig, text, where)


def read_json(kind: type[_Config], text: str, where: str) -> _Config:
    """A config of this dataclass, every field of which is in the JSON text. Raises ValueError as
    ModelConfig.from_json."""
    values = jsonio.load_object(text, where, "model config", MAX_CONFIG_BYTES)
    return jsonio.build(kind, values, where, what="model config", older=MISSING_KEY_DEFAULTS)


def _positive(config: Any, *names: str, least: int = 1) -> None:
    for name in names:
        if getattr(config, name) < least:
            raise ValueError(f"config: expected {name} of at least {least}, got {getattr(config, name)}")


def _multiple(config: Any, name: str, divisor: str) -> None:
    a, b = getattr(config, name), getattr(config, divisor)
    if a % b:
        raise ValueError(f"config: expected {name} a multiple of {divisor}, got {a} and {b}")


def _degree(config: Any) -> None:
    if not 0 <= config.sh_degree <= 4:
        raise ValueError(f"config: expected sh_degree 0..4, got {config.sh_degree}")


PAPER = ModelConfig()
"""The sizes that the paper states. Two deviations by default: the decoder is a residual that starts at zero, so that
untrained weights leave the asset as it is (the paper's own: decoder="absolute"), and the fast weights take one step
(its text says five gradient steps: refine.inner_steps=5)."""

COMPACT = ModelConfig(
    preset="compact",
    representation="native",
    lrm=LrmConfig(dim=256, layers=6, heads=4, hidden=768, sh_degree=1, views=8, image_size=128, geometry=True),
    compress=CompressConfig(
        dim=256, heads=4, encoder_layers=2, decoder_layers=2, hidden=256, latent_queries=16, largest_group=512
    ),
    refine=RefineConfig(
        blocks=2,
        fast_hidden=256,
        inner_loss="dot",
        hidden=128,
        heads=4,
        image_channels=("edited", "rays", "render", "geometry", "mask", "normals"),
        mask_tokens=True,
        lift_features=True,
        row_tokens=2048,
        inputs="normalised",
    ),
    predict=PredictConfig(features=64, alone=True),
    decoder="bounded",
)
"""One unified model for local and global edits, on two CPU cores. Stage II spends 1.7 MFLOP per Gaussian, so that a
global edit of 100,000 Gaussians fits in 2.5 s also where only float32 is fast (AVX2). What ships trained has this
predictor, and a smaller Stage II without LRM and Stage I, for global edits alone (recipes/compact-rows.json)."""

PRESETS = {"paper": PAPER, "compact": COMPACT}
