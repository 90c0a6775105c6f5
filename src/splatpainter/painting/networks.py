"""A painter's networks: what each of them does with an asset, without gradients and in the arithmetic asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.nn.precision import Arithmetic, Precision, autocast, resolve
from splatpainter.painting.asset import Asset, EncodedAsset
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.lift.edit_views import EditView
    from splatpainter.lift.edits import LiftedEdit
    from splatpainter.lift.global_edit import Predict
    from splatpainter.models.edit_propagation import CarriedEdit
    from splatpainter.models.edits_in_turn import EditInTurn
    from splatpainter.models.local_network import LocalNetwork
    from splatpainter.models.model import SplatPainterModel
    from splatpainter.splats import Splats


@dataclass(frozen=True)
class Networks:
    """The trained networks of a preset."""

    model: SplatPainterModel = field(repr=False)
    precision: Precision
    """Arithmetic (nn.precision)."""
    cache: bool
    """Whether encoded assets are kept on disk."""

    def encode(self, asset: Asset) -> Asset:
        """The asset with its encoding for the model; the same one where it has that already. In `copy` representation
        its Gaussians are then Stage I's."""
        model = self.model
        # Later edits go on from the same encoding: encoding again would lose what the edits before taught.
        if asset.encoding is not None and asset.encoding.model is model:
            return asset
        from splatpainter.models.cache import encode_cached, encode_half

        with self.inference():
            if self.cache:
                encoded = encode_cached(model, asset.splats, asset.grid, weights=self._digest)
            else:
                encoded = encode_half(model, asset.splats, asset.grid)
        # The asset's own Gaussians are not those that Stage I has read; later edits have to name the latter.
        if model.config.representation == "copy":
            asset = Asset(encoded.gaussians.numpy())
        return replace(asset, encoding=EncodedAsset(model, encoded, np.arange(len(asset.splats))))

    def predict(self, asset: Asset) -> Predict | None:
        """The predictor's answer for Gaussians that no view shows; None where it leaves that to the lift."""
        from splatpainter.models.stored_predictor import predicting

        return predicting(self.model.stored_predictor, asset.splats, asset.normals, lambda: asset.transfer)

    def in_turn(self, asset: Asset, views: Sequence[EditView]) -> EditInTurn:
        """A global edit by Stage II with what it goes on from; the asset is encoded."""
        from splatpainter.models.edits_in_turn import EditInTurn

        encoding = asset.encoding
        assert encoding is not None
        so_far = None if encoding.state is None else encoding.state.so_far
        return EditInTurn.of(so_far, asset.splats, asset.normals, encoding.parent_ids, views)

    def carry(self, asset: Asset, before: Splats) -> CarriedEdit:
        """Stage II's answer for Gaussians that no view shows. before: those of the encoded asset, in the colours before
        all edits that this one goes on from."""
        from splatpainter.models.edit_propagation import CarriedEdit

        encoding = asset.encoding
        assert encoding is not None
        latents, ids = encoding.encoded.latents, encoding.encoded.latent_ids[encoding.parent_ids]
        with self.inference():
            return CarriedEdit(self.model, latents, ids, before, asset.normals, lambda: asset.transfer)

    def refine(self, asset: Asset, lifted: LiftedEdit, views: Sequence[EditView]) -> Asset:
        """The encoded asset after Stage II and the decoder have changed a lifted edit of it."""
        from splatpainter.models.apply_edit import assemble, refine_edit

        encoding = asset.encoding
        assert encoding is not None
        # Latents belong to the Gaussians that were encoded, so parents are followed back through all edits since.
        start = replace(lifted, parents=encoding.parent_ids[lifted.parents])
        with self.inference():
            state = encoding.state or self.model.initial_state()
            facts = self._facts(asset, lifted.parents)
            state, gaussians, children = refine_edit(self.model, state, encoding.encoded, start, views, facts)
            splats = assemble(lifted, gaussians, children)
        # Children go last, and descend from the Gaussian that each was decoded for.
        parents = lifted.parent_ids(len(asset.splats))
        parents = parents if children is None else np.append(parents, lifted.parents)
        after = replace(asset.child(splats, parents), confidence=lifted.confidence)
        assert after.encoding is not None
        return replace(after, encoding=replace(after.encoding, state=state))

    @property
    def arithmetic(self) -> Arithmetic:
        """What Stage I and II compute in."""
        return resolve(self.precision, next(self.model.parameters()).device)

    @property
    def predictor_is_untrained(self) -> bool:
        """Whether global edits without Stage II are the lift's."""
        predictor = self.model.stored_predictor
        return predictor is None or predictor.is_untrained

    def _facts(self, asset: Asset, ids: np.ndarray) -> np.ndarray | None:
        """[J, 21] of `gaussian_facts` of these Gaussians, for a Stage II that reads them."""
        from splatpainter.models.gaussian_facts import gaussian_facts

        if not self.model.config.refine.facts:
            return None
        return gaussian_facts(asset.splats, asset.normals, asset.transfer)[ids]

    def inference(self) -> AbstractContextManager[None]:
        """No gradients, arithmetic of this precision, and eval mode; the model's own mode comes back."""
        return inference(self.model, self.precision)

    @cached_property
    def _digest(self) -> str:
        from splatpainter.models.cache import digest

        return digest(self.model)


@contextmanager
def inference(model: SplatPainterModel | LocalNetwork, precision: Precision) -> Iterator[None]:
    """No gradients, arithmetic of this precision, and eval mode; the model's own mode comes back."""
    import torch

    # A caller may be training this model between edits, and dropout must not come back switched off.
    training = model.training
    model.eval()
    try:
        with torch.inference_mode(), autocast(next(model.parameters()).device, precision):
            yield
    finally:
        if training:
            model.train()
