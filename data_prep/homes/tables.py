"""Tables of all heights: a size and a style in, closed parts out; the user sits at +z."""

import numpy as np

from data_prep.homes.seats import four_legs
from data_prep.homes.solids import (
    Parts,
    ball,
    block,
    disc,
    lathe,
    oval,
    panel,
    rod,
    slab,
    soft_block,
)

DINING_WIDTH_M = 1.0
"""A table at least this wide is one to eat at; below, one beside a seat."""


def square_legs(w: float, d: float, top: float, thick: float) -> Parts:
    """Four square legs flush with the corners."""
    return [
        block(thick, top, thick, x, 0, z)
        for x in (-w / 2 + thick / 2, w / 2 - thick / 2)
        for z in (-d / 2 + thick / 2, d / 2 - thick / 2)
    ]


def table(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A dining table where it is wide, else a side table."""
    if w >= DINING_WIDTH_M:
        return _dining(w, h, d, style)
    return _side(w, h, d, style)


def _dining(w: float, h: float, d: float, style: int) -> Parts:
    kind = style % 4
    if kind == 0:
        top = [soft_block(w, 0.045, d, y=h - 0.045, radius=0.02)]
        apron = [block(w - 0.2, 0.08, 0.025, 0, h - 0.12, z) for z in (-d / 2 + 0.1, d / 2 - 0.1)]
        apron += [block(0.025, 0.08, d - 0.2, x, h - 0.12) for x in (-w / 2 + 0.1, w / 2 - 0.1)]
        legs = square_legs(w - 0.12, d - 0.12, h - 0.04, 0.07)
        return top + apron + legs
    if kind == 1:  # oval or round on one turned foot
        foot = 0.32 * min(w, d)
        profile = [(foot, 0), (foot, 0.03), (0.09, 0.1), (0.06, h * 0.5), (0.12, h - 0.04)]
        return [slab(oval(w, d, 32), 0.04, h - 0.04), lathe(profile)]
    if kind == 2:  # trestles
        parts = [block(w, 0.05, d, y=h - 0.05)]
        for x in (-w * 0.34, w * 0.34):
            for side in (-1, 1):
                parts.append(rod([x, 0, side * d * 0.42], [x, h - 0.04, -side * d * 0.12], 0.035))
            parts.append(block(0.07, 0.05, d * 0.8, x, h - 0.1))
        return [*parts, block(w * 0.68, 0.06, 0.04, y=h * 0.45)]
    parts = [slab(oval(w, d, 32, 5.0), 0.05, h - 0.05)]
    return parts + [soft_block(0.09, h - 0.04, d * 0.6, x, radius=0.03) for x in (-w / 3, w / 3)]


def _side(w: float, h: float, d: float, style: int) -> Parts:
    kind = style % 5
    if kind == 0:
        foot = 0.36 * min(w, d)
        parts = [slab(oval(w, d), 0.03, h - 0.03)]
        return [*parts, lathe([(foot, 0), (foot * 0.9, 0.025), (0.025, 0.04), (0.025, h - 0.02)])]
    if kind == 1:
        shelf = block(w * 0.9, 0.02, d * 0.9, y=h * 0.3)
        return [block(w, 0.03, d, y=h - 0.03), shelf, *square_legs(w, d, h - 0.02, 0.035)]
    if kind == 2:
        tripod = []
        for turn in np.arange(3) * 2 * np.pi / 3:
            x, z = 0.42 * w * np.sin(turn), 0.42 * d * np.cos(turn)
            tripod.append(rod([x, 0, z], [-x * 0.3, h - 0.02, -z * 0.3], 0.014, 0.02))
        return [slab(oval(w, d), 0.035, h - 0.035), *tripod]
    if kind == 3:
        drawer = block(w * 0.8, 0.1, 0.02, y=h - 0.16, z=d / 2 - 0.02)
        body = block(w * 0.94, 0.14, d * 0.92, y=h - 0.17)
        knob = ball(0.016, 0, h - 0.125, d / 2, 5)
        return [block(w, 0.03, d, y=h - 0.03), body, drawer, knob, *four_legs(w, d, h - 0.15)]
    barrel = [(0.36, 0), (0.4, h * 0.04), (0.3, h * 0.5), (0.4, h * 0.93)]
    parts = [lathe([(r * min(w, d), y) for r, y in barrel])]
    return [*parts, slab(oval(w, d), 0.04, h - 0.04)]


def coffee_table(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A low table: slab and legs, with a shelf, round, nested, drum, or with drawers."""
    kind = style % 6
    if kind == 0:
        shelf = block(w * 0.9, 0.025, d * 0.88, y=h * 0.3)
        return [soft_block(w, 0.045, d, y=h - 0.045, radius=0.02), shelf,
                *square_legs(w * 0.96, d * 0.96, h - 0.03, 0.05)]  # fmt: skip
    if kind == 1:
        return [
            slab(oval(w, d, 28), 0.04, h - 0.04),
            *four_legs(w * 0.8, d * 0.8, h - 0.02, 0.02, 0.05),
        ]
    if kind == 2:
        ends = [block(0.05, h - 0.03, d * 0.95, x) for x in (-w / 2 + 0.06, w / 2 - 0.06)]
        return [block(w, 0.05, d, y=h - 0.05), *ends, block(w * 0.9, 0.03, d * 0.7, y=0.1)]
    if kind == 3:  # a low one slides under a high one
        high = [slab(oval(w * 0.62, d * 0.95, 24), 0.035, h - 0.035)]
        high += [disc(0.018, h - 0.02, x, 0, z, 8) for x, z in _triangle(w * 0.2, d * 0.3)]
        low = [slab(oval(w * 0.55, d * 0.8, 24), 0.03, h * 0.68)]
        low += [disc(0.016, h * 0.7, x, 0, z, 8) for x, z in _triangle(w * 0.18, d * 0.25)]
        for part in high:
            part.apply_translation([-w * 0.19, 0, -d * 0.02])
        for part in low:
            part.apply_translation([w * 0.22, 0, d * 0.1])
        return high + low
    if kind == 4:
        drum = slab(oval(w * 0.7, d * 0.7, 24), h * 0.9)
        return [drum, slab(oval(w, d, 28), h * 0.14, h * 0.86), slab(oval(w * 0.8, d * 0.8), 0.03)]
    parts = [block(w * 0.96, h - 0.14, d * 0.92, y=0.1), soft_block(w, 0.05, d, y=h - 0.05)]
    for x in (-w / 4, w / 4):
        parts.append(block(w * 0.44, h - 0.2, 0.02, x, 0.13, d * 0.46))
        parts.append(ball(0.018, x, h / 2, d * 0.47 + 0.01, 5))
    return parts + square_legs(w * 0.92, d * 0.85, 0.12, 0.05)


def _triangle(x: float, z: float) -> list[tuple[float, float]]:
    return [(-x, z * 0.6), (x, z * 0.6), (0.0, -z)]


def _drawers(w: float, h: float, d: float, x: float, y: float, count: int) -> Parts:
    """A pedestal whose fronts at +z show `count` drawers."""
    parts = [block(w, h, d, x, y)]
    each = h / count
    for k in range(count):
        bottom = y + k * each
        parts.append(block(w * 0.92, each * 0.88, 0.02, x, bottom + each * 0.06, d / 2 + 0.01))
        parts.append(block(w * 0.3, 0.015, 0.02, x, bottom + each * 0.5, d / 2 + 0.03))
    return parts


def desk(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A desk with a pedestal or two, on trestles, or on legs; a hutch on the tall ones."""
    top = min(h, 0.76)
    kind = style % 4
    parts = [block(w, 0.04, d, y=top - 0.04)]
    if kind == 0:
        parts += _drawers(0.26 * w, top - 0.08, d * 0.9, w * 0.35, 0.04, 3)
        parts += [block(0.04, top - 0.02, d * 0.92, -w / 2 + 0.04)]
        parts += [block(w * 0.9, 0.3, 0.02, 0, top - 0.32, -d * 0.42)]
    elif kind == 1:
        for x in (-w * 0.36, w * 0.36):
            parts += _drawers(0.24 * w, top - 0.08, d * 0.88, x, 0.04, 3)
        parts.append(block(w * 0.6, 0.09, d * 0.8, 0, top - 0.12))
    elif kind == 2:
        for x in (-w * 0.4, w * 0.4):
            for side in (-1, 1):
                parts.append(rod([x, 0, side * d * 0.45], [x, top - 0.02, side * d * 0.1], 0.025))
            parts.append(block(0.03, 0.03, d * 0.5, x, top * 0.35))
    else:
        parts += _drawers(w * 0.9, 0.11, d * 0.85, 0.0, top - 0.15, 1)
        parts += four_legs(w * 0.96, d * 0.92, top - 0.04, 0.028, 0.02)
    if h > top + 0.08:  # a hutch: a shelf on three uprights
        rise = h - top
        parts += [block(0.025, rise, 0.22, x, top, -d / 2 + 0.11) for x in (-w * 0.49, 0, w * 0.49)]
        parts.append(block(w, 0.025, 0.24, 0, h - 0.025, -d / 2 + 0.12))
    return parts


def dressing_table(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A table with drawers and a mirror behind: round, arched, or square in a frame."""
    top = min(0.76, 0.72 * h)
    kind = style % 3
    parts = [soft_block(w, 0.035, d, y=top - 0.035, radius=0.015)]
    if kind == 1:
        for x in (-w * 0.36, w * 0.36):
            parts += _drawers(0.24 * w, top * 0.55, d * 0.85, x, top * 0.4, 2)
    else:
        parts += _drawers(w * 0.92, 0.13, d * 0.85, 0.0, top - 0.16, 1)
    parts += four_legs(w * 0.96, d * 0.94, top - 0.02, 0.024, 0.0 if kind == 1 else 0.03)
    rise, z = h - top, -d / 2 + 0.04
    wide = min(0.62 * w, max(0.85 * rise, 0.3))
    if kind == 0:
        turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        circle = np.stack([np.cos(turn) * wide / 2, np.sin(turn) * rise * 0.47], axis=1)
        middle = np.array([0, h - rise * 0.47])
        parts += [panel(circle + middle, 0.025, z), panel(circle * 0.88 + middle, 0.012, z + 0.016)]
        return [*parts, block(0.05, rise * 0.3, 0.03, y=top, z=z)]
    if kind == 1:
        outline = np.array(
            [[1, 0], [1, 0.7], [0.6, 0.95], [0, 1], [-0.6, 0.95], [-1, 0.7], [-1, 0]]
        )
        shape = outline * [wide / 2, rise] + [0, top]
        inner = outline * [wide / 2 - 0.03, rise - 0.06] + [0, top + 0.03]
        return [*parts, panel(shape, 0.03, z), panel(inner, 0.012, z + 0.02)]
    parts += [block(wide, rise * 0.9, 0.025, 0, top + rise * 0.1, z)]
    parts += [block(wide - 0.06, rise * 0.9 - 0.06, 0.012, 0, top + rise * 0.1 + 0.03, z + 0.016)]
    for side in (-1, 1):  # two posts hold it
        parts.append(block(0.025, rise * 0.7, 0.03, side * (wide / 2 + 0.02), top, z))
    return parts
