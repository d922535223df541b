"""Baked scenes: surfels, or cards, whose texels lie in one atlas (`export.baked_scene`). Not in the paper.

A thread is a pixel. Read: the surfels' records and limits, the tiles' lists, and the atlas. Written:

    ids          of `nearest`: the first few hits by their own depth, for programs that test depths instead of sorting
    image        sum over the hits of weight * colour, without background
    alphas       1 - final transmittance
    texels       backward: gradients of the atlas
    colors       backward: gradients of the surfels' plain colours and, fourth, of their opacities

A surfel has its own alpha (`shape`), and its colour is the plain one plus a texel. A card is the rectangle of |u| and
|v| up to 1 with the colour and alpha of a texel. Of cut-outs, alpha becomes a coverage: 1 or 0 at a threshold, or in
training a steep sigmoid. Hits are blended front to back, in the order of the list or of `nearest`. Geometry is frozen.
The recurrence backward is that of `collect_backward`; it adds by atomics, so that on a CPU one thread walks all pixels.
"""

from __future__ import annotations

import warp as wp

from nexwarp.kernels.collect import alpha_if_near
from nexwarp.kernels.surfel import hit
from nexwarp.kernels.types import TileLists, func_per_real, per_real
from nexwarp.kernels.walk import overflowed, pixel_of, surfel_at, tile_of, walk
from nexwarp.native.vector_loads import load_record
from nexwarp.native.warp import any_in_warp, lane_index, warp_sum

LARGEST_COVERAGE = 0.999  # in training: one of 1 would hide what is behind from its gradient
FARTHEST = 1e30


@func_per_real
def place_of(atlas: Atlas, i: int, u: real, v: real):
    """(column, row), whole at centres of texels, of a point of surfel i."""
    box = atlas.boxes[i]
    rect = atlas.rects[i]
    x = rect[0] + wp.clamp((u - box[0]) * box[2], ZERO, ONE) * rect[2]
    y = rect[1] + wp.clamp((v - box[1]) * box[3], ZERO, ONE) * rect[3]
    # As samplers clamp: rectangles of foreign files may end between the atlas' side and its outer texels.
    last = wp.vec2i(atlas.texels.shape[1] - 1, atlas.texels.shape[0] - 1)
    return vec2(wp.clamp(x, ZERO, real(float(last[0]))), wp.clamp(y, ZERO, real(float(last[1]))))


@func_per_real
def corners(texels: vec4_rows, place: vec2):
    """(left, top, right, bottom) of the texels around a place, and where it lies between them."""
    x = int(wp.floor(place[0]))
    y = int(wp.floor(place[1]))
    ends = wp.vec4i(x, y, wp.min(x + 1, texels.shape[1] - 1), wp.min(y + 1, texels.shape[0] - 1))
    return ends, vec2(place[0] - real(float(x)), place[1] - real(float(y)))


@func_per_real
def sample(texels: vec4_rows, place: vec2):
    """The texels at a place, bilinearly."""
    e, f = corners(texels, place)
    upper = texels[e[1], e[0]] * (ONE - f[0]) + texels[e[1], e[2]] * f[0]
    lower = texels[e[3], e[0]] * (ONE - f[0]) + texels[e[3], e[2]] * f[0]
    return upper * (ONE - f[1]) + lower * f[1]


@func_per_real
def add_texels(texels: vec4_rows, place: vec2, grad: vec4):
    """Add the derivative of `sample`."""
    e, f = corners(texels, place)
    wp.atomic_add(texels, e[1], e[0], grad * ((ONE - f[0]) * (ONE - f[1])))
    wp.atomic_add(texels, e[1], e[2], grad * (f[0] * (ONE - f[1])))
    wp.atomic_add(texels, e[3], e[0], grad * ((ONE - f[0]) * f[1]))
    wp.atomic_add(texels, e[3], e[2], grad * (f[0] * f[1]))


@func_per_real
def covered(atlas: Atlas, alpha: real):
    """(coverage of an alpha, its derivative)."""
    cap = wp.static(LARGEST_COVERAGE if cut else ALPHA_MAX)
    coverage = alpha
    slope = ONE
    if wp.static(cut):
        coverage = ONE / (ONE + wp.exp(atlas.steepness * (atlas.cutoff - alpha)))
        slope = atlas.steepness * coverage * (ONE - coverage)
        if atlas.steepness == ZERO:
            return wp.where(alpha >= atlas.cutoff, ONE, ZERO), ZERO
    return wp.min(coverage, cap), wp.where(coverage < cap, slope, ZERO)


@func_per_real
def look_up(surfels: Surfels, atlas: Atlas, i: int, d: vec2, near: real):
    """(colour of surfel i, not clamped; alpha, 0 for no hit; its slope by the parameter; depth; texels' place)."""
    a, b, n, c = load_record(surfels.records, i)
    u, v, depth = hit(a, b, n, c[3], d)
    color = vec3()
    alpha = wp.where(wp.abs(u) <= ONE and wp.abs(v) <= ONE, ONE, ZERO)
    if wp.static(not cards):
        alpha = alpha_if_near(u, v, surfels.limits[i], a[3], b[3], n[3])
    slope = wp.where(alpha < wp.static(LARGEST_COVERAGE if cut else ALPHA_MAX), alpha / a[3], ZERO)  # by the opacity
    place = vec2()
    if alpha < ALPHA_MIN or not (depth > near):
        alpha = ZERO
    else:
        place = place_of(atlas, i, u, v)
        texel = sample(atlas.texels, place)
        color = vec3(texel[0], texel[1], texel[2])
        if wp.static(cards):
            alpha, slope = covered(atlas, texel[3])
        else:
            color += vec3(c[0], c[1], c[2])
    return color, alpha, slope, depth, place


@per_real("layers", "cards", "cut", grid_stride=False)
def nearest(first: int, surfels: Surfels, lists: TileLists, view: View, atlas: Atlas, drawn: Drawn):
    """Find each pixel's first `layers` cards that cover some of it, by depth."""
    thread = first + wp.tid()
    xy, inside, d = pixel_of(thread, view)
    if not inside:
        return
    ids = wp.vector(length=wp.static(layers), dtype=wp.int32)
    depths = wp.vector(length=wp.static(layers), dtype=real)
    for j in range(wp.static(layers)):
        ids[j] = -1
        depths[j] = FARTHEST
    overflow = overflowed(lists)
    bounds = walk(tile_of(thread), lists, overflow)
    for k in range(bounds[0], bounds[1]):
        i = surfel_at(k, lists, overflow)
        _color, alpha, _slope, depth, _place = look_up(surfels, atlas, i, d, view.near)
        if alpha >= ALPHA_MIN and depth < depths[wp.static(layers - 1)]:
            displaced = bool(False)
            for j in range(wp.static(layers)):
                i_ = ids[j]
                depth_ = depths[j]
                displaced = displaced or depth < depth_
                ids[j] = wp.where(displaced, i, i_)
                depths[j] = wp.where(displaced, depth, depth_)
                i = wp.where(displaced, i_, i)
                depth = wp.where(displaced, depth_, depth)
    for j in range(wp.static(layers)):
        drawn.ids[xy[1] * view.size[0] + xy[0], j] = ids[j]


@func_per_real
def hits_of(thread: int, lists: TileLists, overflow: bool, drawn: Drawn):
    """First and last place (exclusive) of the hits of a thread's pixel: of the tile's list, or of `nearest`."""
    if wp.static(cut):
        return wp.vec2i(0, drawn.ids.shape[1])
    return walk(tile_of(thread), lists, overflow)


@func_per_real
def surfel_of(k: int, p: int, lists: TileLists, overflow: bool, drawn: Drawn):
    """The surfel at place k of a pixel p's hits, -1 behind their end."""
    if wp.static(cut):
        return drawn.ids[p, k]
    return surfel_at(k, lists, overflow)


@per_real("cards", "cut", grid_stride=False)
def blend(first: int, surfels: Surfels, lists: TileLists, view: View, atlas: Atlas, drawn: Drawn):
    thread = first + wp.tid()
    xy, inside, d = pixel_of(thread, view)
    if not inside:
        return
    p = xy[1] * view.size[0] + xy[0]
    overflow = overflowed(lists)
    bounds = hits_of(thread, lists, overflow, drawn)
    transmittance = real(1.0)
    total = vec3()
    for k in range(bounds[0], bounds[1]):
        i = surfel_of(k, p, lists, overflow, drawn)
        if i < 0 or transmittance < TRANSMITTANCE_MIN:
            break
        color, alpha, _slope, _depth, _place = look_up(surfels, atlas, i, d, view.near)
        total += wp.max(color, vec3()) * (alpha * transmittance)
        transmittance = transmittance * (ONE - alpha)
    drawn.image[p] = total
    drawn.alphas[p] = ONE - transmittance


@func_per_real
def add_gradients(sums: TexelSums, atlas: Atlas, i: int, place: vec2, hits: bool, hit_grad: vec4):
    """Add a hit's gradients, of its colour and, fourth, its alpha's parameter; 0 for no hit.

    The lanes of a warp walk along the same surfels: they add up what belongs to these, before one of them adds it to
    where thousands of pixels do. All lanes take part. Cards have texels alone.
    """
    if wp.static(cards):
        if hits:
            add_texels(sums.texels, place, hit_grad)
        return
    if any_in_warp(wp.where(hits, 1, 0)) == 0:
        return
    total = vec4(warp_sum(hit_grad[0]), warp_sum(hit_grad[1]), warp_sum(hit_grad[2]), warp_sum(hit_grad[3]))
    leads = lane_index() == 0
    if leads:
        wp.atomic_add(sums.colors, i, total)
    rect = atlas.rects[i]
    if rect[2] == ZERO and rect[3] == ZERO:  # one texel for all pixels, the atlas' first for untextured surfels
        if leads:
            add_texels(sums.texels, vec2(rect[0], rect[1]), vec4(total[0], total[1], total[2], ZERO))
    elif hits:
        add_texels(sums.texels, place, vec4(hit_grad[0], hit_grad[1], hit_grad[2], ZERO))


@func_per_real
def gradients_of(color: vec3, alpha: real, slope: real, transmittance: real, grad: vec4, rest: real):
    """(gradients of a hit's colour and, fourth, of its alpha's parameter; what is left for the hits behind)."""
    weight = alpha * transmittance
    shown = wp.max(color, vec3())
    q = grad[0] * shown[0] + grad[1] * shown[1] + grad[2] * shown[2] + grad[3]
    rest -= q * weight
    hit_grad = vec4()
    if slope != ZERO:  # a cut-out's coverage is 1, where the quotient is none
        hit_grad[3] = slope * (transmittance * q - rest / (ONE - alpha))
    for channel in range(3):
        hit_grad[channel] = wp.where(color[channel] > ZERO, grad[channel] * weight, ZERO)
    return hit_grad, rest


@per_real("cards", "cut", grid_stride=False)
def blend_backward(
    first: int,
    surfels: Surfels,
    lists: TileLists,
    view: View,
    atlas: Atlas,
    drawn: Drawn,
    grads: Drawn,
    sums: TexelSums,
):
    """Add the derivative of `blend`."""
    thread = first + wp.tid()
    xy, inside, d = pixel_of(thread, view)
    p = xy[1] * view.size[0] + xy[0]
    overflow = overflowed(lists)
    bounds = hits_of(thread, lists, overflow, drawn)
    transmittance = real(0.0)  # a pixel outside of the image has no hits
    grad = vec4()
    rest = real(0.0)
    if inside:
        transmittance = ONE
        color_grad = grads.image[p]
        grad = vec4(color_grad[0], color_grad[1], color_grad[2], grads.alphas[p])
        rest = wp.dot(color_grad, drawn.image[p]) + grad[3] * drawn.alphas[p]
    for k in range(bounds[0], bounds[1]):
        going = transmittance >= TRANSMITTANCE_MIN
        if any_in_warp(wp.where(going, 1, 0)) == 0:
            break
        i = int(-1)
        if inside:  # as is the first lane of a warp that has come here
            i = surfel_of(k, p, lists, overflow, drawn)
        alpha = real(0.0)
        hit_grad = vec4()
        place = vec2()
        if going and i >= 0:
            color, alpha, slope, _depth, place = look_up(surfels, atlas, i, d, view.near)
            if alpha > ZERO:
                hit_grad, rest = gradients_of(color, alpha, slope, transmittance, grad, rest)
        add_gradients(sums, atlas, i, place, alpha > ZERO, hit_grad)
        transmittance = transmittance * (ONE - alpha)
