"""Light on a picture that VTK has drawn: soft shadows of one lamp, and the shade in corners and folds.

A picture is drawn larger than it will be, once in the light that comes from everywhere and once in that of the lamp,
with the depth of what is seen, and once more from the lamp, for the depth of what it reaches. From these one kernel makes the picture:
the lamp's part counts as far as the lamp is in sight ("percentage-closer soft shadows", Fernando 2005: the wider, the further away
what is in front of it), the other part as far as the half-space above a point is open within a small radius ("scalable ambient
obscurance", McGuire et al. 2012). Samples are the same for every pixel, so that pictures have no grain and films do not flicker.
"""

import functools
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from pdipc.device.language import func, kernel, struct
from pdipc.device.launch import Device

LAMP_TAPS, BLOCKER_TAPS, OPEN_TAPS = 48, 16, 32  # samples
COARSE = 2  # pixels a side that share the samples of shade, which changes little from one to the next
SAME_SURFACE = 0.1  # of the shade's radius: how far off the plane of a surface a point may be that counts to it
LAMP_SIZE = 0.1  # tangent of the lamp's apparent radius
STEEPEST = 20.0  # slope towards the lamp up to which the samples of a shadow follow a surface
ONE_SURFACE = 12.0  # a pixel shows one surface if its depth varies by less than so many of its sizes


@struct
class _View:
    """What the camera sees. Places are (right, up, away) of it, m."""

    depth: wp.array2d[wp.float32]
    near: float
    far: float
    slope: wp.vec2f  # of the rays through the picture's edges: half its width and half its height at distance 1
    pixel: float  # height of a drawn pixel at distance 1
    radius: float  # of what shades by its nearness, m
    taps: wp.array[wp.vec2f]


@struct
class _Lamp:
    """What the lamp reaches."""

    seen: wp.array2d[wp.float32]
    matrix: wp.mat44f  # places to u, v, depth in [0, 1] of that
    scale: wp.vec3f  # m per unit of u, v, depth
    way: wp.vec3f  # towards the lamp
    taps: wp.array[wp.vec2f]
    blocker_taps: wp.array[wp.vec2f]


@dataclass
class Camera:
    """frame: (4, 4), columns: right, up, away, where it stands. near, far: what depths 0 and 1 stand for, m. slope: see `_View`."""

    frame: np.ndarray
    near: float
    far: float
    slope: tuple[float, float]


def compose(
    device: Device,
    everywhere: np.ndarray,
    lamp: np.ndarray,
    depth: np.ndarray,
    camera: Camera,
    seen_by_lamp: np.ndarray,
    to_lamp: np.ndarray,
    lamp_way: np.ndarray,
    radius: float,
    oversampled: int,
) -> np.ndarray:
    """(h, w, 3) uint8: the picture, its rows from below.

    oversampled: f, drawn pixels per pixel along each side. everywhere, lamp: (f h, f w, 3) uint8, the two parts of the light. depth:
    (f h, f w) float32, 1 where nothing is. seen_by_lamp:
    (k, l) float32, [0, 1]; to_lamp: (4, 4), places to x, y, depth in [0, 1] of that. lamp_way: (3,) unit vector towards the lamp.
    radius: m, of what shades by its nearness; 0 for no such shade.
    """
    height, width = (side // oversampled for side in depth.shape)
    out = wp.zeros((height * width, 3), dtype=wp.uint8, device="cpu")
    view, light = _View(), _Lamp()
    view.depth = _array(depth, wp.float32)
    view.near, view.far = camera.near, camera.far
    view.slope = wp.vec2f(*camera.slope)
    view.pixel = 2.0 * camera.slope[1] / depth.shape[0]
    view.radius = radius
    view.taps = _disc(OPEN_TAPS, 1.0)
    light.seen = _array(seen_by_lamp, wp.float32)
    light.matrix = wp.mat44f(*(to_lamp @ camera.frame).ravel())
    light.scale = wp.vec3f(*(1.0 / np.linalg.norm(to_lamp[:3, :3], axis=1)))
    light.way = wp.vec3f(*(camera.frame[:3, :3].T @ lamp_way))
    light.taps, light.blocker_taps = _disc(LAMP_TAPS, 0.5), _disc(BLOCKER_TAPS, 0.5)
    step = COARSE * oversampled
    coarse = wp.ones((-(-depth.shape[0] // step), -(-depth.shape[1] // step)), dtype=wp.float32, device="cpu")
    if radius > 0.0:
        device.launch(kernels().shade, coarse.size, [step, view, coarse], grain=100)
    inputs = [oversampled, width, _array(everywhere, wp.uint8), _array(lamp, wp.uint8), view, light, coarse, out]
    device.launch(kernels().compose, height * width, inputs, grain=100)
    return out.numpy().reshape(height, width, 3)


def _array(values: np.ndarray, dtype: type) -> Any:
    return wp.array(values, dtype=dtype, device="cpu", copy=False)


@functools.cache
def _disc(count: int, power: float) -> wp.array:
    """Points in a disc, spread by the golden angle; evenly for a power of 1/2, denser in the middle for more."""
    k = np.arange(count)
    radius, angle = ((k + 0.5) / count) ** power, k * np.pi * (3.0 - np.sqrt(5.0))
    return wp.array(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1), dtype=wp.vec2f, device="cpu")


@functools.cache
def kernels() -> SimpleNamespace:
    """shade: how open the half-space is, for blocks of pixels; compose: a pixel of the picture each."""
    module = wp.get_module(__name__)
    module.options["enable_backward"] = False

    @func
    def away(view: _View, x: int, y: int) -> float:
        """How far away what is drawn in column x and row y is."""
        return view.near * view.far / (view.far - view.depth[y, x] * (view.far - view.near))

    @func
    def place(view: _View, x: int, y: int) -> wp.vec3f:
        """Of what is drawn in column x and row y."""
        z = away(view, x, y)
        u = (2.0 * (float(x) + 0.5) / float(view.depth.shape[1]) - 1.0) * view.slope[0]
        v = (2.0 * (float(y) + 0.5) / float(view.depth.shape[0]) - 1.0) * view.slope[1]
        return wp.vec3f(u * z, v * z, z)

    @func
    def along(view: _View, here: wp.vec3f, x: int, y: int, dx: int, dy: int) -> wp.vec3f:
        """Along the surface in the direction (dx, dy): from the neighbour before or after, whichever is nearer in depth."""
        after = place(view, wp.min(x + dx, view.depth.shape[1] - 1), wp.min(y + dy, view.depth.shape[0] - 1)) - here
        before = here - place(view, wp.max(x - dx, 0), wp.max(y - dy, 0))
        if (wp.abs(after[2]) <= wp.abs(before[2]) and wp.length_sq(after) > 0.0) or wp.length_sq(before) == 0.0:
            return after
        return before

    @func
    def reached(lamp: _Lamp, i: int, j: int, at: wp.vec3f, steep: wp.vec2f) -> float:
        """1 where the lamp's light gets, at entry (j, i), as far as the plane through `at` that has the slopes `steep`."""
        u = (float(i) + 0.5) / float(lamp.seen.shape[1]) - at[0]
        v = (float(j) + 0.5) / float(lamp.seen.shape[0]) - at[1]
        there = lamp.seen[j, i]  # 1 where nothing is in the way
        return wp.where(there < 1.0 and there < at[2] + steep[0] * u + steep[1] * v, 0.0, 1.0)

    @func
    def lit(lamp: _Lamp, u: float, v: float, at: wp.vec3f, steep: wp.vec2f) -> float:
        """Part of the light at (u, v) that gets as far as the plane, of the four nearest entries; all of it outside."""
        x, y = u * float(lamp.seen.shape[1]) - 0.5, v * float(lamp.seen.shape[0]) - 0.5
        i, j = int(wp.floor(x)), int(wp.floor(y))
        if i < 0 or j < 0 or i + 1 >= lamp.seen.shape[1] or j + 1 >= lamp.seen.shape[0]:
            return 1.0
        a, b = x - float(i), y - float(j)
        below = (1.0 - a) * reached(lamp, i, j, at, steep) + a * reached(lamp, i + 1, j, at, steep)
        above = (1.0 - a) * reached(lamp, i, j + 1, at, steep) + a * reached(lamp, i + 1, j + 1, at, steep)
        return (1.0 - b) * below + b * above

    @func
    def in_sight(lamp: _Lamp, here: wp.vec3f, normal: wp.vec3f, slack: float) -> float:
        """Part of the lamp that is in sight from `here`, where it is within `slack`, m."""
        if wp.dot(normal, lamp.way) <= 1.0 / STEEPEST:
            return 1.0  # it gives no light here anyway
        deep = lamp.scale[2]
        whole = lamp.matrix * wp.vec4f(here[0], here[1], here[2], 1.0)
        at = wp.vec3f(whole[0], whole[1], whole[2] - slack / deep)
        n = wp.cw_mul(lamp.matrix * wp.vec4f(normal[0], normal[1], normal[2], 0.0), wp.vec4f(1.0, 1.0, 1.0, 0.0))
        across = wp.vec2f(lamp.scale[0], lamp.scale[1])
        # depth per u and v in the plane of the surface, whose normal n is covariant
        steep = wp.vec2f(0.0, 0.0)
        for c in range(2):
            most = STEEPEST * across[c] / deep
            steep[c] = wp.clamp(-n[c] * across[c] * across[c] / (n[2] * deep * deep), -most, most)
        widest = LAMP_SIZE * at[2] * deep
        blockers, depths = float(0.0), float(0.0)
        for k in range(BLOCKER_TAPS):
            to = wp.cw_div(widest * lamp.blocker_taps[k], across)
            i = int((at[0] + to[0]) * float(lamp.seen.shape[1]))
            j = int((at[1] + to[1]) * float(lamp.seen.shape[0]))
            if i >= 0 and j >= 0 and i < lamp.seen.shape[1] and j < lamp.seen.shape[0]:  # noqa: SIM102 (Warp looks at both)
                if reached(lamp, i, j, at, steep) == 0.0:
                    blockers += 1.0
                    depths += lamp.seen[j, i]
        if blockers == 0.0:  # what is thinner than samples are apart may yet be in the way
            i0 = int(wp.floor(at[0] * float(lamp.seen.shape[1]) - 0.5))
            j0 = int(wp.floor(at[1] * float(lamp.seen.shape[0]) - 0.5))
            for k in range(4):
                i, j = i0 + k % 2, j0 + k // 2
                if i >= 0 and j >= 0 and i < lamp.seen.shape[1] and j < lamp.seen.shape[0]:  # noqa: SIM102 (Warp looks at both)
                    if reached(lamp, i, j, at, steep) == 0.0:
                        blockers += 1.0
                        depths += lamp.seen[j, i]
        if blockers == 0.0:
            return 1.0
        wide = LAMP_SIZE * (at[2] - depths / blockers) * deep
        wide = wp.max(wide, 1.5 * across[0] / float(lamp.seen.shape[1]))
        total = float(0.0)
        for k in range(LAMP_TAPS):
            to = wp.cw_div(wide * lamp.taps[k], across)
            total += lit(lamp, at[0] + to[0], at[1] + to[1], at, steep)
        return total / float(LAMP_TAPS)

    @func
    def openness(view: _View, here: wp.vec3f, normal: wp.vec3f, x: int, y: int) -> float:
        """How much of the half-space above `here` nothing covers within the radius."""
        covered = float(0.0)
        reach = view.radius / (view.pixel * here[2])
        for k in range(OPEN_TAPS):
            i = x + int(wp.round(reach * view.taps[k][0]))
            j = y + int(wp.round(reach * view.taps[k][1]))
            if i >= 0 and j >= 0 and i < view.depth.shape[1] and j < view.depth.shape[0]:
                to = (place(view, i, j) - here) / view.radius
                square = wp.length_sq(to)
                if square < 1.0:
                    near = 1.0 - square
                    covered += near * near * near * wp.max(wp.dot(to, normal) - 0.04, 0.0) / (square + 0.01)
        return wp.max(1.0 - 1.6 * covered / float(OPEN_TAPS), 0.0)

    @func
    def normal_at(view: _View, here: wp.vec3f, x: int, y: int) -> wp.vec3f:
        """Of the surface in column x and row y, towards the camera."""
        normal = wp.normalize(wp.cross(along(view, here, x, y, 1, 0), along(view, here, x, y, 0, 1)))
        return wp.where(wp.dot(normal, here) > 0.0, -normal, normal)

    @func
    def shared(
        view: _View, coarse: wp.array2d(dtype=wp.float32), step: int, here: wp.vec3f, normal: wp.vec3f, x: int, y: int
    ) -> float:
        """How open it is above `here`, from the blocks around that show the same surface; asked anew where none does."""
        u, v = (float(x) + 0.5) / float(step) - 0.5, (float(y) + 0.5) / float(step) - 0.5
        i, j = int(wp.floor(u)), int(wp.floor(v))
        total, weights = float(0.0), float(0.0)
        for k in range(4):
            p, q = i + k % 2, j + k // 2
            if p >= 0 and q >= 0 and p < coarse.shape[1] and q < coarse.shape[0]:
                weight = (1.0 - wp.abs(u - float(p))) * (1.0 - wp.abs(v - float(q)))
                xc, yc = (
                    wp.min(p * step + step // 2, view.depth.shape[1] - 1),
                    wp.min(q * step + step // 2, view.depth.shape[0] - 1),
                )
                if wp.abs(wp.dot(place(view, xc, yc) - here, normal)) < SAME_SURFACE * view.radius:
                    total += weight * coarse[q, p]
                    weights += weight
        if weights > 0.1:
            return total / weights
        return openness(view, here, normal, x, y)

    @func
    def parts(
        view: _View, lamp: _Lamp, coarse: wp.array2d(dtype=wp.float32), step: int, x: int, y: int, lamp_counts: bool
    ) -> wp.vec2f:
        """Of the lamp that is in sight from what is drawn there, and of the half-space above it that is open."""
        found = wp.vec2f(1.0, 1.0)
        if view.radius > 0.0:
            here = place(view, x, y)
            normal = normal_at(view, here, x, y)
            if lamp_counts:
                found[0] = in_sight(lamp, here, normal, 0.02 * view.radius + 3.0 * view.pixel * here[2])
            found[1] = shared(view, coarse, step, here, normal, x, y)
        return found

    @kernel(module, "shade")
    def shade(first: int, step: int, view: _View, coarse_out: wp.array2d(dtype=wp.float32)):
        i = first + wp.tid()
        row, column = i // coarse_out.shape[1], i % coarse_out.shape[1]
        x = wp.min(column * step + step // 2, view.depth.shape[1] - 1)
        y = wp.min(row * step + step // 2, view.depth.shape[0] - 1)
        if view.depth[y, x] < 1.0:
            here = place(view, x, y)
            coarse_out[row, column] = openness(view, here, normal_at(view, here, x, y), x, y)

    @kernel(module, "compose")
    def compose(
        first: int,
        factor: int,
        width: int,
        everywhere: wp.array3d(dtype=wp.uint8),
        by_lamp: wp.array3d(dtype=wp.uint8),
        view: _View,
        lamp: _Lamp,
        coarse: wp.array2d(dtype=wp.float32),
        out: wp.array2d(dtype=wp.uint8),
    ):
        i = first + wp.tid()
        x0, y0 = factor * (i % width), factor * (i // width)
        color, cover = wp.vec3f(), float(0.0)
        nearest, furthest, brightest = float(view.far), float(0.0), int(0)
        for k in range(factor * factor):
            x, y = x0 + k % factor, y0 + k // factor
            if view.depth[y, x] < 1.0:
                cover += 1.0
            z = away(view, x, y)
            nearest, furthest = wp.min(nearest, z), wp.max(furthest, z)
            for c in range(3):
                brightest = wp.max(brightest, int(by_lamp[y, x, c]))
        one_surface = cover == float(factor * factor) and furthest - nearest < ONE_SURFACE * view.pixel * nearest
        part = wp.vec2f(1.0, 1.0)
        if one_surface:
            part = parts(view, lamp, coarse, COARSE * factor, x0, y0, brightest > 0)
        for k in range(factor * factor):
            x, y = x0 + k % factor, y0 + k // factor
            if not one_surface and view.depth[y, x] < 1.0:
                part = parts(view, lamp, coarse, COARSE * factor, x, y, brightest > 0)
            elif not one_surface:
                part = wp.vec2f(1.0, 1.0)
            for c in range(3):
                light = part[1] * float(everywhere[y, x, c]) + (0.4 + 0.6 * part[1]) * part[0] * float(by_lamp[y, x, c])
                color[c] = color[c] + wp.min(light, 255.0)
        share = 1.0 / float(factor * factor)
        for c in range(3):
            out[i, c] = wp.uint8(color[c] * share + 0.5)

    return SimpleNamespace(shade=shade, compose=compose)
