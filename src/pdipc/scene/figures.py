"""Animals, a helicopter, a pumpkin and others as unions of round cones, for scenes that need no mesh files.

A figure is some 1 m in its largest extent, y up, and faces +z. Every part is a cone between two balls: (from, to, radius there, radius
here), m. Parts flow into each other over the length `blend`; `holes` are taken out. `stuffing` fills them with tets.
"""

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from pdipc.scene.meshes import Mesh
from pdipc.scene.stuffing import stuffed

Point = tuple[float, float, float]
Cone = tuple[Point, Point, float, float]
AT_ONCE = 50_000  # points whose distances to all parts are held in memory


@dataclass(frozen=True)
class Figure:
    """A union of round cones, less a union of others."""

    parts: list[Cone]
    blend: float = 0.02
    holes: list[Cone] = field(default_factory=list)

    def level(self, x: np.ndarray) -> np.ndarray:
        """(n, 3) m -> (n,) m: about the distance to the surface, negative inside."""
        return np.concatenate([self._level(x[k : k + AT_ONCE]) for k in range(0, max(1, len(x)), AT_ONCE)])

    def _level(self, x: np.ndarray) -> np.ndarray:
        distances = [_distance(cone, x) for cone in self.parts]
        least = np.min(distances, axis=0)
        total = np.zeros(len(x))
        for distance in distances:
            total += np.exp(np.maximum((least - distance) / self.blend, -40.0))
        inside = least - self.blend * np.log(total)
        for cone in self.holes:
            inside = np.maximum(inside, -_distance(cone, x))
        return inside

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of a box around it."""
        ends, radii = np.array([part[:2] for part in self.parts]), np.array([part[2:] for part in self.parts])
        reach = radii[:, :, None] + self.blend * math.log(len(self.parts))
        return (ends - reach).min(axis=(0, 1)), (ends + reach).max(axis=(0, 1))


def mesh(name: str, size: float, cells: int) -> Mesh:
    """The figure of that name, its bounding box centred at the origin; size: its largest extent, m; cells: across that."""
    whole = _mesh(name, cells)
    low, high = whole.vertices.min(axis=0), whole.vertices.max(axis=0)
    return Mesh(size / (high - low).max() * (whole.vertices - 0.5 * (low + high)), whole.triangles, whole.tets)


@lru_cache(maxsize=32)
def _mesh(name: str, cells: int) -> Mesh:
    low, high = FIGURES[name].box()
    return stuffed(FIGURES[name].level, low, high, float((high - low).max()) / cells)


def _distance(cone: Cone, x: np.ndarray) -> np.ndarray:
    start, end = np.array(cone[0]), np.array(cone[1])
    along = end - start
    t = np.clip((x - start) @ along / max(along @ along, 1e-30), 0.0, 1.0)
    return np.linalg.norm(x - start - t[:, None] * along, axis=1) - (cone[2] + t * (cone[3] - cone[2]))


def dance(x: np.ndarray, time: float) -> np.ndarray:
    """(n, 3): where the points of the dancer, of size 1 m, are at a time, s: her hips sway and turn, the rest follows less."""
    swing = 2.0 * math.pi * time / 0.8
    rise = 1.0 - math.exp(-((time / 0.25) ** 2))  # she starts from rest
    height = x[:, 1:2]
    hips = np.exp(-(((height + 0.04) / 0.22) ** 2))
    turn = (0.45 * rise * math.sin(swing + 0.8) * np.exp(-(((height + 0.04) / 0.3) ** 2)))[:, 0]
    c, s = np.cos(turn), np.sin(turn)
    turned = np.column_stack([c * x[:, 0] + s * x[:, 2], x[:, 1], c * x[:, 2] - s * x[:, 0]])
    return turned + rise * hips * [0.07 * math.sin(swing), 0.012 * math.sin(2.0 * swing), 0.03 * math.cos(swing)]


# --- what figures are made of ---


def both(cone: Cone) -> list[Cone]:
    """A part and its mirror image in x."""
    (a, b, r, s) = cone
    return [cone, ((-a[0], *a[1:]), (-b[0], *b[1:]), r, s)]


def chain(points: list[Point], radii: list[float]) -> list[Cone]:
    """Parts from each point to the next."""
    return [(points[k], points[k + 1], radii[k], radii[k + 1]) for k in range(len(points) - 1)]


def ball(at: Point, radius: float) -> Cone:
    return (at, at, radius, radius)


def stout(parts: list[Cone], factor: float) -> list[Cone]:
    """The parts with larger radii."""
    return [(a, b, factor * r, factor * s) for a, b, r, s in parts]


def shifted(at: Point | np.ndarray, x: float, y: float, z: float) -> np.ndarray:
    return np.asarray(at) + np.array([x, y, z])


def _four_legs(x: float, front: float, back: float, top: float, foot: float, radius: float) -> list[Cone]:
    return [leg for z in (front, back) for leg in both(((x, top, z), (x, foot, z), radius * 1.15, radius))]


def _tree() -> list[Cone]:
    """A bare, crooked tree: boughs that fork twice, roots."""
    trunk = chain([(0.0, 0.0, 0.0), (0.03, 0.2, 0.0), (-0.02, 0.42, 0.01), (0.0, 0.56, 0.0)], [0.085, 0.062, 0.052, 0.05])
    roots = [((0.0, 0.03, 0.0), (0.17 * math.cos(a), -0.0, 0.17 * math.sin(a)), 0.06, 0.03) for a in (0.4, 1.7, 2.9, 4.1, 5.3)]
    boughs: list[Cone] = []
    for k, (height, angle, length, rise) in enumerate(
        (
            (0.55, 0.15, 0.42, 0.2),
            (0.5, 3.3, 0.44, 0.16),
            (0.56, 1.7, 0.34, 0.34),
            (0.46, 4.9, 0.32, 0.22),
            (0.4, 2.4, 0.3, 0.18),
        )
    ):
        out = np.array([math.cos(angle), 0.0, math.sin(angle)])
        start = np.array([0.0, height, 0.0])
        bend = start + 0.5 * length * out + [0.0, 0.7 * rise, 0.0]
        tip = start + length * out + [0.0, 0.75 * rise, 0.0]
        boughs += chain([tuple(start), tuple(bend), tuple(tip)], [0.045, 0.034, 0.022])
        side = np.array([-out[2], 0.0, out[0]]) * (1 if k % 2 else -1)
        boughs.append((tuple(bend), tuple(bend + 0.13 * out + 0.1 * side + [0.0, 0.17, 0.0]), 0.03, 0.02))
        boughs.append((tuple(0.5 * (bend + tip)), tuple(tip - 0.1 * side + [0.0, 0.1, 0.0]), 0.027, 0.02))
    return trunk + roots + boughs


def _bones() -> list[Cone]:
    """A dragon's skeleton: a spine of beads, ribs, a skull with horns, legs and wings of bare bones."""
    way = np.linspace(0.0, 1.0, 13)
    spine = [(0.0, 0.1 * math.sin(5.0 * t) + 0.16 * max(0.0, t - 0.7), 0.5 - 1.0 * t) for t in way]
    spine = [(0.04 * math.sin(7.0 * t), y, z) for t, (_, y, z) in zip(way, spine, strict=True)][
        ::-1
    ]  # from the tail to the neck
    parts = chain(spine, [0.014 + 0.006 * t for t in way])
    parts += [ball(point, 0.022 + 0.006 * t) for t, point in zip(way[1:], spine[1:], strict=True)]
    x, y, z = spine[-1]
    parts += [
        ((x, y + 0.03, z + 0.04), (x, y + 0.02, z + 0.2), 0.042, 0.024),
        ((x, y - 0.04, z + 0.04), (x, y - 0.09, z + 0.18), 0.021, 0.018),
    ]
    parts += both(((x + 0.035, y + 0.06, z + 0.03), (x + 0.09, y + 0.16, z - 0.08), 0.026, 0.018))
    for k in (5, 7, 9):
        a = np.array(spine[k])
        deep = 0.2 - 0.02 * abs(k - 7)
        for side in (-1, 1):
            out = [
                shifted(a, side * 0.12, -0.03, 0.0),
                shifted(a, side * 0.15, -0.6 * deep, 0.01),
                shifted(a, side * 0.09, -1.05 * deep, 0.02),
            ]
            parts += chain([tuple(a), *map(tuple, out)], [0.022, 0.02, 0.019, 0.018])
    for k, reach in ((10, 0.16), (4, 0.15)):
        a = np.array(spine[k])
        for side in (-1, 1):
            leg = [
                shifted(a, side * reach, -0.06, 0.03),
                shifted(a, side * (reach + 0.02), -0.2, -0.03),
                shifted(a, side * (reach + 0.02), -0.22, 0.07),
            ]
            parts += chain([tuple(a), *map(tuple, leg)], [0.03, 0.024, 0.02, 0.018])
    a = np.array(spine[8])
    for side in (-1, 1):
        elbow, hand = shifted(a, side * 0.2, 0.17, 0.0), shifted(a, side * 0.36, 0.24, -0.02)
        parts += chain([tuple(a), tuple(elbow), tuple(hand)], [0.03, 0.023, 0.02])
        parts += [(tuple(hand), tuple(shifted(hand, side * 0.1, -0.14, dz)), 0.02, 0.017) for dz in (0.12, -0.03, -0.2)]
    return parts


def _dragon() -> list[Cone]:
    """A winding body on four legs, a raised neck, a head with horns and jaws, a back of spikes, wings, a long tail."""
    tail = [(-0.1, 0.1, -0.62), (0.04, 0.0, -0.55), (0.13, -0.06, -0.42), (0.07, -0.03, -0.28)]
    body = [
        (-0.02, 0.02, -0.15),
        (-0.05, 0.05, 0.0),
        (0.0, 0.06, 0.14),
        (0.05, 0.15, 0.25),
        (0.04, 0.29, 0.28),
        (0.0, 0.38, 0.33),
    ]
    back, radii = [*tail, *body], [0.024, 0.034, 0.045, 0.065, 0.095, 0.11, 0.1, 0.075, 0.062, 0.06]
    parts = chain(back, radii)
    for k in range(2, 9):
        middle, radius = 0.5 * (np.array(back[k]) + np.array(back[k + 1])), 0.5 * (radii[k] + radii[k + 1])
        away = np.array([0.0, 1.0, 0.0]) if k < 7 else np.array([0.0, 0.4, -0.9])
        parts.append((tuple(middle + 0.6 * radius * away), tuple(middle + (radius + 0.065) * away), 0.04, 0.022))
    parts += [((0.0, 0.4, 0.34), (-0.01, 0.36, 0.5), 0.075, 0.045), ((0.0, 0.34, 0.36), (-0.01, 0.27, 0.46), 0.038, 0.03)]
    parts += both(((0.035, 0.45, 0.33), (0.085, 0.56, 0.22), 0.03, 0.022))
    for side in (-1, 1):
        for k in (4, 6):
            a = np.array(back[k])
            leg = [
                shifted(a, side * 0.13, -0.04, 0.02),
                shifted(a, side * 0.16, -0.2, -0.03),
                shifted(a, side * 0.17, -0.23, 0.07),
            ]
            parts += chain([tuple(a), *map(tuple, leg)], [0.07, 0.062, 0.042, 0.036])
        shoulder = shifted(back[5], side * 0.05, 0.08, 0.0)
        tip = shifted(shoulder, side * 0.3, 0.26, -0.08)
        parts.append((tuple(shoulder), tuple(tip), 0.045, 0.028))
        for part, drop in ((1.0, 0.2), (0.6, 0.16), (0.3, 0.1)):  # the wing's skin, as fingers that touch
            start = shoulder + part * (tip - shoulder)
            parts.append((tuple(start), tuple(shifted(start, side * 0.02, -drop, -0.17)), 0.034, 0.03))
    return parts


def _helicopter() -> list[Cone]:
    parts = [((0, 0, 0.06), (0, -0.01, 0.22), 0.12, 0.1), ((0, 0.04, -0.05), (0, 0.08, -0.5), 0.07, 0.035)]
    parts += [((0, 0.08, -0.48), (0, 0.22, -0.55), 0.036, 0.026), ((0, 0.08, 0.05), (0, 0.28, 0.05), 0.045, 0.036)]
    parts += [((-0.14, 0.09, -0.44), (0.14, 0.09, -0.44), 0.024, 0.024)]
    for k in range(3):
        c, s = math.cos(k * 2 * math.pi / 3 + 0.5), math.sin(k * 2 * math.pi / 3 + 0.5)
        for off in (-0.025, 0.025):  # a blade is flat: two rods side by side
            parts.append(((-off * s, 0.28, 0.05 + off * c), (0.5 * c - off * s, 0.28, 0.05 + 0.5 * s + off * c), 0.028, 0.024))
    for side in (-1, 1):
        rail = side * 0.19
        parts.append(((rail, -0.27, -0.12), (rail, -0.27, 0.3), 0.04, 0.04))
        parts += [((side * 0.06, -0.08, z), (rail, -0.27, z), 0.04, 0.038) for z in (0.0, 0.2)]
    return parts


def _pumpkin() -> list[Cone]:
    ribs = [(0.27 * math.cos(a), 0.27 * math.sin(a)) for a in np.arange(8) * math.pi / 4]
    return [
        *(((x, -0.09, z), (x, 0.09, z), 0.2, 0.2) for x, z in ribs),
        ((0, -0.1, 0), (0, 0.12, 0), 0.22, 0.22),
        ((0, 0.28, 0), (0.05, 0.47, 0.02), 0.07, 0.055),
    ]


def _ghost() -> list[Cone]:
    hem = [(0.2 * math.cos(a), 0.2 * math.sin(a)) for a in np.arange(6) * math.pi / 3]
    return [
        ((0, 0.3, 0), (0, -0.1, 0), 0.19, 0.23),
        ((0, -0.1, 0), (0, -0.34, 0), 0.23, 0.2),
        *(((0.7 * x, -0.2, 0.7 * z), (x, -0.42, z), 0.13, 0.075) for x, z in hem),
        *both(((0.15, 0.08, 0.03), (0.36, 0.0, 0.1), 0.085, 0.065)),
    ]


FIGURES: dict[str, Figure] = {
    "dinosaur": Figure(
        [
            ((0, 0.0, 0.04), (0, 0.1, 0.14), 0.15, 0.14),
            ((0, 0.13, 0.16), (0, 0.36, 0.27), 0.1, 0.08),
            ((0, 0.4, 0.27), (0, 0.37, 0.44), 0.095, 0.06),
            ((0, 0.33, 0.28), (0, 0.27, 0.41), 0.05, 0.035),
            *chain([(0, 0.0, -0.02), (0, -0.06, -0.25), (0, -0.03, -0.42), (0, 0.05, -0.56)], [0.13, 0.085, 0.055, 0.03]),
            *both(((0.11, -0.02, 0.02), (0.13, -0.22, 0.1), 0.1, 0.07)),
            *both(((0.13, -0.22, 0.1), (0.13, -0.4, 0.0), 0.06, 0.045)),
            *both(((0.13, -0.43, 0.0), (0.14, -0.44, 0.13), 0.05, 0.04)),
            *both(((0.1, 0.1, 0.22), (0.13, 0.0, 0.32), 0.045, 0.032)),
        ]
    ),
    "biped": Figure(
        [
            ((0, 0.0, 0), (0, 0.2, 0), 0.17, 0.19),
            ((0, 0.36, 0.02), (0, 0.34, 0.14), 0.12, 0.06),
            *both(((0.08, 0.42, 0.0), (0.13, 0.52, 0.0), 0.045, 0.03)),
            *chain([(0, -0.06, -0.1), (0, -0.2, -0.27), (0, -0.22, -0.42)], [0.1, 0.07, 0.03]),
            *both(((0.16, 0.22, 0), (0.33, 0.27, 0.08), 0.085, 0.07)),
            *both(((0.33, 0.27, 0.08), (0.4, 0.43, 0.18), 0.065, 0.06)),
            *both(((0.1, -0.08, 0), (0.2, -0.36, 0.02), 0.11, 0.08)),
            *both(((0.2, -0.42, 0.0), (0.23, -0.42, 0.14), 0.07, 0.055)),
        ]
    ),
    "dragon": Figure(_dragon(), 0.015),
    "bone_dragon": Figure(stout(_bones(), 1.65), 0.008),
    "helicopter": Figure(stout(_helicopter(), 1.3), 0.012),
    "pumpkin": Figure(
        _pumpkin(),
        0.006,
        [
            *both(((0.13, 0.1, 0.56), (0.15, 0.12, 0.3), 0.07, 0.07)),
            *chain([(-0.22, -0.09, 0.5), (-0.08, -0.16, 0.53), (0.08, -0.16, 0.53), (0.22, -0.09, 0.5)], [0.06] * 4),
        ],
    ),
    "ghost": Figure(_ghost(), 0.03),
    "tree": Figure(stout(_tree(), 1.3), 0.012),
    "dancer": Figure(
        [
            ((0, 0.4, 0), (0, 0.42, 0.02), 0.075, 0.065),
            ((0, 0.32, 0), (0, 0.25, 0), 0.035, 0.04),
            *both(((0.045, 0.2, 0), (0.02, 0.06, 0), 0.07, 0.055)),
            *both(((0.03, 0.0, 0), (0.055, -0.06, 0), 0.065, 0.075)),
            *both(((0.065, -0.08, 0), (0.075, -0.28, 0.01), 0.066, 0.045)),
            *both(((0.075, -0.28, 0.01), (0.08, -0.48, -0.01), 0.042, 0.03)),
            *both(((0.08, -0.49, 0.0), (0.085, -0.49, 0.06), 0.03, 0.026)),
            *both(((0.1, 0.22, 0), (0.25, 0.2, 0.0), 0.038, 0.03)),
            *both(((0.25, 0.2, 0.0), (0.36, 0.32, 0.02), 0.028, 0.026)),
        ],
        0.02,
    ),
    "pig": Figure(
        [
            ((0, 0.02, -0.18), (0, 0.02, 0.14), 0.24, 0.22),
            ((0, 0.08, 0.26), (0, 0.05, 0.4), 0.18, 0.13),
            ((0, 0.04, 0.42), (0, 0.04, 0.5), 0.085, 0.085),
            *both(((0.09, 0.2, 0.28), (0.15, 0.3, 0.3), 0.055, 0.035)),
            *_four_legs(0.13, 0.12, -0.2, -0.12, -0.33, 0.07),
            *chain([(0, 0.1, -0.4), (0.04, 0.17, -0.45)], [0.035, 0.03]),
        ]
    ),
    "cat": Figure(
        [
            ((0, 0, -0.2), (0, 0.02, 0.15), 0.13, 0.14),
            ((0, 0.18, 0.25), (0, 0.17, 0.3), 0.14, 0.12),
            *both(((0.08, 0.27, 0.25), (0.1, 0.38, 0.25), 0.05, 0.028)),
            *_four_legs(0.08, 0.14, -0.2, -0.08, -0.32, 0.05),
            *chain([(0, 0.05, -0.3), (0, 0.16, -0.46), (0.02, 0.34, -0.44)], [0.05, 0.045, 0.04]),
        ]
    ),
    "rabbit": Figure(
        [
            ((0, -0.12, -0.12), (0, -0.06, 0.06), 0.19, 0.15),
            ((0, 0.12, 0.14), (0, 0.1, 0.2), 0.13, 0.11),
            *both(((0.07, 0.2, 0.1), (0.13, 0.45, 0.06), 0.06, 0.055)),
            *both(((0.12, -0.22, -0.12), (0.13, -0.29, 0.05), 0.08, 0.055)),
            *both(((0.07, -0.16, 0.12), (0.07, -0.3, 0.16), 0.05, 0.045)),
            ball((0, -0.1, -0.32), 0.07),
        ]
    ),
    "giraffe": Figure(
        [
            ((0, 0.0, -0.15), (0, 0.04, 0.1), 0.12, 0.12),
            ((0, 0.08, 0.14), (0, 0.42, 0.26), 0.08, 0.055),
            ((0, 0.46, 0.27), (0, 0.42, 0.4), 0.07, 0.05),
            *both(((0.03, 0.5, 0.25), (0.04, 0.58, 0.24), 0.028, 0.026)),
            *_four_legs(0.08, 0.1, -0.17, -0.06, -0.4, 0.042),
            ((0, 0.05, -0.26), (0, -0.12, -0.33), 0.03, 0.028),
        ]
    ),
    "elephant": Figure(
        [
            ((0, 0.03, -0.16), (0, 0.04, 0.1), 0.24, 0.22),
            ((0, 0.13, 0.25), (0, 0.11, 0.3), 0.17, 0.15),
            *chain([(0, 0.06, 0.38), (0, -0.14, 0.46), (0, -0.27, 0.44), (0, -0.26, 0.54)], [0.085, 0.06, 0.05, 0.042]),
            *(
                cone
                for off in (0.0, 0.1)
                for cone in both(((0.14, 0.24 - off, 0.22), (0.3, 0.2 - 1.3 * off, 0.16), 0.05, 0.045))
            ),
            *_four_legs(0.13, 0.1, -0.18, -0.1, -0.33, 0.085),
            ((0, 0.1, -0.37), (0, -0.08, -0.44), 0.03, 0.028),
        ]
    ),
    "penguin": Figure(
        [
            ((0, -0.2, 0), (0, 0.1, 0), 0.24, 0.2),
            ((0, 0.3, 0.02), (0, 0.32, 0.04), 0.16, 0.15),
            ((0, 0.3, 0.16), (0, 0.28, 0.27), 0.055, 0.035),
            *both(((0.19, 0.1, 0), (0.34, -0.14, 0), 0.07, 0.055)),
            *both(((0.11, -0.42, 0.04), (0.13, -0.43, 0.2), 0.07, 0.065)),
        ]
    ),
    "turtle": Figure(
        [
            *(ball((0.16 * math.cos(a), 0.0, 0.2 * math.sin(a)), 0.17) for a in np.arange(8) * math.pi / 4),
            ball((0, 0.06, 0), 0.2),
            ((0, 0.0, 0.34), (0, 0.08, 0.5), 0.07, 0.085),
            *both(((0.2, -0.06, 0.24), (0.36, -0.12, 0.32), 0.07, 0.06)),
            *both(((0.2, -0.06, -0.27), (0.32, -0.12, -0.32), 0.07, 0.055)),
            ((0, -0.04, -0.34), (0, -0.04, -0.46), 0.045, 0.03),
        ]
    ),
}
