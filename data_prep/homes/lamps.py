"""Lamps under the ceiling: a size and a style in, closed parts out; their top is at y = h."""

import numpy as np

from data_prep.homes.solids import (
    Parts,
    ball,
    block,
    disc,
    lathe,
    oval,
    ring,
    rod,
    slab,
    soft_block,
    tube,
)


def _cord(h: float, bottom: float, x: float = 0.0, z: float = 0.0) -> Parts:
    """A cord from `bottom` up to its canopy under the ceiling."""
    return [disc(0.008, h - bottom, x, bottom, z, 8), disc(0.055, 0.03, x, h - 0.03, z, 14)]


def _shade(radius: float, h: float, kind: int, x: float = 0.0, z: float = 0.0) -> Parts:
    """A lamp shade standing at y = 0: cone, dome, drum, globe or bell."""
    r = radius
    if kind == 0:
        return [lathe([(r, 0), (r, 0.02 * h), (0.16 * r, 0.92 * h), (0.16 * r, h)], x, z)]
    if kind == 1:
        turn = np.linspace(0, 1.4, 6)
        return [lathe([(r * np.cos(a), h * np.sin(a) / np.sin(1.4)) for a in turn], x, z)]
    if kind == 2:
        return [disc(r, h * 0.8, x, 0.1 * h, z, 24), disc(r * 0.9, h, x, 0, z, 24)]
    if kind == 3:
        polar = np.linspace(0.1, np.pi - 0.1, 9)
        return [lathe([(r * np.sin(a), h / 2 * (1 - np.cos(a))) for a in polar], x, z)]
    return [
        lathe(
            [(r, 0), (0.9 * r, 0.1 * h), (0.45 * r, 0.4 * h), (0.3 * r, 0.8 * h), (0.1 * r, h)],
            x,
            z,
        )
    ]


def pendant_lamp(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """One shade on a cord, three in a row, a hoop, or a chandelier with arms."""
    if w > 0.95 and d < 0.5 * w:
        return _row_of_three(w, h, d, style)
    if w > 0.6 and style % 3 == 0:
        return _chandelier(w, h, d, 5 + style % 2)
    if w > 0.6 and style % 3 == 1:
        return _hoops(w, h)
    tall = min(0.5 * h, max(0.16, 0.62 * w))
    return _shade(w / 2, tall, style % 5) + _cord(h, tall * 0.97)


def _row_of_three(w: float, h: float, d: float, style: int) -> Parts:
    parts = [soft_block(w * 0.8, 0.04, min(0.1, d), y=h - 0.04, radius=0.015)]
    tall = min(0.3 * h, 1.2 * d)
    for k, x in enumerate((-w / 2 + d / 2, 0.0, w / 2 - d / 2)):
        drop = 0.12 * h if k == 1 else 0.0
        shade = _shade(d / 2, tall, style % 5, x)
        for part in shade:
            part.apply_translation([0, drop, 0])
        parts += [*shade, disc(0.007, h - drop - tall * 0.97, x * 0.98, drop + tall * 0.97, 0, 8)]
    return parts


def _chandelier(w: float, h: float, d: float, arms: int) -> Parts:
    hub = min(0.35 * h, 0.35)
    parts = [*_cord(h, hub), lathe([(0.01, 0), (0.06, 0.06), (0.03, hub * 0.6), (0.04, hub)])]
    reach = 0.5 * w - 0.07
    for turn in np.arange(arms) * 2 * np.pi / arms:
        x, z = np.sin(turn), np.cos(turn) * d / w
        bend = [(0.03, 0.1), (0.4, 0.02), (0.8, 0.05), (1.0, 0.16)]
        parts.append(tube([[x * reach * r, y, z * reach * r] for r, y in bend], 0.012, 6))
        parts += [
            disc(0.04, 0.02, x * reach, 0.15, z * reach, 10),
            lathe([(0.04, 0.17), (0.07, 0.32)], x * reach, z * reach, 10),
        ]
    return parts


def _hoops(w: float, h: float) -> Parts:
    lower, upper = ring(w / 2, 0.05), ring(w * 0.32, 0.05, min(0.3 * h, 0.3))
    parts = [lower, upper, disc(0.08, 0.03, 0, h - 0.03, 0, 14)]
    for turn in np.arange(3) * 2 * np.pi / 3:
        x, z = np.sin(turn), np.cos(turn)
        reach = w / 2 - 0.025
        parts.append(rod([x * reach, 0.03, z * reach], [x * 0.05, h - 0.02, z * 0.05], 0.006))
    return parts


def ceiling_lamp(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A flat drum, a square panel, a bowl, petals, or a cross of arms; short stems if tall."""
    kind = style % 5
    stem = max(0.0, h - 0.32)
    body = h - stem
    parts: Parts = []
    if kind == 0:
        parts = [slab(oval(w, d, 28), body * 0.7), slab(oval(w * 0.8, d * 0.8, 28), body)]
    elif kind == 1:
        parts = [soft_block(w, body * 0.6, d, radius=0.03), block(w * 0.75, body, d * 0.75)]
        parts.append(block(w * 0.3, body * 0.2, d * 0.3, y=body * 0.8))
    elif kind == 2:
        turn = np.linspace(-1.45, 0, 6)
        bowl = lathe([(0.5 * np.cos(a), body * 0.85 * (1 + np.sin(a))) for a in turn], segments=24)
        bowl.apply_scale([w, 1, d])
        parts = [bowl, slab(oval(w * 0.45, d * 0.45, 20), body)]
    elif kind == 3:
        parts = [slab(oval(w * 0.35, d * 0.35, 16), body)]
        for turn in np.arange(6) * np.pi / 3:
            x, z = w * 0.33 * np.sin(turn), d * 0.33 * np.cos(turn)
            petal = slab(oval(w * 0.32, d * 0.32, 14), body * 0.45, body * 0.1)
            petal.apply_translation([x, 0, z])
            parts.append(petal)
    else:
        parts = [slab(oval(w * 0.3, d * 0.3, 16), body * 0.4, body * 0.6)]
        size = min(0.2 * min(w, d), 0.9 * body)
        for x, z in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            end = [x * (w - size) / 2, body * 0.7, z * (d - size) / 2]
            parts += [rod([0, body * 0.8, 0], end, 0.014), ball(size / 2, end[0], 0.0, end[2], 7)]
    if stem:
        parts.append(disc(0.02, stem, y=body * 0.98, segments=10))
        parts.append(disc(min(0.1, w * 0.2), 0.04, y=h - 0.04, segments=16))
    return parts
