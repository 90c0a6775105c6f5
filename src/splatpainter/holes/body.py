"""The body that a selection is of: the whole thing under a lasso, its back and its hollow inside too, without the
ground on which it stands. Pure.

    body = body_of(splats, weights > 0.5)  # None: what is selected is a part of something larger

Gaussians are gathered into small pieces of surface of one place and direction, of one colour too where neighbours are
alike. Pieces that touch hang together the better, the more their colours and normals agree: over a contact ring, where
a thing stands on the ground, hardly. A random walk over them (Grady, "Random walks for image segmentation", 2006) that
may end anywhere, more rarely where nothing is selected (BODY.selected_share), has from all of one body about the same
chance to end at the selection: the body is what lies above a level of chances whose border cuts few links, about the
same above many levels. A strip of ground within a lasso is not of it: it hangs together with all the ground around, and
a plane that goes on all around the foot of a thing is its ground (support.py). A border that is no weaker than the
surface itself would be a cut through it, and what stands on nothing a part: then there is no body.
"""

from __future__ import annotations

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.color import base_color, oklab, to_display
from splatpainter.holes.border import cell_of
from splatpainter.holes.support import Ground, below, support_of
from splatpainter.kernels import portable
from splatpainter.kernels.rows import by_blocks
from splatpainter.order_statistics import distinct, groups, row_keys
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import quat_to_matrix
from splatpainter.voxels.neighbours import joined_labels, near_pairs


@dataclass(frozen=True)
class BodyThresholds:
    """Which Gaussians hang together with what is selected. Measured by scripts/removal_survey.py (things of meshes on
    boards, even, rough and fitted; statues), on a lemon on a board and spots of a pot where an entry says so."""

    fine_cells: float = 1.5
    """Edge of the cubes in which Gaussians are gathered where neighbours are alike, in distances between neighbours."""
    coarse_cells: float = 2.5
    """The same where they are not, as in captures: single Gaussians say little of the surface that they are of."""
    pieces_across: float = 8.0
    """Such cubes in the radius of what is selected, at least; they are never smaller than the fine ones."""
    smooth_link: float = 0.25
    """How well neighbours among what is selected hang together (median) from which they are alike."""
    touch_cells: float = 2.0
    """Distance within which Gaussians touch, in distances between neighbours. Cubes side by side in its place join what
    lies up to 5 apart: a thing and the underside of its board."""
    same_place_cells: float = 0.5
    """Edge of the cubes in which one Gaussian of a piece stands for the others, in distances between neighbours."""
    max_pieces: int = 60_000
    """Pieces, at most."""
    coarser: float = 1.5
    """Factor by which the cubes' edge grows while there are more pieces than that."""
    reach_radii: float = 3.0
    """Radius around what is selected within which a body lies, in radii of what is selected."""
    far_share: float = 0.9
    """Share of it beyond which all is ground."""
    radius_quantile: float = 0.98
    """Quantile of the distances of what is selected from its middle that is its radius: strays lie outside."""
    end_chance: float = 3e-3
    """How strongly a selected piece is of the body, where an edge between equal neighbours is 1."""
    selected_share: float = 0.2
    """How strongly one that is not selected is of the ground, over that."""
    color_distance: float = 0.04
    """Distance in OKLab over which neighbours come apart."""
    squared_sine: float = 0.05
    """Squared sine of the angle between normals over which they do."""
    least_link: float = 1e-5
    """Of neighbours, whatever they look like."""
    color_steps: int = 3
    """Parts of each channel's range; fine pieces have Gaussians of one."""
    max_steps: int = 400
    """Steps of conjugate gradients, at most."""
    max_residual_share: float = 1e-5
    """Share of the first residual at which they end."""
    levels: int = 60
    """Chances that are tried as the least of a body."""
    level_shares: tuple[float, float] = (0.05, 0.85)
    """Those chances lie between these shares of the largest one."""
    min_covered_share: float = 0.35
    """Share of what is selected, without ground, that a body has, at least."""
    same_share: float = 0.05
    """Gaussians, over those of a body, by which one at another level may differ and is the same."""
    support_cells: float = 0.6
    """Distance from a plane within which a piece is of it, in edges of pieces."""
    support_link: float = 0.1
    """Factor of links between what a thing stands on and all else."""
    held_link: float = 0.005
    """Least link between neighbours above the plane on which a thing stands, where there is one: colours and creases of
    its own do not take it apart. Of 117 selections 93 came out right, with 0.002 and 0.001 90 and 88."""
    support_end: float = 0.05
    """How strongly a piece on which a thing stands is ground."""
    sure_end: float = 1.0
    """How strongly a piece off the border is what it is, where the border is found anew."""
    unsure_end: float = 1e-6
    """How strongly all of them are ground there."""
    max_border: float = 0.15
    """Mean link over the border of a body, over that within it, up to which it is one. Most whole things have 0 to
    0.13, one hat 0.19; cuts through the mantle of a bust 0.3 to 1."""
    box_share: float = 0.9
    """Share of the Gaussians of a part that touches nothing but the body, within the body's box, from which it goes
    with it: what a shell holds, and slivers that the walk left hanging in the air."""
    top_quantile: float = 0.9
    """Quantile of the chances of what is selected that counts as the largest one. Specks of a colour of their own have
    larger ones."""
    max_crumb_share: float = 0.05
    """Gaussians, over those of the body, up to which a part of it by itself is none."""
    max_held_share: float = 0.25
    """The same up to which a part of what is left that touches only the body goes with it: the handle of a mug."""
    min_selected_share: float = 0.2
    """Share of its Gaussians by which a body is selected, at least: a spot on a pot is not the pot."""
    max_beside_share: float = 0.05
    """Share of a body's Gaussians beside the outline that selected it, up to which the outline is around it. Of 48
    outlines around things that others touch, of which nothing was tuned on, 26 came out right with it and 13 without,
    of the survey's 147 and 138 of 168; bodies of outlines within things have 0.37 and more beside them."""
    hanging_share: float = 0.5
    """The same where no plane goes on around its foot: the seat of a chair, or a thing on rough ground."""
    max_cut: float = 0.006
    """Links between a body and what is left, over those within the smaller of them, up to which it is one (a lemon on a
    board: 0.003, things that were fitted: mostly up to 0.005); above, the cut runs through a surface (spots: up to
    0.09)."""
    max_outlined_cut: float = 0.015
    """The same for a body within its outline, of which another thing that touches it is part of what is left (two balls
    side by side: 0.008)."""
    max_evenness: float = 0.7
    """Mean agreement of the normals along the cut, up to which it is one (a lemon: 0.38); above, it is a painted figure
    (of the pot: 0.97)."""


BODY = BodyThresholds()


def body_of(splats: Splats, selected: np.ndarray, beside: np.ndarray | None = None) -> Bools | None:
    """[N] bool: the Gaussians of the connected body under a selection ([N] bool), less what of it is ground; None where
    what is selected is a part of something larger (a spot on a wall). splats: numpy. beside: [N] bool, where an outline
    on a view made the selection: those that the view draws beside it (pixel_shares.beside_mask)."""
    body = _body_within(splats, selected, None)
    if beside is None or (body is not None and (body & beside).sum() <= BODY.max_beside_share * body.sum()):
        return body
    # An outline is drawn around a thing, or within one. Around it, a neighbour that touches the thing is another
    # thing, and what is within the outline is a body of its own; within it, it is none, and the thing goes beyond.
    within = _body_within(splats, selected, beside)
    return body if within is None else within


def _body_within(splats: Splats, selected: np.ndarray, beside: np.ndarray | None) -> Bools | None:
    """`body_of`, without any of what is beside ([N] bool)."""
    visible = splats.drawable & (splats.opacities > 0)
    seeds = np.flatnonzero(selected & visible)
    if not len(seeds):
        return None
    means = splats.means.astype(np.float64)
    # Only what is near enough can be of the body: a walk over a whole capture would take minutes.
    middle = np.median(means[seeds], axis=0)
    radius = float(np.quantile(np.linalg.norm(means[seeds] - middle, axis=1), BODY.radius_quantile))
    reach = BODY.reach_radii * radius
    away = np.linalg.norm(means - middle, axis=1)
    ids = np.flatnonzero(visible & ((away < reach) | selected))
    # Pieces, not Gaussians: tens of thousands of nodes whatever the asset has.
    cell = cell_of(splats, seeds)
    facts = _Facts.of(splats, ids)
    parted = facts.groups(BODY.fine_cells * cell, BODY.color_steps)
    while len(parted[1]) > BODY.max_pieces:
        cell *= BODY.coarser
        parted = facts.groups(BODY.fine_cells * cell, BODY.color_steps)
    fine = _Pieces.of(facts, *parted)
    pairs = _near(means[ids], fine, cell)
    # Small pieces where neighbours are alike; where single Gaussians say little of a surface, larger ones average them.
    pieces, edge = fine, BODY.fine_cells * cell
    one, two = pieces.touching(pairs)
    chosen = pieces.mean(selected[ids].astype(np.float64))
    if pieces.typical_link(one, two, chosen > 0.5) < BODY.smooth_link:
        edge = min(BODY.coarse_cells * cell, max(edge, radius / BODY.pieces_across))
        pieces = _Pieces.of(facts, *facts.groups(edge, 1))
        one, two = pieces.touching(pairs)
        chosen = pieces.mean(selected[ids].astype(np.float64))
    links, evenness = pieces.links(one, two, chosen > 0.5)
    middles = pieces.mean(means[ids])
    beyond = pieces.mean((away[ids] > BODY.far_share * reach).astype(np.float64)) > 0.5
    if beside is not None:
        beyond |= pieces.mean(beside[ids].astype(np.float64)) > 0.5
    max_cut = BODY.max_cut if beside is None else BODY.max_outlined_cut
    seen = pieces.piece[selected[ids]]

    def ground_of(thing: Bools) -> Ground:
        return support_of(middles, pieces.normals, thing, (one, two), BODY.support_cells * edge)

    # What a thing stands on is sought around the selection; where that is off the ground, around the body it leads to.
    ground = ground_of(chosen > 0.5)
    is_body, weights = _cut(pieces, (one, two), links, chosen, seen, beyond, ground, max_cut)
    if is_body.any() and not ground.pieces.any():
        ground = ground_of(is_body)
        if ground.pieces.any():
            is_body, weights = _cut(pieces, (one, two), links, chosen, seen, beyond, ground, max_cut)
        elif _hangs(pieces, (one, two), is_body, seen):
            return None
    links = weights
    # Doubts: a cut through a surface, or along a painted figure, is no body's border.
    crossing = is_body[one] != is_body[two]
    inner = is_body[one] & is_body[two]
    if not is_body.any() or portable.total(links[crossing]) > max_cut * portable.total(links[inner]):
        return None
    if crossing.any() and portable.mean(links[crossing]) > BODY.max_border * portable.mean(links[inner]):
        return None
    if crossing.any() and portable.mean(evenness[crossing]) > BODY.max_evenness:
        return None
    # A small part of the body under the lasso was meant as that part, unless the lasso is around all of the body.
    within = is_body[pieces.piece]
    if beside is None and selected[ids][within].mean() < BODY.min_selected_share:
        return None
    within |= _enclosed(means[ids], pieces, (one, two), is_body, beyond)
    body = np.zeros(len(splats), bool)
    # Its border once more, between smaller pieces.
    at_border = np.zeros(len(is_body), bool)
    at_border[one[crossing]], at_border[two[crossing]] = True, True
    at_border |= ground.pieces & below(middles, is_body, ground.normal, edge)
    body[ids] = _refined(fine, pairs, within, at_border[pieces.piece])
    # Of a body in crumbs next to nothing may be left.
    meant = ids[selected[ids] & ~ground.pieces[pieces.piece]]
    return body if body[meant].mean() >= BODY.min_covered_share else None


def _cut(
    pieces: _Pieces,
    edges: tuple[np.ndarray, np.ndarray],
    links: np.ndarray,
    chosen: np.ndarray,
    seen: np.ndarray,
    beyond: Bools,
    ground: Ground,
    max_cut: float,
) -> tuple[Bools, np.ndarray]:
    """([P] bool the body found by a walk and a level of its chances; [E] links given what is ground). links: [E];
    chosen: [P] 0..1; seen: [S] pieces of what is selected; beyond: [P] bool, too far away; max_cut: as of _swept."""
    one, two = edges
    # What a thing stands on is no part of it, within a lasso or not; with it known, a crease alone is no border.
    chosen = np.where(ground.pieces, 0, chosen)
    links = links * np.where(ground.pieces[one] != ground.pieces[two], BODY.support_link, 1)
    if ground.pieces.any():
        links = np.where(ground.at_height[one] | ground.at_height[two], links, np.maximum(links, BODY.held_link))
    seen = seen[~ground.pieces[seen]]
    if not len(seen):
        return np.zeros(len(chosen), bool), links
    # The walk: it starts anywhere and ends where something is selected, rarely elsewhere, surely far away.
    ends = BODY.end_chance * (chosen + BODY.selected_share * (1 - chosen)) + beyond + BODY.support_end * ground.pieces
    chances = _walked(one, two, links, BODY.end_chance * chosen, ends)
    # The cut: a level of chances at which few and weak links are cut for what lies within.
    of_selected = chances[seen]
    most, least = (float(np.quantile(of_selected, q)) for q in (BODY.top_quantile, 1 - BODY.min_covered_share))
    low, high = BODY.level_shares[0] * most, min(BODY.level_shares[1] * most, least)
    levels = np.linspace(low, max(low, high), BODY.levels)
    is_body = _swept(one, two, links, np.where(beyond, 0, chances), levels, pieces.counts, max_cut)
    return _without_crumbs(one, two, is_body, pieces.counts, ground.at_height), links


def _hangs(pieces: _Pieces, edges: tuple[np.ndarray, np.ndarray], is_body: Bools, seen: np.ndarray) -> bool:
    """Whether a body ([P] bool) that stands on no plane is a part: it touches more than it is, and little of it is
    selected. seen: [S] pieces of what is selected."""
    one, two = edges
    count = pieces.counts[is_body].sum()
    touches = bool((is_body[one] != is_body[two]).any())
    return touches and 2 * count < pieces.counts.sum() and is_body[seen].sum() < BODY.hanging_share * count


def _refined(fine: _Pieces, pairs: tuple[np.ndarray, np.ndarray], within: Bools, unsure: Bools) -> Bools:
    """[G] bool: a body ([G]) whose border ([G] bool: unsure) is found anew between smaller pieces."""
    one, two = fine.touching(pairs)
    body, ground = (fine.mean((of & ~unsure).astype(np.float64)) > 0.5 for of in (within, ~within))
    links, _ = fine.links(one, two, body)
    chances = _walked(one, two, links, BODY.sure_end * body, BODY.sure_end * (body | ground) + BODY.unsure_end)
    is_body = np.where(unsure, (chances > 0.5)[fine.piece], within)
    share = fine.mean(is_body.astype(np.float64)) > 0.5
    cleared = _without_crumbs(one, two, share, fine.counts, np.zeros(len(share), bool))
    return np.where(unsure, cleared[fine.piece], is_body)


def body_or_selection(splats: Splats, selected: np.ndarray, beside: np.ndarray | None = None) -> tuple[np.ndarray, str]:
    """([N] bool the body that a selection ([N] bool) is of, or the selection itself where there is none; one line that
    says which). beside: as for `body_of`."""
    body = body_of(splats, selected, beside)
    if body is None:
        return selected, "only what was selected was removed: it is a part of something larger"
    return body, f"removed what hangs together with what was selected: {int(body.sum()):,} Gaussians"


@dataclass(frozen=True)
class _Facts:
    """What tells pieces of surface apart, of G Gaussians."""

    means: Floats
    """[G, 3] float64."""
    outer: Floats
    """[G, 6] n n^T, as the normals of _Pieces."""
    facing: Ids
    """[G] axis that each normal is nearest to."""
    colors: Floats
    """[G, 3] on the display, 0..1."""

    @staticmethod
    def of(splats: Splats, ids: np.ndarray) -> _Facts:
        means, scales = splats.means[ids].astype(np.float64), splats.scales[ids]
        axes = quat_to_matrix(splats.quats[ids].astype(np.float64))
        x, y, z = axes[np.arange(len(ids)), :, scales.argmin(1)].T
        root = np.sqrt(2)
        # Normals have no sign, so their outer products are averaged; six numbers hold them.
        outer = np.stack([x * x, y * y, z * z, root * x * y, root * x * z, root * y * z], 1)
        colors = to_display(np.clip(base_color(splats.sh[ids]), 0, 1), splats.color_space)
        return _Facts(means, outer, np.abs(np.stack([x, y, z], 1)).argmax(1), colors)

    def groups(self, edge: float, color_steps: int) -> tuple[Ids, np.ndarray]:
        """([G] int64 piece of each Gaussian, [P] how many each piece has). edge: of the cubes, world units;
        color_steps: parts of a channel's range, of which a piece has one."""
        step = np.minimum((self.colors * color_steps).astype(np.int64), color_steps - 1)
        cells = np.floor((self.means - self.means.min(0)) / edge).astype(np.int64)
        # One piece is one place, one direction and one colour, so a corner or a colour edge never lies within one.
        return groups(row_keys(np.concatenate([cells, self.facing[:, None], step], 1)))[1:]


@dataclass(frozen=True)
class _Pieces:
    """P pieces of surface of G Gaussians."""

    piece: Ids
    """[G] int64."""
    counts: np.ndarray
    """[P]."""
    normals: np.ndarray
    """[P, 6] mean of n n^T: xx yy zz, and the others times the root of 2, so that products are squared cosines."""
    colors: np.ndarray
    """[P, 3] OKLab."""

    @staticmethod
    def of(facts: _Facts, piece: Ids, counts: np.ndarray) -> _Pieces:
        """piece, counts: as the attributes."""
        empty = _Pieces(piece, counts, np.zeros(0), np.zeros(0))
        return _Pieces(piece, counts, empty.mean(facts.outer), oklab(empty.mean(facts.colors).astype(np.float32)))

    def mean(self, values: np.ndarray) -> np.ndarray:
        """[P] or [P, C] of [G] or [G, C]."""
        columns = values.reshape(len(values), -1).T
        sums = [np.bincount(self.piece, column, len(self.counts)) for column in columns]
        return (np.stack(sums, 1) / self.counts[:, None]).reshape(len(self.counts), *values.shape[1:])

    def touching(self, pairs: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """([E] int64, [E] int64) pieces that hold both Gaussians of a pair, each two once."""
        count = np.int64(len(self.counts))

        def keys_of(block: slice) -> np.ndarray:
            one, two = (self.piece.take(of[block]) for of in pairs)
            apart = np.flatnonzero(one != two)  # most are of one piece
            one, two = one.take(apart), two.take(apart)
            return distinct(np.minimum(one, two) * count + np.maximum(one, two))

        # Tens of millions of pairs: what is computed of a block stays in the cache, and neighbours repeat each other.
        keys = distinct(np.concatenate([np.zeros(0, np.int64), *by_blocks(keys_of, len(pairs[0]))]))
        return keys // len(self.counts), keys % len(self.counts)

    def differences(self, one: np.ndarray, two: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """([E] squared distance of colours in OKLab, [E] squared sine between normals) of pairs of pieces."""
        away = ((self.colors[one] - self.colors[two]) ** 2).sum(1)
        cosine = (self.normals[one] * self.normals[two]).sum(1)  # squared; less where normals scatter
        # Against the scatter of normals in each piece: fog must not count as a crease.
        even = np.sqrt((self.normals[one] ** 2).sum(1) * (self.normals[two] ** 2).sum(1))
        return away, np.clip(even - cosine, 0, 1)

    def typical_link(self, one: np.ndarray, two: np.ndarray, selected: Bools) -> float:
        """How well neighbours among the selected ([P] bool) hang together, 0..1: the median."""
        among = selected[one] & selected[two]
        if not among.any():
            return 0.0
        away, turned = self.differences(one[among], two[among])
        return float(np.median(portable.exp(-away / BODY.color_distance**2 - turned / BODY.squared_sine)))

    def links(self, one: np.ndarray, two: np.ndarray, selected: Bools) -> tuple[np.ndarray, np.ndarray]:
        """([E] how well pieces that touch hang together, 0..1; [E] how well their normals agree, 0..1). selected: [P]
        bool; where neighbours among these differ by more than the thresholds of colours and normals, as in captures,
        their median takes their place."""
        away, turned = self.differences(one, two)
        # A capture's own noise must not cut it into pieces: what neighbours differ by within it counts as nothing.
        among = selected[one] & selected[two]
        noise, roughness = (float(np.median(of[among])) if among.any() else 0.0 for of in (away, turned))
        evenness = portable.exp(-turned / max(BODY.squared_sine, roughness))
        links = portable.exp(-away / max(BODY.color_distance**2, noise)) * evenness
        return np.maximum(links, BODY.least_link), evenness


def _near(means: np.ndarray, fine: _Pieces, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """([K] int64, [K] int64) pairs of Gaussians ([G, 3]) that are near; of those in one place one stands for all of its
    piece. cell: distance between neighbours."""
    cubes = np.floor((means - np.median(means, axis=0)) / (BODY.same_place_cells * cell))
    # A clump of thousands must not have millions of pairs.
    first = groups(row_keys(np.concatenate([cubes, fine.piece[:, None]], 1)))[0]
    one, two = near_pairs(means[first], BODY.touch_cells * cell)
    return first[one], first[two]


def _walked(one: np.ndarray, two: np.ndarray, links: np.ndarray, source: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """[P] chance that a walk from each piece ends at what is selected: (L + diag(ends)) p = source, L the Laplacian of
    the links. By conjugate gradients."""
    count = len(ends)
    # The system is symmetric and diagonally dominant; conjugate gradients with its diagonal as preconditioner.
    diagonal = ends + np.bincount(one, links, count) + np.bincount(two, links, count)

    def product(p: np.ndarray) -> np.ndarray:
        return diagonal * p - np.bincount(one, links * p[two], count) - np.bincount(two, links * p[one], count)

    p = np.zeros(count)
    residual = source.copy()
    direction = residual / diagonal
    energy = float((residual * direction).sum())
    start = energy
    for _ in range(BODY.max_steps):
        if energy <= BODY.max_residual_share**2 * start or energy == 0:
            break
        image = product(direction)
        length = energy / float((direction * image).sum())
        p += length * direction
        residual -= length * image
        scaled = residual / diagonal
        before, energy = energy, float((residual * scaled).sum())
        direction = scaled + energy / before * direction
    return p


def _swept(
    one: np.ndarray,
    two: np.ndarray,
    links: np.ndarray,
    chances: np.ndarray,
    levels: np.ndarray,
    counts: np.ndarray,
    max_cut: float = BODY.max_cut,
) -> Bools:
    """[P] bool: pieces with chances above that of some levels (ascending), whose border cuts few links; of several such
    bodies that which is the same at the most levels; none where every border cuts many. counts: [P] Gaussians of each
    piece; max_cut: links cut, over those within the smaller side, at most."""
    low, high = (np.searchsorted(levels, f(chances[one], chances[two]), "left") for f in (np.minimum, np.maximum))
    # A piece is within at levels below its chance: an edge is cut at those between its ends.
    count = len(levels)
    begins, ends = (np.bincount(of, links, count + 1)[:count] for of in (low, high))
    cut, left = np.cumsum(begins - ends), np.cumsum(begins + ends)
    within = 2 * links.sum() - left
    # As Andersen, Chung, Lang, "Local graph partitioning using PageRank vectors", 2006: over the smaller side.
    share = cut / np.maximum(np.minimum(within, left), 1e-30)
    fits = (share <= max_cut) & (within > cut)
    # All but the last crumbs of a capture hang by next to nothing on these, and would be the best body.
    crumbs = left < BODY.max_crumb_share * within
    if (fits & ~crumbs).any():
        fits &= ~crumbs
    if not fits.any():
        return np.zeros(len(chances), bool)
    inside = np.searchsorted(levels, chances, "left")  # at how many levels each piece is within
    sizes = counts.sum() - np.cumsum(np.bincount(inside, counts, count + 1))[:count]
    same = np.abs(sizes - sizes[:, None]) <= BODY.same_share * sizes[:, None]
    lasting = np.where(fits, (same & fits).sum(1), 0)
    among = fits & same[int(lasting.argmax())]
    return chances > levels[int(np.where(among, share, np.inf).argmin())]


def _without_crumbs(one: np.ndarray, two: np.ndarray, is_body: np.ndarray, counts: np.ndarray, ground: Bools) -> Bools:
    """[P] bool: a body without small parts that lie apart, and with parts that touch nothing but it and the plane on
    which it stands ([P] bool: ground). counts: [P] Gaussians of each piece."""
    for side in (True, False):
        # Legs hang together by the ground alone.
        same = (is_body[one] == side) & (is_body[two] == side) & (side | ~(ground[one] | ground[two]))
        # First crumbs of the body go to the ground, then what of the ground only the body holds goes to the body.
        labels = joined_labels(len(counts), one[same], two[same])
        sizes = np.bincount(labels, np.where(is_body == side, counts, 0), len(counts))
        share = BODY.max_crumb_share if side else BODY.max_held_share
        limit = share * (sizes.max() if side else counts[is_body].sum())
        touching = np.zeros(len(counts), bool)
        crossing = is_body[one] != is_body[two]
        touching[labels[one[crossing]]], touching[labels[two[crossing]]] = True, True
        crumbs = (is_body == side) & (sizes[labels] < limit) & (touching[labels] | side)
        # What most of the rest hangs together with is ground, however small.
        crumbs &= (labels != int(sizes.argmax())) & (side | ~ground)
        is_body = is_body ^ crumbs
    return is_body


def _enclosed(
    means: np.ndarray, pieces: _Pieces, edges: tuple[np.ndarray, np.ndarray], is_body: np.ndarray, beyond: np.ndarray
) -> Bools:
    """[G] bool: what hangs together with nothing but the body, within its box: the inner side of a hollow one."""
    # A hollow body's inner side, and what only its shell holds, would be left hanging in the air.
    one, two = edges
    apart = ~is_body[one] & ~is_body[two]
    labels = joined_labels(len(pieces.counts), one[apart], two[apart])
    elsewhere = np.zeros(len(labels), bool)
    elsewhere[labels[is_body | beyond]] = True
    within_body = is_body[pieces.piece]
    low, high = means[within_body].min(0), means[within_body].max(0)
    part = labels[pieces.piece]
    inside = np.bincount(part, ((means >= low) & (means <= high)).all(1), len(labels))
    held = ~elsewhere & (inside >= BODY.box_share * np.bincount(part, minlength=len(labels)))
    return held[part]
