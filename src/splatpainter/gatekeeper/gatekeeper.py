"""What every picture from a source goes through before anything is painted with it.

It is laid over the render that was sent (gatekeeper/registration.py), its colours are taken back where they drifted
(gatekeeper/color_drift.py), what changed is told from what a generator or a compressor did besides, and it is cut to
that and to the mask: outside it pixels are the render's, bit for bit. A picture that shows something else is refused
with its score. Pure; colours are display sRGB 0..1, masks 1 where the picture may change.

    admitted = admit(answer.image, request)
    edit = Edit(admitted.image, camera, admitted.changed)

An enlarged picture (upscalers) keeps its pixels: it is admitted at a whole multiple of the view, and made consistent by
back-projection (Irani and Peleg 1991): where nothing was changed, the mean of its pixels within each pixel of the
render is the render's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from functools import cached_property

import numpy as np

from splatpainter.gatekeeper.color_drift import DRIFT, NO_DRIFT, ColorDrift, estimate_drift, tone_change
from splatpainter.gatekeeper.registration import Registration, edge_strength, inverse_map, register, warped
from splatpainter.gatekeeper.strictness import Strictness
from splatpainter.lift.masks import MASKS, box_mean, change_mask, change_mask_beyond, dilated, largest_channel
from splatpainter.pictures.picture_reader import resample
from splatpainter.sources.picture_source import PictureAnswer, PictureRequest, SourceError
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class GateThresholds:
    """What a picture has to show to be let in. Source: taste, tried on services' pictures, where an entry names no
    measurement."""

    max_admitted_px: int = 4096
    """Longer side of an enlarged picture."""
    min_enlargement: float = 1.75
    """Pixels of a picture per pixel of the view from which it counts as enlarged."""
    feather_px: int = 2
    """Reach of the soft edge around what changed, and within a mask of hard edges."""
    min_feather: float = 0.25
    """Weight on the rim of a mask, and on strokes that are all rim."""
    grown_px: int = 2
    """Pixels by which the changed region grows before its edge is softened."""
    rim_px: int = 4
    """Pixels beside a mask that are not compared: generators soften its edge."""
    max_untouched: float = 0.02
    """Share of a mask that changed, up to which nothing was done there."""
    min_spilled: float = 0.4
    """Share of the asset outside a mask that changed, from which the picture was edited there."""
    max_lossless: float = 0.51 / 255
    """Nine of ten unchanged pixels of a picture that was never compressed differ by less: rounding to 8 bits."""
    speck_px: int = 3
    """In compressed pictures a changed pixel counts where enough of those within this reach changed, too: colours that
    were stored at half the size bleed over edges."""
    speck_share: float = 0.4
    """How large a share of them is enough."""
    slack_px: float = 0.2
    """Pixels by which a picture that was moved back may still be off: that much of the slope is no change."""
    min_wholly_changed_share: float = 0.6
    """Share of what may change from which all of it counts as changed: a new style leaves some pixels by chance."""
    max_mirrored: float = 0.75
    """Score below which a picture may be a mirror image."""
    mirror_gain: float = 0.2
    """Score by which its mirror image must agree better to be one."""
    min_cover: float = 0.02
    """Alpha from which a pixel shows the asset."""
    consistent_rounds: int = 8
    """Rounds of back-projection."""


GATE = GateThresholds()


class RefusedPicture(SourceError):
    """A picture that came back and is not painted with; the line says why."""

    request: PictureRequest | None = None
    answer: PictureAnswer | None = None
    """What came back, where a source was asked."""


@dataclass(frozen=True)
class AdmissionLimits:
    """What a level of strictness refuses."""

    score: float
    """Pictures whose edges agree less (Registration.score)."""
    shift: float
    """Moves by more, in parts of the longer side."""
    scale: float
    """Changes of scale by more."""
    degrees: float
    """Turns by more."""
    stops: float
    """Colours of grey that drifted by more, in stops of a channel."""
    spilled: float
    """Changes of a larger share of the asset's pixels outside the mask."""
    framed: bool
    """Pictures of another shape, or of a part of the view."""


LIMITS: dict[Strictness, AdmissionLimits] = {
    "strict": AdmissionLimits(0.7, 0.01, 0.01, 0.5, 0.25, 0.1, True),
    "normal": AdmissionLimits(0.38, 0.1, 0.15, 6.0, 1.5, 1.0, False),
    "loose": AdmissionLimits(0.2, 0.3, 0.3, 12.0, 10.0, 1.0, False),
}
"""Scores of pictures of 400 px of the bundled still life: with 20 to 40 % painted over 0.9 to 0.43, redrawn in another
material with new texture everywhere 0.41 to 0.47, other views of the same object 0.19 to 0.35, noise 0.00."""


@dataclass(frozen=True)
class AdmittedPicture:
    """A picture that may be painted with. H, W: the view's pixels times `factor`."""

    image: np.ndarray = field(repr=False)
    """[H, W, 3] float32: the render, and what changed over it."""
    changed: np.ndarray = field(repr=False)
    """[H, W] bool: pixels that are not exactly the render's."""
    weight: np.ndarray = field(repr=False)
    """[H, W] float32 0..1: how much of the picture was taken."""
    aligned: np.ndarray = field(repr=False)
    """[H, W, 3] the picture over the render, its colours corrected, before it was cut."""
    factor: int
    """Pixels of `image` per pixel of the view, along each side."""
    registration: Registration
    drift: ColorDrift
    share: float
    """Share of the asset's pixels that changed."""
    spilled: float
    """Share of the asset's pixels outside the mask that had changed, and were put back."""
    notes: tuple[str, ...] = ()
    """One line each."""
    toned: bool = False
    """Whether nothing but the tone of all colours changed, which was then taken as it is."""

    def record(self) -> dict:
        """The object that receipts record."""
        laid = self.registration
        return {
            "framing": laid.framing,
            "scale": round(laid.scale, 5),
            "rotation_degrees": round(laid.rotation, 4),
            "shift_px": [round(laid.right, 3), round(laid.down, 3)],
            "score": round(laid.score, 4),
            "factor": self.factor,
            "colors": {"kind": "tone"} if self.toned else self.drift.record(),
            "changed": round(self.share, 4),
            "outside_mask": round(self.spilled, 4),
        }


def admit(
    picture: np.ndarray,
    request: PictureRequest,
    *,
    strictness: Strictness = "normal",
    regraded: bool = False,
    mask_sent: bool = True,
    tones: bool = True,
    enlarged: Callable[[int], np.ndarray] | None = None,
    resampled: np.ndarray | None = None,
    name: str = "source",
) -> AdmittedPicture:
    """Lay a picture [h, w, 3 or 4] over what was sent, correct it, and cut it.

    request: what it was asked by: its image and mask are compared with. regraded: the picture is to change as a whole
    (mode global), so colours are corrected by what lies outside a mask alone. mask_sent: whether the source got the
    mask; if not, it may have changed what lies outside on purpose, and colours are corrected only by what agrees there.
    tones: whether a picture that changed its tone and nothing else is meant to; photographs are not. enlarged: gives
    the render [k H, k W, 3] at k times the view's size, on which an enlarged picture is laid; None: it is admitted at
    the view's size. resampled: [H, W, 3] the render after a resampling that the picture has behind it; None: it has
    none. name: what errors call it.

    Raises RefusedPicture, one line: a picture of something else, moved or recoloured beyond the level's limits, with a
    mask that is the wrong way round, or unchanged where it was to change."""
    render = np.clip(request.image, 0, 1).astype(np.float32)
    colors, content = _flat(picture, render)
    mask = None if request.mask is None else np.clip(request.mask, 0, 1).astype(np.float32)
    if mask is not None and not (mask > 0).any():
        raise SourceError(f"{name}: the mask is empty; expected some pixels above 0 (1: may change)")
    task = _Task(colors, content, render, request.alpha > GATE.min_cover, mask, strictness, name)
    # Where it lies: nothing else can be said of a picture that shows something else.
    registration = _registered(task)
    size = render.shape[1], render.shape[0]
    still = registration.is_still(*size)
    aligned, inside = task.laid(registration.matrix, size, still)
    # Its colours: a drift everywhere is taken back, a change of tone that was asked for is not.
    factor = 1 if enlarged is None else _factor(registration, size, request.scale)
    drift = NO_DRIFT
    if mask is not None or not regraded:
        # What was lost before, as colours to grey, is no drift.
        beside = render if resampled is None else resampled
        drift = estimate_drift(aligned, beside, task.outside & inside, mask is not None and mask_sent)
    # Enlarged pictures are to be consistent with the render, so they have no tone of their own.
    toned = tones and factor == 1 and _is_toned(task, aligned, inside, drift)
    _check_drift(task, drift, toned)
    if toned:  # as was asked: within a mask, if there is one
        drift = NO_DRIFT
    # What changed, against a render that went through the same resampling.
    like = _like(render if resampled is None else resampled, registration, colors.shape, still)
    aligned = _corrected(drift, aligned, like)
    if regraded and mask is None and not change_mask(aligned, like)[task.cover & inside].mean() > GATE.max_untouched:
        _check_regraded(aligned, like, task.cover & inside, name)
    changed = _changed(aligned, like, mask, task.cover, regraded or toned) & inside
    if not still or resampled is not None:
        changed &= largest_channel(np.abs(aligned - like)) > MASKS.max_rounding + GATE.slack_px * edge_strength(render)
    if resampled is not None:
        changed &= change_mask_beyond(aligned, render, like)
    spilled = _spilled(task, changed)
    base, cover, allowed = render, task.cover, task.cover.astype(np.float32)
    if mask is not None:
        allowed = _soft_mask(mask) * task.cover
    # An enlarged picture once more, at its own size, on the enlarged render.
    if factor > 1:
        assert enlarged is not None
        base = np.clip(enlarged(factor), 0, 1).astype(np.float32)
        aligned, inside = task.laid_larger(registration.matrix, factor, still, drift, base, changed)
        cover, larger = _repeated(cover, factor), None if mask is None else _repeated(mask, factor)
        reach = _repeated(dilated(changed, GATE.grown_px), factor)
        changed = _changed(aligned, base, larger, cover, regraded or toned) & inside
        if request.scale == 1:  # nobody asked for a sharper picture: what was merely enlarged is no edit
            changed &= reach
        if mask is None:
            allowed = cover.astype(np.float32)
        else:
            allowed = np.where(_repeated(allowed > 0, factor), resample(allowed, size[0] * factor, size[1] * factor), 0)
    # The cut: outside what changed and may change, the render's own bits.
    weight = np.minimum(_softened(changed, inside), allowed).astype(np.float32)
    image = np.where(weight[..., None] < 1, base + weight[..., None] * (aligned - base), aligned)
    image = np.where(weight[..., None] > 0, image, base)
    if not (weight > 0).any():
        where = "" if mask is None else " within the mask"
        raise RefusedPicture(f"{name}: the picture came back unchanged{where}; there is nothing to paint")
    notes = _notes(registration, drift, spilled, registration.is_moved(*size), factor) + _tone_notes(toned, mask)
    return AdmittedPicture(
        image.astype(np.float32),
        weight > 0,
        weight,
        aligned,
        factor,
        registration,
        drift,
        _share(weight > 0, cover),
        spilled,
        notes,
        toned,
    )


@dataclass(frozen=True)
class _Task:
    """A picture and what it is judged by. H, W: pixels of the view."""

    colors: np.ndarray
    """[h, w, 3] the picture, over the render where it is transparent."""
    content: np.ndarray | None
    """[h, w] its alpha; None: all is opaque."""
    render: np.ndarray
    """[H, W, 3] what was sent."""
    cover: np.ndarray
    """[H, W] bool: pixels of the asset."""
    mask: np.ndarray | None
    """[H, W] 0..1: what may change."""
    strictness: Strictness
    name: str

    @property
    def limits(self) -> AdmissionLimits:
        return LIMITS[self.strictness]

    @cached_property
    def outside(self) -> np.ndarray:
        """[H, W] bool: pixels that nobody was to change."""
        if self.mask is None:
            return np.ones(self.render.shape[:2], bool)
        return ~dilated(self.mask > 0.01, GATE.rim_px)

    @property
    def compared(self) -> np.ndarray | None:
        """[H, W] float32: where picture and render should agree; None: everywhere."""
        return None if self.mask is None else self.outside.astype(np.float32)

    def laid(self, matrix: np.ndarray, size: tuple[int, int], still: bool) -> tuple[np.ndarray, np.ndarray]:
        """(the picture over a render of that size, [H, W] bool where it shows anything)."""
        aligned, inside = _laid(self.colors, matrix, size, still)
        if self.content is not None:
            inside &= _laid(self.content, matrix, size, still)[0] > 0.5
        return aligned, inside

    def laid_larger(
        self,
        matrix: np.ndarray,
        factor: int,
        still: bool,
        drift: ColorDrift,
        base: np.ndarray,
        changed: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """The same at `factor` times the view's size, its means over the view's pixels the render's where nothing
        changed. base: the render at that size; changed: [H, W] bool, at the view's size."""
        height, width = self.render.shape[:2]
        finer = matrix * np.array([1 / factor, 1 / factor, 1])
        aligned, inside = self.laid(finer, (width * factor, height * factor), still)
        aligned = _corrected(drift, aligned, base)
        edited = changed if self.mask is not None else _edited(pooled(aligned, factor), self.render)
        return consistent(aligned, self.render, dilated(edited, GATE.grown_px)), inside


def _registered(task: _Task) -> Registration:
    """Where the picture lies. Raises RefusedPicture: it shows something else, is a mirror image, or moved too far."""
    registration = register(task.colors, task.render, task.compared, task.content)
    if registration.score < task.limits.score:
        _complain_of_polarity(task)
        where, advice = "", "mask what is to change, or ask again"
        if task.mask is not None:
            where, advice = " outside the mask", "is the mask the right way round (white may change)? else ask again"
        raise RefusedPicture(
            f"{task.name}: the picture shows something other than what was sent: its edges agree{where} by "
            f"{registration.score:.2f} of 1, expected {task.limits.score:g} (strictness {task.strictness}); {advice}"
        )
    _check_mirror(registration, task)
    _check_moves(registration, task.render.shape, task.limits, task.strictness, task.name)
    return registration


def _is_toned(task: _Task, aligned: np.ndarray, inside: np.ndarray, drift: ColorDrift) -> bool:
    """Whether nothing but the tone of all colours changed, by more than services drift."""
    if drift.kind == "none":
        return False
    tone = tone_change(aligned, task.render, task.cover & inside)
    return tone is not None and tone > DRIFT.min_tone


def _check_drift(task: _Task, drift: ColorDrift, toned: bool) -> None:
    """Raises RefusedPicture where colours changed by more than the level allows."""
    if toned and task.strictness == "strict":
        raise RefusedPicture(
            f"{task.name}: the picture changed its tone everywhere, by {drift.strength:.1f} stops, and nothing else; "
            f"{_ways_of_tone(task.mask, 'strictness normal takes it as it is')}"
        )
    if drift.strength > task.limits.stops and not toned:
        _complain_of_polarity(task)
        raise RefusedPicture(
            f"{task.name}: the picture's colours drifted by {drift.strength:.1f} stops outside what was to change, "
            f"expected at most {task.limits.stops:g} (strictness {task.strictness}); "
            f"{_ways_of_tone(task.mask, 'strictness loose takes the drift back and paints the rest')}"
        )


def _spilled(task: _Task, changed: np.ndarray) -> float:
    """Share of the asset outside the mask that changed. Raises RefusedPicture where that is too much, or all."""
    if task.mask is None:
        return 0.0
    spilled = _share(changed & task.outside, task.outside & task.cover)
    untouched = _share(changed, _without_rim(task.mask, task.cover)) < GATE.max_untouched
    if untouched and spilled > GATE.min_spilled:
        raise RefusedPicture(_wrong_polarity(task.name))
    if spilled > task.limits.spilled:
        raise RefusedPicture(
            f"{task.name}: {100 * spilled:.0f} % of the asset outside the mask changed, expected at most "
            f"{100 * task.limits.spilled:.0f} % (strictness {task.strictness})"
        )
    return spilled


def _corrected(drift: ColorDrift, colors: np.ndarray, like: np.ndarray) -> np.ndarray:
    """[H, W, 3] colours without their drift. What the drift clipped says "at least so bright" (or dark): there the
    render's value stands where it is beyond the corrected one."""
    # A gain cannot bring back what it pushed past white or black.
    out = drift.corrected(colors)
    if drift.kind not in ("gain", "gain and offset"):  # a matrix carries what was clipped into other channels
        return out
    low, high = DRIFT.unclipped_range
    out = np.where((colors >= high) & (out < like), like, out)
    return np.where((colors <= low) & (out > like), like, out)


def _changed(
    picture: np.ndarray, render: np.ndarray, mask: np.ndarray | None, cover: np.ndarray, regraded: bool
) -> np.ndarray:
    """[H, W] bool: pixels that were edited. Within a mask every difference counts that is no rounding, elsewhere those
    above the picture's noise; where most of what may change did, all of it did."""
    # The tolerant test everywhere, the strict one within a mask, where a faint stroke is meant.
    changed, difference = change_mask(picture, render), largest_channel(np.abs(picture - render))
    if changed.any() and not changed.all() and np.quantile(difference[~changed], 0.9) > GATE.max_lossless:
        changed &= box_mean(changed, GATE.speck_px) > GATE.speck_share
    # A new style leaves some pixels by chance: where most changed, all did.
    region = cover if mask is None else cover & (mask > 0)
    if mask is not None:
        changed |= (mask > 0) & (difference > MASKS.max_rounding)
    everything = regraded and mask is None
    if everything or (changed & region).sum() > GATE.min_wholly_changed_share * region.sum():
        changed = changed | region
    return changed


def _edited(picture: np.ndarray, render: np.ndarray) -> np.ndarray:
    """[H, W] bool: where an enlarged picture shows something else, and not only sharper edges, whose differences
    average out."""
    return largest_channel(np.abs(box_mean(picture - render, 2))) > MASKS.max_noise


def consistent(picture: np.ndarray, render: np.ndarray, changed: np.ndarray) -> np.ndarray:
    """[k H, k W, 3] an enlarged picture, moved so that its means over k x k pixels are the render's [H, W, 3] at all
    pixels that are not `changed` [H, W] bool; its detail stays."""
    height, width = render.shape[:2]
    factor = picture.shape[0] // height
    assert picture.shape[:2] == (height * factor, width * factor)
    # Back-projection: add, at the fine size, what the means lack at the coarse one, and repeat.
    free = np.where(changed[..., None], 0, 1).astype(np.float32)
    out = picture
    for step in range(GATE.consistent_rounds):
        error = free * (render - pooled(out, factor))
        if step < 2:  # smoothly, then what is left
            spread = np.stack([_enlarged(error[..., k], factor) for k in range(3)], -1)
        else:
            spread = error.repeat(factor, 0).repeat(factor, 1)
        out = np.clip(out + spread, 0, 1)
    return out


def pooled(picture: np.ndarray, factor: int) -> np.ndarray:
    """[H, W, 3] means over factor x factor pixels of [factor H, factor W, 3]."""
    height, width = picture.shape[0] // factor, picture.shape[1] // factor
    return picture.reshape(height, factor, width, factor, 3).mean((1, 3))


def _enlarged(values: np.ndarray, factor: int) -> np.ndarray:
    """[k H, k W] of [H, W], any sign, bilinear."""
    from PIL import Image

    plane = Image.fromarray(np.ascontiguousarray(values, np.float32), "F")
    return np.asarray(plane.resize((values.shape[1] * factor, values.shape[0] * factor), Image.Resampling.BILINEAR))


def _flat(picture: np.ndarray, render: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """(colours [h, w, 3], [h, w] alpha or None where all is opaque). What is transparent was not changed: it shows the
    render, as far as that can be said before the picture is registered."""
    colors = np.ascontiguousarray(np.clip(np.nan_to_num(picture[..., :3]), 0, 1), np.float32)
    if picture.shape[2] == 3 or picture[..., 3].min() > 0.999:
        return colors, None
    # Transparent parts show the render, so that they count as unchanged in everything that follows.
    alpha = np.clip(np.nan_to_num(picture[..., 3]), 0, 1).astype(np.float32)
    behind = resample(render, picture.shape[1], picture.shape[0])
    return colors * alpha[..., None] + behind * (1 - alpha[..., None]), alpha


def _laid(picture: np.ndarray, matrix: np.ndarray, size: tuple[int, int], still: bool) -> tuple[np.ndarray, np.ndarray]:
    """(the picture at a size, [H, W] bool where it shows anything); a picture that was not moved is only resized, and
    stays as it is where that is not needed either."""
    if not still:
        return warped(picture, matrix, size)
    same = picture if picture.shape[1::-1] == size else resample(picture, *size)
    return same, np.ones(same.shape[:2], bool)


def _like(render: np.ndarray, registration: Registration, shape: tuple[int, ...], still: bool) -> np.ndarray:
    """The render after the resampling that the picture went through, there and back: it alone moves edges by more than
    an edit's tolerance."""
    height, width = render.shape[:2]
    size = shape[1], shape[0]
    if still:
        return render if size == (width, height) else resample(resample(render, *size), width, height)
    # Moved pictures were resampled once; the render goes the same way and back, so that both are equally soft.
    inverse = inverse_map(registration.matrix)[:2]
    values, inside = warped(render, inverse, size)
    back = warped(values, registration.matrix, (width, height))[0]
    covered = warped(inside.astype(np.float32), registration.matrix, (width, height))[0] > 0.999
    return np.where(covered[..., None], back, render)


def _ways_of_tone(mask: np.ndarray | None, otherwise: str) -> str:
    """What to do where a picture changed tone: options by their names."""
    if mask is not None:
        return otherwise
    return f"mode global takes it as a look of the whole asset, {otherwise}"


def _check_regraded(picture: np.ndarray, render: np.ndarray, region: np.ndarray, name: str) -> None:
    """Raises RefusedPicture where a picture that was to be regraded differs by compression alone."""
    if not region.any() or np.abs((picture - render)[region].mean(0)).max() < MASKS.max_rounding:
        raise RefusedPicture(f"{name}: the picture came back unchanged; there is nothing to paint")


def _check_moves(
    registration: Registration, shape: tuple[int, ...], limits: AdmissionLimits, strictness: Strictness, name: str
) -> None:
    # Limits of shift are shares of the picture, as a service works at its own size.
    longer = max(shape[:2])
    shift = max(abs(registration.right), abs(registration.down)) / longer
    checks = (
        (f"is moved by {100 * shift:.1f} %", shift > limits.shift, f"{100 * limits.shift:g} %"),
        (
            f"is scaled by {registration.scale:.3f}",
            abs(registration.scale - 1) > limits.scale,
            f"1 +- {limits.scale:g}",
        ),
        (
            f"is turned by {registration.rotation:.1f} degrees",
            abs(registration.rotation) > limits.degrees,
            f"{limits.degrees:g} degrees",
        ),
    )
    for what, refused, limit in checks:
        if refused:
            raise RefusedPicture(f"{name}: the picture {what}, expected at most {limit} (strictness {strictness})")
    if limits.framed and registration.framing != "full":
        raise RefusedPicture(
            f"{name}: the picture came back {registration.framing}, expected all of the view (strictness {strictness})"
        )


def _check_mirror(registration: Registration, task: _Task) -> None:
    """Raises RefusedPicture where the picture is a mirror image: round objects have nearly the edges of theirs."""
    # Registering a second time is dear, and a picture that agrees well is no mirror image.
    if registration.score < GATE.max_mirrored:
        flipped = None if task.content is None else np.ascontiguousarray(task.content[:, ::-1])
        score = register(np.ascontiguousarray(task.colors[:, ::-1]), task.render, task.compared, flipped).score
        if score > max(registration.score + GATE.mirror_gain, GATE.max_mirrored):
            raise RefusedPicture(
                f"{task.name}: the picture came back mirrored: its edges agree by {registration.score:.2f} of 1, "
                f"flipped from left to right by {score:.2f}; ask again, or flip it"
            )


def _complain_of_polarity(task: _Task) -> None:
    """Raises RefusedPicture where the picture agrees inside the mask and not outside it."""
    if task.mask is not None:
        # Agreement where it was to change, and not elsewhere: the mask means the opposite to the source.
        inverse = register(task.colors, task.render, (task.mask > 0.5).astype(np.float32), task.content)
        if inverse.score > max(task.limits.score, 0.7) and not inverse.inside:
            raise RefusedPicture(_wrong_polarity(task.name))


def _wrong_polarity(name: str) -> str:
    return (
        f"{name}: the picture changed outside the mask and not inside it: the mask is the wrong way round for this "
        "source (white, 1, means: may change)"
    )


def _factor(registration: Registration, size: tuple[int, int], requested: int) -> int:
    """How many times the view's size an enlarged picture is admitted at."""
    # Whole multiples only: pooling has to be exact for the back-projection.
    scale = registration.pixel_scale
    if scale < GATE.min_enlargement:
        return 1
    limit = max(1, GATE.max_admitted_px // max(size))
    return max(1, min(requested if 1 < requested <= scale + 0.25 else int(scale + 0.25), limit))


def _without_rim(mask: np.ndarray, cover: np.ndarray) -> np.ndarray:
    """[H, W] bool: where a mask shows the asset, without its rim: there a picture that was edited beside it changes a
    little, too. All of a mask that is all rim."""
    region = (mask > 0.5) & cover
    inner = region & ~dilated(mask <= 0.5, GATE.rim_px)
    return inner if inner.any() else region


def _soft_mask(mask: np.ndarray) -> np.ndarray:
    """[H, W] the mask with a soft edge that lies within it: 0 where it is 0."""
    # A mask that was drawn soft is taken as it is.
    hard = ((mask == 0) | (mask == 1)).all()
    return np.where(mask > 0, np.minimum(mask, _ramp(mask > 0)), 0) if hard else mask


def _ramp(region: np.ndarray) -> np.ndarray:
    """[H, W] 0 outside a region, rising to 1 within GATE.feather_px; the picture's borders are no edge of it."""
    return np.clip(2 * box_mean(region, GATE.feather_px) - 1, GATE.min_feather, 1) * region


def _softened(changed: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """[H, W] 1 on what changed, falling to 0 around it; 0 where the picture shows nothing."""
    grown = dilated(changed, GATE.grown_px)
    soft = np.where(changed, 1, box_mean(grown, GATE.feather_px))
    return np.where(inside, soft, 0) if inside.all() else np.minimum(soft, _ramp(inside))


def _repeated(values: np.ndarray, factor: int) -> np.ndarray:
    return values.repeat(factor, 0).repeat(factor, 1)


def _share(region: np.ndarray, of: np.ndarray) -> float:
    return float((region & of).sum() / max(int(of.sum()), 1))


def _tone_notes(toned: bool, mask: np.ndarray | None) -> tuple[str, ...]:
    if not toned:
        return ()
    if mask is not None:
        return ("only its tone changed, everywhere: used as it is within the mask",)
    return ("only its tone changed, everywhere: used as it is; mode global carries it to all sides",)


def _notes(registration: Registration, drift: ColorDrift, spilled: float, moved: bool, factor: int) -> tuple[str, ...]:
    out = []
    if registration.framing != "full":
        out.append(f"came back {registration.framing}")
    if moved:
        out.append(
            f"moved back by {registration.right:.1f}, {registration.down:.1f} pixels, scale {registration.scale:.3f}, "
            f"{registration.rotation:.1f} degrees"
        )
    if drift.kind != "none":
        out.append(f"colours corrected by {drift.strength:.2f} stops ({drift.kind})")
    if spilled > 0.01:
        out.append(f"{100 * spilled:.0f} % of the asset outside the mask had changed and was put back")
    if factor > 1:
        out.append(f"painted at {factor} times the view's size")
    return tuple(out)
