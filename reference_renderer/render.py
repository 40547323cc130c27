"""The pipeline, top to bottom: cull, project, cut into tiles, sort, blend."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from reference_renderer.composite import alive, composed, transmittances, weights_of
from reference_renderer.fragment import fragments
from reference_renderer.project import (
    TILE,
    Footprints,
    determinant,
    hooked,
    project,
    rows_in_front,
    tile_grid,
    tile_rects,
)
from reference_renderer.scene import Camera, Gaussians, Options, Rendering
from reference_renderer.surfel import project_surfels, surface_of


@dataclass(frozen=True)
class Block:
    """A rectangle of the image with the footprints that may draw there.

    Attributes:
        rows: (K,) of the footprints, front to back.
    """

    x: range
    y: range
    rows: Tensor


@dataclass(frozen=True)
class Drawing:
    """One block, drawn.

    Attributes:
        layers: (5 + F, h, w) red, green, blue, inverse depth, features, final transmittance.
        fragments: (h, w) drawn fragments of each pixel.
        per_row: (K,) drawn fragments of each of the block's footprints.
        gate: scalar, sum of the gates of fragments before their pixel's stop.
        weights: (K,) sum of alpha T of each of the block's footprints.
        winners: (h, w) which of all footprints has the largest alpha T; -1 for none.
        surface: (6, h, w) of surfels; else None.
    """

    layers: Tensor
    fragments: Tensor
    per_row: Tensor
    gate: Tensor
    weights: Tensor
    winners: Tensor
    surface: Tensor | None


@dataclass(frozen=True)
class Blended:
    """The fragments of one block of P pixels.

    Attributes:
        rows: (K,) of the Gaussians, front to back.
        alpha: (K, P), 0 where not drawn.
        drawn: (K, P) bool.
        opacity: (K,) after compensation.
        color: (K, 3) RGB.
    """

    rows: Tensor
    alpha: Tensor
    drawn: Tensor
    opacity: Tensor
    color: Tensor

    @property
    def light(self) -> Tensor:
        """(K, P) transmittance before each fragment."""
        return transmittances(self.alpha)[:-1]

    @property
    def weights(self) -> Tensor:
        """(K, P) alpha T of each fragment."""
        return weights_of(self.alpha)


def render(
    camera: Camera,
    gaussians: Gaussians,
    thresholds: Tensor | None = None,
    *,
    means2d_hook: Tensor | None = None,
    options: Options | None = None,
) -> Rendering:
    """Draw Gaussians, each truncated at its own threshold.

    Args:
        camera: the view.
        gaussians: N of them.
        thresholds: (N,) falloff in (0, 1) below which a fragment is not drawn, or None.
        means2d_hook: (N, >= 2) or None. Its values are not used. It receives the gradient of the
            projected means in NDC units: the gradient in pixels times (W / 2, H / 2).
        options: the dialect; vanilla when None.
    """
    options = options or Options()
    front = rows_in_front(camera, gaussians.means, options.near)
    footprints = footprints_of(camera, gaussians.take(front), options)
    if means2d_hook is not None:
        footprints = hooked(camera, footprints, means2d_hook[front], options)
    tau = None if thresholds is None else thresholds[front]

    touching, blocks = cut_world(camera, footprints, options)
    drawings = [draw(footprints, tau, block, options) for block in blocks]

    radii = torch.where(touching, footprints.radius, 0).to(torch.int32)
    none = torch.zeros_like(gaussians.opacities, dtype=torch.int32)
    return collect(camera, front, none.index_add(0, front, radii), blocks, drawings)


@torch.no_grad()
def blended(
    camera: Camera,
    gaussians: Gaussians,
    thresholds: Tensor | None = None,
    *,
    options: Options | None = None,
    every: int = 1,
) -> Iterator[Blended]:
    """The fragments of each block of the image, one by one, as ``render`` blends them.

    Args:
        every: 1 for all tiles, 2 for every second one, and so on.
    """
    options = options or Options()
    front = rows_in_front(camera, gaussians.means, options.near)
    footprints = footprints_of(camera, gaussians.take(front), options)
    tau = None if thresholds is None else thresholds[front]
    for block in cut_world(camera, footprints, options, every)[1]:
        here = footprints.take(block.rows)
        points = sample_points(block, options, here.mean2d)
        found = fragments(here, points, None if tau is None else tau[block.rows], options)
        live = alive(found.alpha, options.transmittance_min, options.stop)
        yield Blended(
            front[block.rows], found.alpha * live, found.drawn & live, here.opacity, here.color
        )


def footprints_of(camera: Camera, gaussians: Gaussians, options: Options) -> Footprints:
    """Footprints of Gaussians that are all in front of the camera."""
    return (project_surfels if gaussians.flat else project)(camera, gaussians, options)


def render_footprints(
    camera: Camera,
    footprints: Footprints,
    tiles: Tensor,
    thresholds: Tensor | None = None,
    *,
    means2d_hook: Tensor | None = None,
    options: Options | None = None,
) -> Rendering:
    """Draw projected Gaussians, each truncated at its own threshold; the rest is as in ``render``.

    Args:
        camera: only its size and background are used.
        footprints: N of them. Their radius is ignored, and the rendering's radii are 0. A footprint
            is culled if its depth is not positive or its conic is not positive definite.
        tiles: (N, 4) first and past-the-last tile x0, y0, x1, y1 of each.
        options: those of the projection are ignored.
    """
    options = options or Options()
    if means2d_hook is not None:
        footprints = hooked(camera, footprints, means2d_hook, options)
    conic = footprints.conic.detach()
    drawable = (conic[:, 0] > 0) & (determinant(conic) > 0) & (footprints.depth > 0)
    blocks = list(cut(camera, footprints, tiles, drawable, options))
    drawings = [draw(footprints, thresholds, block, options) for block in blocks]
    rows = torch.arange(len(tiles), device=tiles.device)
    return collect(camera, rows, torch.zeros_like(rows, dtype=torch.int32), blocks, drawings)


def collect(
    camera: Camera, front: Tensor, radii: Tensor, blocks: list[Block], drawings: list[Drawing]
) -> Rendering:
    """Assemble the whole image from its blocks.

    Args:
        front: (K,) rows of the N Gaussians that the footprints stand for.
        radii: (N,) int32 pixels.
        blocks: row by row, a drawing of each.
    """
    per_gaussian = torch.zeros_like(radii)
    weights = drawings[0].weights.new_zeros(len(radii))
    for block, drawing in zip(blocks, drawings, strict=True):
        per_gaussian = per_gaussian.index_add(0, front[block.rows], drawing.per_row)
        weights = weights.index_add(0, front[block.rows], drawing.weights)
    layers = assemble(blocks, [drawing.layers for drawing in drawings])
    gate = torch.stack([drawing.gate for drawing in drawings]).sum()
    winners = assemble(blocks, [drawing.winners for drawing in drawings])
    won = winners >= 0
    winners[won] = front[winners[won]]
    surfaces = [drawing.surface for drawing in drawings if drawing.surface is not None]
    return Rendering(
        image=layers[:3] + layers[-1:] * camera.background[:, None, None],
        radii=radii,
        invdepth=layers[3:4],
        alpha=1 - layers[-1:],
        fragments_per_pixel=gate / (camera.width * camera.height),
        fragments=assemble(blocks, [drawing.fragments for drawing in drawings]),
        fragments_per_gaussian=per_gaussian,
        evaluated=sum(len(b.rows) * len(b.x) * len(b.y) for b in blocks),
        entries=sum(len(b.rows) for b in blocks),
        features=layers[4:-1] if len(layers) > 5 else None,
        weights_per_gaussian=weights,
        winners=winners.to(torch.int32),
        wins_per_gaussian=winners[won].bincount(minlength=len(radii)).to(torch.int32),
        surface=assemble(blocks, surfaces) if surfaces else None,
    )


def cut_world(
    camera: Camera, footprints: Footprints, options: Options, every: int = 1
) -> tuple[Tensor, list[Block]]:
    """Which of K projected Gaussians touch the image, (K,) bool, and the blocks of ``cut``."""
    rects = tile_rects(camera, footprints)
    touching = (footprints.radius > 0) & ((rects[:, 2:] - rects[:, :2]) > 0).all(dim=1)
    drawable = touching if options.tiles else footprints.radius > 0
    return touching, list(cut(camera, footprints, rects, drawable, options, every))


def cut(
    camera: Camera,
    footprints: Footprints,
    rects: Tensor,
    drawable: Tensor,
    options: Options,
    every: int = 1,
) -> Iterator[Block]:
    """Cut the image into tiles, row by row, or take all of it as one block.

    Args:
        rects: (K, 4) tiles of each footprint.
        drawable: (K,) bool.
        options: ``tiles`` decides.
        every: 1 for all tiles, 2 for every second one, and so on.
    """
    order = footprints.depth.detach().argsort(stable=True)
    order = order[drawable[order]]
    if not options.tiles:
        yield Block(range(camera.width), range(camera.height), order)
        return
    x0, y0, x1, y1 = rects[order].unbind(1)
    across, down = tile_grid(camera)
    for number in range(0, across * down, every):
        j, i = divmod(number, across)
        covers = (x0 <= i) & (i < x1) & (y0 <= j) & (j < y1)
        columns = range(i * TILE, min((i + 1) * TILE, camera.width))
        rows = range(j * TILE, min((j + 1) * TILE, camera.height))
        yield Block(columns, rows, order[covers])


def draw(
    footprints: Footprints, thresholds: Tensor | None, block: Block, options: Options
) -> Drawing:
    """Blend a block's footprints, front to back, at each of its pixels.

    Args:
        thresholds: (K,) or None.
        block: the pixels and the rows of its footprints.
    """
    here = footprints.take(block.rows)
    tau = None if thresholds is None else thresholds[block.rows]
    found = fragments(here, sample_points(block, options, here.mean2d), tau, options)
    live = alive(found.alpha, options.transmittance_min, options.stop)
    more = [] if here.features is None else [here.features]
    channels = torch.cat([here.color, 1 / here.depth[:, None], *more], dim=1)
    alpha = found.alpha * live
    weights, left = composed(alpha, options.stop)
    counted = (found.drawn & live).to(torch.int32)
    shape = (len(block.y), len(block.x))
    surface = None
    if found.depth is not None and here.normal is not None:
        lit = transmittances(alpha)[:-1]
        surface = surface_of(
            weights, lit, found.drawn & live, found.depth, here.normal, options.near
        )
        surface = surface.reshape(-1, *shape)
    return Drawing(
        layers=torch.cat([channels.mT @ weights, left]).reshape(-1, *shape),
        fragments=counted.sum(dim=0, dtype=torch.int32).reshape(shape),
        per_row=counted.sum(dim=1, dtype=torch.int32),
        gate=(found.gate * live).sum(),
        weights=weights.detach().sum(dim=1),
        winners=winners_of(weights.detach(), block.rows).reshape(shape),
        surface=surface,
    )


def winners_of(weights: Tensor, rows: Tensor) -> Tensor:
    """(P,) which of rows (K,) has the largest of weights (K, P), the first of equals; or -1."""
    if len(rows) == 0:
        return rows.new_full(weights.shape[1:], -1)
    largest = weights.max(dim=0)
    return torch.where(largest.values > 0, rows[largest.indices], -1)


def sample_points(block: Block, options: Options, like: Tensor) -> Tensor:
    """(P, 2) x, y at which a block's pixels are sampled, row by row, in like's dtype."""
    x = torch.arange(block.x.start, block.x.stop, dtype=like.dtype, device=like.device)
    y = torch.arange(block.y.start, block.y.stop, dtype=like.dtype, device=like.device)
    points = torch.cartesian_prod(y, x).flip(1)
    if options.sample_offsets is None:
        return points
    columns, rows = slice(block.x.start, block.x.stop), slice(block.y.start, block.y.stop)
    return points + options.sample_offsets[rows, columns].reshape(-1, 2).detach().to(like)


def assemble(blocks: list[Block], parts: list[Tensor]) -> Tensor:
    """(..., H, W) from the blocks' parts (..., h, w), which come row by row."""
    rows: dict[int, list[Tensor]] = {}
    for block, part in zip(blocks, parts, strict=True):
        rows.setdefault(block.y.start, []).append(part)
    return torch.cat([torch.cat(row, dim=-1) for row in rows.values()], dim=-2)
