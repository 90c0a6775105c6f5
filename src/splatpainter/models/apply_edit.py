"""The networks' part of an edit: a lifted edit in, new Gaussians out, and both as one asset.

    state, gaussians, children = refine_edit(model, state, encoded, lifted, views)
    edited = assemble(lifted, gaussians, children)

N Gaussians of the asset, A appended by the lift, J that may change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.lift.edit_views import EditView
from splatpainter.lift.edits import LiftedEdit
from splatpainter.splats import ATTRIBUTES, Splats

if TYPE_CHECKING:
    from torch import Tensor

    from splatpainter.models.encode import Encoded
    from splatpainter.models.image_tokens import Pictures
    from splatpainter.models.model import SplatPainterModel
    from splatpainter.models.refine import RefineState


def refine_edit(
    model: SplatPainterModel,
    state: RefineState,
    encoded: Encoded,
    lifted: LiftedEdit,
    views: Sequence[EditView],
    facts: np.ndarray | None = None,
    strength: float | None = None,
) -> tuple[RefineState, Splats[Tensor], Splats[Tensor] | None]:
    """Stage II and the decoder: (next state, J torch Gaussians in place of lifted.splats[lifted.ids], J children to
    append, each of the Gaussian at its index, or None).

    state: model.initial_state() for the first edit; lifted.parents count Gaussians of encoded.gaussians; facts: [J, 21]
    of `gaussian_facts` of these parents, for a model that reads them; strength: overrides config.refine.edit_strength.
    Differentiable in the model's parameters and in the latents; without gradients in chunks. Raises ValueError for
    views of several sizes or without depth and alpha where the model needs them, and for Gaussians that were not
    encoded."""
    latent_ids, base, inputs = _inputs_of(model, encoded, lifted, facts)
    state, decoded = model.edit(
        state,
        encoded.latents,
        _pictures(views, str(encoded.latents.values.device)),
        encoded.gaussians,
        latent_ids=latent_ids,
        **inputs,
        base=base,
        detail=lifted.detail and model.config.refine.detail,
        strength=strength,
    )
    # No children are the same as none asked for: what appends them need not look twice.
    children = decoded.children
    return state, decoded.splats, children if children is not None and len(children) else None


def stage_two_inputs(
    model: SplatPainterModel, encoded: Encoded, lifted: LiftedEdit, facts: np.ndarray | None = None
) -> Tensor:
    """[J, D] what Stage II reads of the Gaussians that may change, before any block. Arguments and ValueError as
    `refine_edit`."""
    from splatpainter.models.model import GaussianInputs

    latent_ids, base, inputs = _inputs_of(model, encoded, lifted, facts)
    means = base.means if model.config.refine.inputs == "normalised" else None
    return model.prepared(encoded.latents, latent_ids, GaussianInputs(means=means, **inputs))


def _inputs_of(
    model: SplatPainterModel, encoded: Encoded, lifted: LiftedEdit, facts: np.ndarray | None
) -> tuple[np.ndarray, Splats[Tensor], dict[str, Tensor | None]]:
    """([J] int64 the latents of the Gaussians that may change, J Gaussians as the lift left them, what is known of them
    beyond: lift, drift and facts, as of model.GaussianInputs)."""
    import torch

    from splatpainter.models.gaussian_groups import drift_features
    from splatpainter.models.predictor import described_facts

    config = model.config.refine
    device = encoded.latents.values.device
    # A Gaussian that the lift split off reads the latent of the one that it came from.
    latent_ids = encoded.latent_ids[lifted.parents]
    missing = int((latent_ids < 0).sum())
    if missing:
        raise ValueError(f"refine: {missing} of the {len(latent_ids)} Gaussians were not encoded; encode again")
    # The network starts from what the lift painted; how far that moved it is told besides, where a model reads it.
    base = lifted.splats.take(lifted.ids).torch(str(device))
    drift = None
    if config.base == "lift":
        drift = drift_features(base, encoded.gaussians.take(lifted.parents), encoded.latents.groups.voxel)
    inputs = {
        "lift": torch.from_numpy(lifted.features).to(device) if config.lift_features else None,
        "drift": drift,
        "facts": None if facts is None else described_facts(torch.from_numpy(facts).to(device)),
    }
    return latent_ids, base, inputs


def assemble(lifted: LiftedEdit, gaussians: Splats[Tensor], children: Splats[Tensor] | None) -> Splats[Any]:
    """The full edited asset: N + A Gaussians with `gaussians` (J, torch) at the indices lifted.ids, then `children`.
    Torch, on their device and differentiable, where `gaussians` need gradients; else numpy, where numbers that did not
    change keep their bits, and attributes of which none changed their array."""
    if any(getattr(gaussians, name).requires_grad for name in ATTRIBUTES):
        import torch

        # Training goes through here too, and needs every attribute differentiable.
        device = gaussians.means.device
        full, index = lifted.splats.torch(str(device)), torch.from_numpy(lifted.ids).to(device)
        changed = {name: getattr(full, name).index_copy(0, index, getattr(gaussians, name)) for name in ATTRIBUTES}
        result = replace(full, **changed)
        return result if children is None else result.append(children)
    arrays, written = gaussians.numpy(), {}
    for name in ATTRIBUTES:
        old, new = getattr(lifted.splats, name), getattr(arrays, name)
        # By bits: arrays that did not change are shared, and the receipt then finds them untouched at no cost.
        if not np.array_equal(new.view(np.int32), old[lifted.ids].view(np.int32)):
            written[name] = old.copy()
            written[name][lifted.ids] = new
    result = replace(lifted.splats, **written) if written else lifted.splats
    return result if children is None else result.append(children.numpy())


def _pictures(views: Sequence[EditView], device: str) -> Pictures:
    """Raises ValueError for views of several sizes."""
    import torch

    from splatpainter.models.image_tokens import Pictures, one_size

    cameras = [view.camera for view in views]
    one_size(cameras)

    def stacked(name: str) -> torch.Tensor | None:
        images = [getattr(view, name) for view in views]
        if any(image is None for image in images):
            return None
        full = torch.from_numpy(np.stack(images).astype(np.float32)).to(device)
        return full if full.ndim == 4 else full[..., None]

    edited = stacked("target")  # outside the mask a picture may differ by how it was stored or scaled
    assert edited is not None
    return Pictures(cameras, edited, *(stacked(name) for name in ("before", "depth", "alpha", "mask")))
