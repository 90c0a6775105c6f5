"""The body that a selection is of: the whole thing under a lasso, its back and its hollow inside too, without the
ground on which it stands. Pure.

    body = body_of(splats, weights > 0.5)  # None: what is selected is a part of something larger

Gaussians are gathered into small pieces of surface of one place, direction and colour. Neighbouring pieces hang
together the better, the more their colours and normals agree: over a contact ring, where a thing stands on the ground,
hardly. A random walk over them (Grady, "Random walks for image segmentation", 2006) that may end anywhere, more rarely
where nothing is selected (BODY.selected_share), has from all of one body about the same chance to end at the selection:
the body is what lies above the level of chances that cuts the fewest links. A strip of ground within a lasso is not of
it, as it hangs together with all the ground around.
"""

from __future__ import annotations

import numpy as np

from splatpainter.array_types import Bools, Ids
from splatpainter.color import base_color, oklab, to_display
from splatpainter.holes.border import cell_of
from splatpainter.kernels import portable
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import quat_to_matrix
from splatpainter.voxels.neighbours import joined_labels


@dataclass(frozen=True)
class BodyThresholds:
    """Which Gaussians hang together with what is selected. Measured on a lemon on a board and on spots of a pot where
    an entry says so, else taste."""

    piece_cells: float = 1.5
    """Edge of the cubes in which Gaussians are gathered at first, in distances between neighbours."""
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
    """Parts of each channel's range; pieces have Gaussians of one."""
    max_steps: int = 400
    """Steps of conjugate gradients, at most."""
    max_residual_share: float = 1e-5
    """Share of the first residual at which they end."""
    levels: int = 60
    """Chances that are tried as the least of a body."""
    level_shares: tuple[float, float] = (0.4, 0.8)
    """Those chances lie between these shares of the largest one."""
    level_shares_noisy: tuple[float, float] = (0.1, 0.8)
    """The same where captured colours and normals are noisy: what is behind a captured statue has less of a chance (0.3
    of the largest one, its pedestal 0.05), as its own noise cuts links."""
    box_share: float = 0.9
    """Share of the Gaussians of a part that touches nothing but the body, within the body's box, from which it goes
    with it: what a shell holds, and slivers that the walk left hanging in the air."""
    top_quantile: float = 0.9
    """Quantile of the chances of what is selected that counts as the largest one. Specks of a colour of their own have
    larger ones."""
    max_crumb_share: float = 0.05
    """Gaussians, over those of the body, up to which a part of it by itself is none, and a part of what is left is
    body."""
    min_selected_share: float = 0.12
    """Share of its Gaussians by which a body is selected, at least: a spot on a pot is not the pot."""
    max_cut: float = 0.02
    """Links between a body and what is left over those within it, up to which it is one (a lemon on a board: 0.003);
    above, the cut runs through a surface (a spot on the board: 0.09)."""
    max_cut_noisy: float = 0.003
    """The same where captured colours and normals are noisy: statues on their pedestals 0.0001 to 0.0006, spots on them
    0.006 and more."""
    max_evenness: float = 0.7
    """Mean agreement of the normals along the cut, up to which it is one (a lemon: 0.38); above, it is a painted figure
    (of the pot: 0.97)."""


BODY = BodyThresholds()


def body_of(splats: Splats, selected: np.ndarray) -> Bools | None:
    """[N] bool: the Gaussians of the connected body under a selection ([N] bool), less what of it is ground; None where
    what is selected is a part of something larger (a spot on a wall). splats: numpy."""
    visible = splats.drawable & (splats.opacities > 0)
    seeds = np.flatnonzero(selected & visible)
    if not len(seeds):
        return None
    means = splats.means.astype(np.float64)
    # Only what is near enough can be of the body: a walk over a whole capture would take minutes.
    middle = np.median(means[seeds], axis=0)
    reach = BODY.reach_radii * float(np.quantile(np.linalg.norm(means[seeds] - middle, axis=1), BODY.radius_quantile))
    away = np.linalg.norm(means - middle, axis=1)
    ids = np.flatnonzero(visible & ((away < reach) | selected))
    edge = BODY.piece_cells * cell_of(splats, seeds)
    # Pieces, not Gaussians: tens of thousands of nodes whatever the asset has.
    pieces = _Pieces.of(splats, ids, edge)
    while len(pieces.counts) > BODY.max_pieces:
        edge *= BODY.coarser
        pieces = _Pieces.of(splats, ids, edge)
    # The walk: it starts anywhere and ends where something is selected, rarely elsewhere, surely far away.
    chosen = pieces.mean(selected[ids].astype(np.float64))
    one, two, links, evenness, is_noisy = pieces.links(chosen > 0.5)
    beyond = pieces.mean((away[ids] > BODY.far_share * reach).astype(np.float64)) > 0.5
    ends = BODY.end_chance * (chosen + BODY.selected_share * (1 - chosen)) + beyond
    chances = _walked(one, two, links, BODY.end_chance * chosen, ends)
    # The cut: the level of chances at which the fewest links are cut for what lies within.
    most = float(np.quantile(chances[pieces.piece][selected[ids]], BODY.top_quantile))
    shares = BODY.level_shares_noisy if is_noisy else BODY.level_shares
    is_body = _swept(one, two, links, np.where(beyond, 0, chances), np.linspace(*shares, BODY.levels) * most)
    is_body = _without_crumbs(one, two, is_body, pieces.counts)
    # Doubts: a cut through a surface, or along a painted figure, is no body's border.
    crossing = is_body[one] != is_body[two]
    inner = is_body[one] & is_body[two]
    most_cut = BODY.max_cut_noisy if is_noisy else BODY.max_cut
    if not is_body.any() or float(links[crossing].sum()) > most_cut * float(links[inner].sum()):
        return None
    if crossing.any() and float(evenness[crossing].mean()) > BODY.max_evenness:
        return None
    # A small part of the body under the lasso was meant as that part.
    within = is_body[pieces.piece]
    if selected[ids][within].mean() < BODY.min_selected_share:
        return None
    body = np.zeros(len(splats), bool)
    body[ids] = within | _enclosed(means[ids], pieces, (one, two), is_body, beyond)
    return body


def body_or_selection(splats: Splats, selected: np.ndarray) -> tuple[np.ndarray, str]:
    """([N] bool the body that a selection ([N] bool) is of, or the selection itself where there is none; one line that
    says which)."""
    body = body_of(splats, selected)
    if body is None:
        return selected, "only what was selected was removed: it is a part of something larger"
    return body, f"removed what hangs together with what was selected: {int(body.sum()):,} Gaussians"


@dataclass(frozen=True)
class _Pieces:
    """P pieces of surface of G Gaussians."""

    piece: Ids
    """[G] int64."""
    counts: np.ndarray
    """[P]."""
    cells: Ids
    """[P, 3] int64 cube of each."""
    normals: np.ndarray
    """[P, 6] mean of n n^T: xx yy zz, and the others times the root of 2, so that products are squared cosines."""
    colors: np.ndarray
    """[P, 3] OKLab."""

    @staticmethod
    def of(splats: Splats, ids: np.ndarray, edge: float) -> _Pieces:
        """edge: of the cubes, world units."""
        means, scales = splats.means[ids].astype(np.float64), splats.scales[ids]
        axes = quat_to_matrix(splats.quats[ids].astype(np.float64))
        x, y, z = axes[np.arange(len(ids)), :, scales.argmin(1)].T
        root = np.sqrt(2)
        # Normals have no sign, so their outer products are averaged; six numbers hold them.
        outer = np.stack([x * x, y * y, z * z, root * x * y, root * x * z, root * y * z], 1)
        colors = to_display(np.clip(base_color(splats.sh[ids]), 0, 1), splats.color_space)
        step = np.minimum((colors * BODY.color_steps).astype(np.int64), BODY.color_steps - 1)
        cells = np.floor((means - means.min(0)) / edge).astype(np.int64)
        facing = np.abs(np.stack([x, y, z], 1)).argmax(1)
        # One piece is one place, one direction and one colour, so a corner or a colour edge never lies within one.
        keys = np.concatenate([cells, facing[:, None], step], 1)
        _, first, piece, counts = np.unique(keys, axis=0, return_index=True, return_inverse=True, return_counts=True)
        piece = piece.ravel()
        empty = _Pieces(piece, counts, cells[first], np.zeros(0), np.zeros(0))
        return _Pieces(piece, counts, cells[first], empty.mean(outer), oklab(empty.mean(colors).astype(np.float32)))

    def mean(self, values: np.ndarray) -> np.ndarray:
        """[P] or [P, C] of [G] or [G, C]."""
        columns = values.reshape(len(values), -1).T
        sums = [np.bincount(self.piece, column, len(self.counts)) for column in columns]
        return (np.stack(sums, 1) / self.counts[:, None]).reshape(len(self.counts), *values.shape[1:])

    def links(self, selected: Bools) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, bool]:
        """(one, two: [E] int64 pieces of one cube or of two that touch; [E] how well they hang together, 0..1; [E] how
        well their normals agree, 0..1; whether the asset is noisy). selected: [P] bool; where neighbours among these
        differ by more than the thresholds of colours and normals, as in captures, their median takes their place."""
        spans = self.cells.max(0) + 3
        keys = ((self.cells[:, 0] + 1) * spans[1] + self.cells[:, 1] + 1) * spans[2] + self.cells[:, 2] + 1
        order = np.argsort(keys, kind="stable")
        ordered = keys[order]
        ones, twos = [], []
        # Half of the 26 neighbours and the cube itself: each pair once.
        for x in (0, 1):
            for y in (-1, 0, 1) if x else (0, 1):
                for z in (-1, 0, 1) if x or y else (0, 1):
                    there = keys + (x * spans[1] + y) * spans[2] + z
                    start = np.searchsorted(ordered, there, "left")
                    count = np.searchsorted(ordered, there, "right") - start
                    one = np.repeat(np.arange(len(keys)), count)
                    turn = np.arange(len(one)) - np.repeat(np.cumsum(count) - count, count)
                    two = order[np.repeat(start, count) + turn]
                    different = one < two if not (x or y or z) else slice(None)
                    ones.append(one[different])
                    twos.append(two[different])
        one, two = np.concatenate(ones), np.concatenate(twos)
        away = ((self.colors[one] - self.colors[two]) ** 2).sum(1)
        cosine = (self.normals[one] * self.normals[two]).sum(1)  # squared; less where normals scatter
        # Against the scatter of normals in each piece: fog must not count as a crease.
        even = np.sqrt((self.normals[one] ** 2).sum(1) * (self.normals[two] ** 2).sum(1))
        turned = np.clip(even - cosine, 0, 1)
        # A capture's own noise must not cut it into pieces: what neighbours differ by within it counts as nothing.
        among = selected[one] & selected[two]
        noise, roughness = (float(np.median(of[among])) if among.any() else 0.0 for of in (away, turned))
        evenness = portable.exp(-turned / max(BODY.squared_sine, roughness))
        links = portable.exp(-away / max(BODY.color_distance**2, noise)) * evenness
        is_noisy = noise > BODY.color_distance**2 or roughness > BODY.squared_sine
        return one, two, np.maximum(links, BODY.least_link), evenness, is_noisy


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


def _swept(one: np.ndarray, two: np.ndarray, links: np.ndarray, chances: np.ndarray, levels: np.ndarray) -> Bools:
    """[P] bool: pieces with chances above that of some levels (ascending) which gives the least cut for what is within,
    or for what is left where that is less (as Andersen, Chung, Lang, "Local graph partitioning using PageRank vectors",
    2006); where more than crumbs can be left, they are."""
    low, high = (np.searchsorted(levels, f(chances[one], chances[two]), "left") for f in (np.minimum, np.maximum))
    # A piece is within at levels below its chance: an edge is cut at those between its ends.
    begins, ends = (np.bincount(of, links, len(levels) + 1)[: len(levels)] for of in (low, high))
    cut = np.cumsum(begins - ends)
    left = np.cumsum(begins + ends)
    within = 2 * links.sum() - left
    share = cut / np.maximum(np.minimum(within, left), 1e-30)
    # All but the last crumbs of a capture hang by next to nothing on these, and would be the best body.
    crumbs = left < BODY.max_crumb_share * within
    return chances > levels[int(np.where(crumbs & ~crumbs.all(), np.inf, share).argmin())]


def _without_crumbs(one: np.ndarray, two: np.ndarray, is_body: np.ndarray, counts: np.ndarray) -> Bools:
    """[P] bool: a body without small parts that lie apart, and with the small parts that only it touches. counts: [P]
    Gaussians of each piece."""
    for side in (True, False):
        same = (is_body[one] == side) & (is_body[two] == side)
        # First crumbs of the body go to the ground, then crumbs of the ground that only it touches to the body.
        labels = joined_labels(len(counts), one[same], two[same])
        sizes = np.bincount(labels, counts, len(counts))
        limit = BODY.max_crumb_share * (sizes[labels[is_body]].max(initial=0) if side else counts[is_body].sum())
        touching = np.zeros(len(counts), bool)
        crossing = is_body[one] != is_body[two]
        touching[labels[one[crossing]]], touching[labels[two[crossing]]] = True, True
        crumbs = (is_body == side) & (sizes[labels] < limit) & (touching[labels] | side)
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
