"""Pictures given by hand, before anything is painted with them: one that differs from its view nearly everywhere is
refused with the likeliest reason, put right as a source's picture is, or taken as it is.

A mask says what was painted, and mode global takes a picture as a look of all: these are not refused, only warned of
what cannot be meant (a mirrored picture, another asset).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Literal

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.color import to_display
from splatpainter.gatekeeper.borders import BORDER_NOTE, border_or_strip, framed_picture, with_rim
from splatpainter.gatekeeper.mistaken_pictures import MISTAKES, Explanation, Size, explain, filtered
from splatpainter.gatekeeper.small_copies import Mistake, visible_after
from splatpainter.gatekeeper.strictness import Strictness
from splatpainter.image_files import find_camera
from splatpainter.kernels.parallel import beside
from splatpainter.kernels.portable import matmul
from splatpainter.lift.masks import box_mean, largest_channel
from splatpainter.painter import Mode
from splatpainter.pictures.edit_files import PictureFile, draw, over_render
from splatpainter.pictures.encodings import Encoding, guessed_encoding
from splatpainter.pictures.lost_transparency import GROUND_NOTE, without_its_ground
from splatpainter.pictures.picture_reader import Picture
from splatpainter.pictures.view_search import most_alike, same_view, views_in
from splatpainter.rendering.cpu.recent_views import drawn_view
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

MismatchPolicy = Literal["refuse", "correct", "force"]
"""What becomes of a picture that differs from its view everywhere."""
USUAL_REASONS = "recompressed, another gamma or profile, mirrored, another asset, other axes or another camera"
NEVER_MEANT = ("turned", "axes", "other")
"""Causes that are no look of an asset, and no paint under a mask."""
NEVER_PUT_RIGHT = ("axes", "other")
"""Causes of which nothing is known that takes them back."""
OTHER_AXES = (
    ("of the asset with its axes read another way (try --in-axes rub or --in-axes rdf)", np.diag([1.0, -1.0, -1.0])),
    ("of the asset turned by a quarter (z up in place of y)", np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])),
    ("of the asset turned by a quarter (y up in place of z)", np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])),
)
"""What it says of a picture, and how the world is turned in it."""


MEAN_PX, MAX_MEAN_BESIDE, MAX_ROUNDING = 2, 10 / 255, 3.5 / 255
"""Of pictures that were moved back: reach of a mean, pixels, by how much it may differ, and a single value.
Source: taste."""


@dataclass(frozen=True)
class CheckedPicture:
    """A picture that may be painted with."""

    source: PictureFile
    warning: str = ""
    """One line, if not empty: it is painted with all the same."""


@dataclass(frozen=True)
class _ComparedView:
    """A picture beside what the asset shows from its camera, display colours 0..1."""

    camera: Camera
    colors: np.ndarray
    """[H, W, 3]; transparent parts show the asset."""
    render: np.ndarray
    """[H, W, 3]."""
    cover: np.ndarray
    """[H, W] alpha."""


def checked_picture(
    source: PictureFile,
    splats: Splats,
    mode: Mode = "local",
    policy: MismatchPolicy = "refuse",
    strictness: Strictness = "normal",
) -> CheckedPicture:
    """The picture as it is to be painted with. policy "correct": put right by what explains it, and by the gatekeeper
    (gatekeeper/gatekeeper.py) to that strictness; "force": nothing is put right, and nothing is taken for compression.
    Renders the view. Raises ValueError, one line: a picture that differs everywhere (policy "refuse", no mask, not mode
    global), and what the gatekeeper refuses."""
    source = source.relative_to(splats.offset)
    at_view = source.at_view()
    source = replace(source, drawn=drawn_view(splats.numpy(), at_view.camera))
    view = _compared(at_view, splats)
    if not (view.cover > 0).any():  # nothing in view, which the painter says
        return CheckedPicture(source)
    # A mask says where paint is, and mode global means all of it: then a difference everywhere may be meant.
    free = source.mask is None and mode != "global"
    says_no_loss = not _says_its_loss(source) and source.original_size == (view.camera.width, view.camera.height)
    is_judged = free and policy == "refuse" and says_no_loss

    # Most pictures have nothing that explains them, so another CPU looks already for what is asked then.
    def look_ahead() -> tuple[tuple[PictureFile, _ComparedView], tuple[Encoding | None, Explanation | None] | None]:
        on_ground = (source, view) if policy == "force" else _on_the_views_ground(source, view, splats)
        return on_ground, _filter_of(source, view) if is_judged and on_ground[1] is view else None

    looking = beside(look_ahead)

    # One rule for all entrances: command line, batch, session and nodes come through here.
    def why(seen: _ComparedView) -> Explanation | None:
        return explain(seen.colors, seen.render, seen.cover, lambda size: _with_other_axes(splats, seen.camera, size))

    explanation = why(view)
    on_ground, filter_of_view = looking()
    compared, window = view, None
    if policy != "force":
        source, view, explanation, window = _without_border(
            source, view, splats, mode, explanation, why, leaves_strips=policy == "correct"
        )
    # A grade changes the background, too: that is no ground of another program's. Nor is a border.
    if window is None and on_ground[1] is not compared and (explanation is None or not explanation.is_grade):
        source, view = on_ground
        explanation = why(view)
    if policy == "correct":
        return CheckedPicture(_corrected(source, view, splats, mode, strictness, explanation, window))
    warning = ""
    if explanation is not None and explanation.may_be_meant:
        warning = _remark(source, explanation) if free and policy == "refuse" else ""
    elif explanation is not None and free and policy == "refuse":
        raise ValueError(f"{_complaint(source, explanation)}; {_advice(explanation)}")
    elif explanation is not None and mode == "global" and explanation.cause == "other" and not _other_view(source):
        pass  # a new light changes everything, too, and nothing explains it
    elif explanation is not None and (free or explanation.cause in NEVER_MEANT):
        warning = f"{_complaint(source, explanation)}; painted with as it is"
    # No guess of an encoding either: the caller says that every difference is paint.
    if policy == "force":
        source = replace(source, picture=replace(source.picture, encoding=None))
    elif is_judged:
        encoding, filter_explanation = (filter_of_view if window is None else None) or _filter_of(source, view)
        source = replace(source, picture=replace(source.picture, encoding=encoding))
        if explanation is None and filter_explanation is not None:
            explanation = filter_explanation
            if explanation.cause == "filter":
                raise ValueError(f"{_complaint(source, explanation)}; {_advice(explanation)}")
            warning = _remark(source, explanation)
    return CheckedPicture(source, warning)


def _filter_of(source: PictureFile, view: _ComparedView) -> tuple[Encoding | None, Explanation | None]:
    """(How its file was encoded, as far as its pixels tell; the filter that went over it beside that)."""
    encoding = source.picture.encoding or guessed_encoding(view.colors, view.render, view.cover)
    if encoding is not None and encoding.kind not in ("blur", "rounding"):
        return encoding, None
    expected = view.render if encoding is None else encoding.applied(view.render)
    return encoding, filtered(view.colors, expected, view.cover)


def _says_its_loss(source: PictureFile) -> bool:
    """Whether its file says how it was compressed."""
    return source.picture.encoding is not None and source.picture.encoding.kind != "rounding"


def _complaint(source: PictureFile, explanation: Explanation) -> str:
    differs = f"differs from its view on {100 * (1 - explanation.agreeing):.0f} % of what they show"
    words = explanation.words
    if explanation.cause == "other" and (hint := _other_view(source)):
        words = f"of another view: {hint}"
    return f"{source.path}: {differs}; most likely it is {words} (usual reasons: {USUAL_REASONS})"


def _remark(source: PictureFile, explanation: Explanation) -> str:
    """Of what may be meant."""
    mistake = explanation.mistake
    advice = "; --correct takes that back and paints what is left" if mistake is not None and mistake.undone else ""
    return f"{source.path}: it looks {explanation.words}{advice}"


def _advice(explanation: Explanation) -> str:
    ways = ["--mask M.png says what was painted"]
    if explanation.is_grade:
        ways.insert(0, "--mode global takes it as a look of the whole asset")
    # A grade of the asset alone, and most filters, are taken back by no mistake.
    can_be_undone = explanation.cause not in ("filter", "tone") or explanation.mistake is not None
    if _is_lost(explanation):
        ways.append("--correct paints what was painted on it")
    elif explanation.cause not in NEVER_PUT_RIGHT and can_be_undone:
        ways.append("--correct puts it right and paints what is left")
    return f"nothing was painted: {', '.join(ways)}, --force paints with it as it is"


def _other_view(source: PictureFile) -> str:
    """What says that a picture is of another view than it is compared with: its own camera, or the view beside it that
    it is like; "" if nothing does."""
    camera = source.view or source.camera
    with contextlib.suppress(ValueError):
        if not same_view(find_camera(source.path), camera):
            return "it has a camera of its own (leave --camera out)"
    # Most wrong views are the neighbour of the right one, in the same folder.
    views = views_in([source.path.parent], source.original_size, besides=source.path)
    best = most_alike(source.picture.colors, views)
    if best is None or same_view(best.camera, camera):
        return ""
    return f"it is like {best.name} (--camera {source.path.parent / best.name})"


def _compared(source: PictureFile, splats: Splats) -> _ComparedView:
    drawn, cover = draw(splats, source.camera)
    render = np.clip(to_display(drawn, splats.color_space), 0, 1).astype(np.float32, copy=False)
    colors, alpha = source.picture.colors, source.picture.alpha
    if alpha is not None:
        background = to_display(np.asarray(source.camera.background, np.float32), splats.color_space)
        red, green, blue = background.tolist()
        colors = over_render(colors, alpha, render, cover, (red, green, blue) if source.cut_out else None)
    return _ComparedView(source.camera, np.ascontiguousarray(colors, np.float32), render, cover)


def _on_the_views_ground(source: PictureFile, view: _ComparedView, splats: Splats) -> tuple[PictureFile, _ComparedView]:
    """Both, of a picture that lost its transparency, with the view's background in place of what lies behind it."""
    if source.picture.alpha is not None or source.photograph is not None:
        return source, view
    background = to_display(np.asarray(view.camera.background, np.float32), splats.color_space)

    def cleared(seen: _ComparedView) -> np.ndarray | None:
        return without_its_ground(seen.colors, seen.render, seen.cover, background, source.picture.encoding)

    colors = cleared(view)
    if colors is None:
        return source, view
    seen = replace(view, colors=colors)
    if source.view is not None:  # the larger picture that is painted with
        larger = _compared(source, splats)
        colors = cleared(larger)
        colors = larger.colors if colors is None else colors
    picture = replace(source.picture, colors=colors)
    return replace(source, picture=picture, notes=(GROUND_NOTE, *source.notes)), seen


def _without_border(
    source: PictureFile,
    view: _ComparedView,
    splats: Splats,
    mode: Mode,
    explanation: Explanation | None,
    why: Callable[[_ComparedView], Explanation | None],
    leaves_strips: bool,
) -> tuple[PictureFile, _ComparedView, Explanation | None, tuple[slice, slice] | None]:
    """The same with nothing painted where a border around the picture lies, why what it frames differs, and its rows
    and columns, None where there is no border. leaves_strips: whether that is done to what a hand may have painted,
    too."""
    if source.mask is not None or source.photograph is not None or source.cut_out:
        return source, view, explanation, None
    framed = framed_picture(
        view.colors, view.render, view.cover, explanation, lambda colors: why(replace(view, colors=colors))
    )
    if framed is None:
        return source, view, explanation, None
    if not framed.is_certain and not leaves_strips:
        return source, view, framed.explanation, None
    # Of a larger picture the larger one is painted with.
    seen = view if source.view is None else _compared(source, splats)
    around = border_or_strip(seen.colors, seen.render, seen.cover)
    if around is not None:
        rest, picture = ~with_rim(around.outside), source.picture
        if mode == "spread":  # which takes transparency for thin paint
            picture = replace(picture, colors=np.where(rest[..., None], seen.colors, seen.render), alpha=None)
        else:
            picture = replace(picture, alpha=rest * np.float32(1) if picture.alpha is None else picture.alpha * rest)
        source = replace(source, picture=picture, notes=(BORDER_NOTE, *source.notes))
    return source, replace(view, colors=framed.colors), framed.explanation, framed.window


def _beside_itself(picture: np.ndarray, render: np.ndarray) -> np.ndarray:
    """[H, W] bool: where a picture that was moved back may still lie beside its render [H, W, 3] by up to a pixel:
    within what that shows around the pixel, and of the same mean."""
    grown = np.pad(render, ((1, 1), (1, 1), (0, 0)), mode="edge")
    height, width = render.shape[:2]
    around = [grown[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    low, high = (extreme.reduce(around) for extreme in (np.minimum, np.maximum))
    within = (picture >= low - MAX_ROUNDING) & (picture <= high + MAX_ROUNDING)
    mean = largest_channel(np.abs(box_mean(picture - render, MEAN_PX)))
    return within.all(-1) & (mean <= MAX_MEAN_BESIDE)


def _with_other_axes(splats: Splats, camera: Camera, size: Size) -> Iterator[tuple[str, np.ndarray]]:
    small = camera.resized(*size)
    for words, turn in OTHER_AXES:
        world = np.eye(4)
        world[:3, :3] = turn
        drawn, _ = draw(splats, replace(small, world_to_camera=matmul(camera.world_to_camera, world)))
        yield words, np.clip(to_display(drawn, splats.color_space), 0, 1)


def _is_lost(explanation: Explanation | None) -> bool:
    """Whether colours were lost that nothing brings back, while it is known what is left of those of the view: grey."""
    mistake = None if explanation is None else explanation.mistake
    return mistake is not None and mistake.cause == "colors" and mistake.undone is None


def _without_loss(
    source: PictureFile, view: _ComparedView, colors: np.ndarray, mistake: Mistake | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """(a picture [H, W, 3] after a mistake was undone, what the same mistake and the way that its file was stored leave
    of the view [H, W, 3]); None of the latter where nothing is lost."""
    expected = view.render if mistake is None else np.ascontiguousarray(mistake.made(view.render), np.float32)
    undone = None if mistake is None else mistake.undone
    taken_back = colors if undone is None else np.ascontiguousarray(undone(colors), np.float32)
    # Of a larger picture, or one that was turned, nobody knows on which pixels it was stored.
    is_at_size = source.original_size == (view.camera.width, view.camera.height) and expected.shape == colors.shape
    encoding = source.picture.encoding if is_at_size else None
    if encoding is None and is_at_size:
        encoding = guessed_encoding(view.colors, expected, view.cover)
    if encoding is not None:
        stored = encoding.fitted(colors, expected, view.cover).applied(expected)
        return taken_back, stored if undone is None else np.ascontiguousarray(undone(stored), np.float32)
    return taken_back, expected if mistake is not None and undone is None else None


def _corrected(
    source: PictureFile,
    view: _ComparedView,
    splats: Splats,
    mode: Mode,
    strictness: Strictness,
    explanation: Explanation | None,
    window: tuple[slice, slice] | None,
) -> PictureFile:
    """The picture after what explains it was undone, and through the gatekeeper: cut to what was painted. window: rows
    and columns within a border, which is left out."""
    from splatpainter.gatekeeper.gatekeeper import admit  # of pictures that are put right alone
    from splatpainter.sources.picture_source import PictureRequest

    as_compared = source.picture.alpha is not None or window is not None
    colors, notes = view.colors if as_compared else source.picture.colors, list(source.notes)
    # First the mistake is undone, then the rest is a source's picture like any other.
    mistake = None if explanation is None else explanation.mistake
    resampled = None
    if explanation is not None and explanation.cause == "moved" and mistake is not None and mistake.undone is not None:
        colors = view.colors  # of a larger one, too: what it lies beside was rendered at the view's size
        resampled = np.ascontiguousarray(mistake.undone(mistake.made(view.render)), np.float32)
        colors = np.ascontiguousarray(mistake.undone(colors), np.float32)
        # What was pushed over the picture's rim is not known, so it is as it was rendered.
        visible = visible_after(mistake.undone, colors.shape)[..., None]
        visible &= ~_beside_itself(colors, view.render)[..., None]
        colors, resampled = np.where(visible, colors, view.render), np.where(visible, resampled, view.render)
        notes.append(f"put right: it was {mistake.words}")
    elif mistake is None or mistake.undone is not None or _is_lost(explanation):
        colors, resampled = _without_loss(source, view, colors, mistake)
        if mistake is not None:
            lost = "" if mistake.undone is not None else ", which cannot be taken back; what was painted stays so"
            notes.append(f"put right: it was {mistake.words}{lost}")
    mask = source.at_view().mask
    # A border that became the render would be the one place without the picture's noise, so it is cut off.
    inside = np.s_[:, :] if window is None else window

    def enlarged(factor: int) -> np.ndarray:
        larger = view.camera.resized(view.camera.width * factor, view.camera.height * factor)
        return np.clip(to_display(draw(splats, larger)[0], splats.color_space), 0, 1).astype(np.float32)

    admitted = admit(
        colors[inside],
        PictureRequest(view.render[inside], view.cover[inside], None if mask is None else mask.astype(np.float32)),
        strictness=strictness,
        regraded=mode == "global",
        mask_sent=False,
        enlarged=None if source.view is None or window is not None else enlarged,
        resampled=None if resampled is None else resampled[inside],
        name=str(source.path),
    )
    # Another view has some edges in common with this one; what was moved and graded has nearly all.
    if (
        explanation is not None
        and explanation.cause in NEVER_PUT_RIGHT
        and mask is None
        and admitted.registration.score < MISTAKES.min_moved_score
    ):
        raise ValueError(f"{_complaint(source, explanation)}; {_advice(explanation)}")
    image, changed = admitted.image, admitted.changed
    if window is not None:
        image, changed = view.render.copy(), np.zeros(view.cover.shape, bool)
        image[window], changed[window] = admitted.image, admitted.changed
    height, width = image.shape[:2]
    camera = view.camera if admitted.factor == 1 else view.camera.resized(width, height)
    return PictureFile(
        source.path,
        Picture(image, None),
        (width, height),
        camera,
        changed,
        (*notes, *admitted.notes),
    )
