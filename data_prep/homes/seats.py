"""Chairs, armchairs, stools: a size and a style in, closed parts out; who sits looks to +z."""

import numpy as np

from data_prep.homes.solids import (
    Parts,
    arch,
    ball,
    block,
    disc,
    lathe,
    oval,
    panel,
    ribbon,
    rod,
    slab,
    soft_block,
    tilted,
    tube,
)


def four_legs(w: float, d: float, top: float, radius: float = 0.018, splay: float = 0.03) -> Parts:
    """Four tapering legs under a w x d seat; `splay` spreads their feet in metres."""
    inset = radius + 0.02
    parts = []
    for sx in (-1, 1):
        for sz in (-1, 1):
            x, z = sx * (w / 2 - inset - splay), sz * (d / 2 - inset - splay)
            foot = [x + sx * splay, 0, z + sz * splay]
            parts.append(rod(foot, [x, top, z], radius * 0.7, radius))
    return parts


def chair(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A dining or office chair in one of six makes; wide ones get arm rests."""
    seat = min(0.46, 0.56 * h)
    kind = style % 6
    if kind == 5:
        parts = [*_star_base(min(w, d), seat), soft_block(w * 0.84, 0.08, d * 0.8, y=seat - 0.04)]
        back = soft_block(w * 0.74, h - seat - 0.12, 0.06, y=seat + 0.12, z=-d * 0.4, radius=0.025)
        parts += [back, block(0.06, 0.25, 0.03, y=seat - 0.03, z=-d * 0.43)]
    elif kind == 3:  # a moulded shell on rods
        parts = [*four_legs(w * 0.9, d * 0.9, seat, 0.014, 0.06), _shell(w, h, d, seat)]
        parts.append(slab(oval(w * 0.96, d * 0.94, 20, 2.6), 0.04, seat - 0.03))
    else:
        parts = four_legs(w, d, seat, 0.022, 0.0 if kind in (0, 2) else 0.03)
        parts.append(soft_block(w, 0.06, d * 0.96, y=seat - 0.04, radius=0.025))
        parts += _chair_back(w, h, d, seat, kind)
    if w > 0.68 and kind != 3:
        parts += _arm_rests(w, d, seat)
    return parts


def _chair_back(w: float, h: float, d: float, seat: float, kind: int) -> Parts:
    z = -d / 2 + 0.03
    posts = [
        rod([x, seat - 0.03, z], [x, h, z - 0.02], 0.02) for x in (-w / 2 + 0.03, w / 2 - 0.03)
    ]
    if kind == 0:  # ladder back
        levels = np.linspace(seat + 0.12, h - 0.08, 3)
        return posts + [block(w - 0.06, 0.06, 0.02, y=y, z=z - 0.01) for y in levels]
    if kind == 1:  # one upholstered panel
        return [soft_block(w * 0.92, h - seat, 0.07, y=seat, z=z, radius=0.03)]
    if kind == 2:  # upright bars under a top rail
        bars = np.linspace(-w / 2 + 0.1, w / 2 - 0.1, 5)
        rails = [block(w, 0.07, 0.03, y=h - 0.07, z=z - 0.02)]
        return posts + rails + [rod([x, seat, z], [x, h - 0.03, z - 0.02], 0.009) for x in bars]
    hoop = np.linspace(0, np.pi, 13)  # a bent hoop with spokes
    points = np.stack(
        [
            (w / 2 - 0.03) * np.cos(hoop),
            seat + (h - seat - 0.02) * np.sin(hoop) ** 0.6,
            np.full(13, z),
        ],
        axis=1,
    )
    spokes = [rod([x, seat, z], [x, h - 0.04, z], 0.008) for x in (-w / 6, 0.0, w / 6)]
    return [tube(points, 0.02, 6), *spokes]


def _shell(w: float, h: float, d: float, seat: float):
    turn = np.linspace(np.pi * 0.98, 2.02 * np.pi, 13)
    path = np.stack([w * 0.48 * np.cos(turn), d * 0.46 * np.sin(turn)], axis=1)
    top = seat + 0.1 + (h - seat - 0.1) * np.clip(-np.sin(turn), 0, 1) ** 1.5
    return ribbon(path, seat - 0.03, top, 0.03)


def _star_base(w: float, seat: float) -> Parts:
    parts = [disc(0.03, seat - 0.1, y=0.08, segments=10)]
    for turn in np.arange(5) * 2 * np.pi / 5:
        x, z = w * 0.42 * np.sin(turn), w * 0.42 * np.cos(turn)
        parts += [rod([0, 0.11, 0], [x, 0.07, z], 0.025, 0.018), ball(0.03, x, 0, z, 5)]
    return parts


def _arm_rests(w: float, d: float, seat: float) -> Parts:
    parts = []
    for x in (-w / 2 + 0.03, w / 2 - 0.03):
        parts.append(block(0.05, 0.04, d * 0.75, x, seat + 0.2, -d * 0.08))
        parts.append(rod([x, seat - 0.04, d * 0.22], [x, seat + 0.21, d * 0.22], 0.018))
    return parts


def armchair(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """Boxy, barrel-shaped, on a wooden frame, or winged; all with two arms."""
    seat, kind = min(0.42, 0.52 * h), style % 4
    arm = max(0.09, 0.14 * w)
    inner = w - 2 * arm
    if kind == 1:
        turn = np.linspace(0.72 * np.pi, 2.28 * np.pi, 17)
        path = np.stack([(w / 2 - 0.05) * np.cos(turn), (d / 2 - 0.05) * np.sin(turn)], axis=1)
        lean = np.clip((1 - np.sin(turn)) / 2, 0, 1)
        back = ribbon(path, 0.1, seat + 0.12 + (h - seat - 0.12) * lean, 0.1)
        cushion = slab(oval(w * 0.86, d * 0.9, 20), seat - 0.14, 0.12)
        parts = [back, cushion, slab(oval(w * 0.78, d * 0.82, 20), 0.07, seat - 0.03)]
        return parts + four_legs(w * 0.8, d * 0.8, 0.14, 0.025, 0.0)
    if kind == 2:
        parts = [
            tilted(
                soft_block(inner, 0.14, d * 0.8, y=seat - 0.12, z=0.04, radius=0.04),
                0.06, [1, 0, 0], [0, seat, 0],
            ),
            tilted(
                soft_block(inner, h - seat, 0.13, y=seat, z=-d / 2 + 0.14, radius=0.05),
                -0.12, [1, 0, 0], [0, seat, -d / 2 + 0.14],
            ),
        ]  # fmt: skip
        for x in (-w / 2 + 0.03, w / 2 - 0.03):
            parts += [rod([x, 0, d * 0.4], [x, seat + 0.2, d * 0.36], 0.022)]
            parts += [rod([x, 0, -d * 0.45], [x, seat + 0.2, -d * 0.35], 0.022)]
            parts += [
                block(0.06, 0.035, d * 0.9, x, seat + 0.18),
                block(0.03, 0.05, d * 0.7, x, 0.22),
            ]
        return [*parts, block(w - 0.06, 0.04, 0.04, 0, 0.24, d * 0.33)]
    parts = [soft_block(w * 0.98, seat - 0.22, d * 0.96, y=0.1, radius=0.03)]
    parts.append(soft_block(inner, 0.16, d * 0.8, y=seat - 0.15, z=d * 0.1, radius=0.06, steps=3))
    parts.append(
        soft_block(inner + 0.04, h - 0.2, 0.2, y=0.2, z=-d / 2 + 0.1, radius=0.08, steps=3)
    )
    for side in (-1, 1):
        x = side * (w / 2 - arm / 2)
        parts.append(soft_block(arm, seat + 0.08, d * 0.96, x, 0.1, radius=0.045, steps=3))
        if kind == 3:
            wing = soft_block(arm * 0.8, h - seat - 0.22, d * 0.4, x, seat + 0.12, -d * 0.28, 0.03)
            parts.append(wing)
    return parts + four_legs(w * 0.95, d * 0.92, 0.12, 0.025, 0.0)


def dressing_chair(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A small padded seat with a low back: round, square, or a hoop on a skirt."""
    kind, seat = style % 4, min(0.46, 0.62 * h)
    if kind == 0:
        turn = np.linspace(1.05 * np.pi, 1.95 * np.pi, 11)
        path = np.stack([w * 0.46 * np.cos(turn), d * 0.46 * np.sin(turn)], axis=1)
        parts = [ribbon(path, seat - 0.02, seat + (h - seat) * np.sin(turn - np.pi) ** 0.5, 0.05)]
        parts.append(slab(oval(w, d, 20), 0.1, seat - 0.1))
        return parts + four_legs(w * 0.8, d * 0.8, seat - 0.08, 0.02, 0.05)
    if kind == 1:
        parts = [soft_block(w, 0.1, d, y=seat - 0.1, radius=0.04, steps=3)]
        parts.append(panel(arch(w * 0.9, h - seat, 0.4 * (h - seat), 11), 0.05, -d / 2 + 0.03))
        parts[-1].apply_translation([0, seat - 0.02, 0])
        return parts + four_legs(w, d, seat - 0.08, 0.02, 0.0)
    if kind == 2:
        parts = [lathe([(0.46 * w, 0), (0.42 * w, seat * 0.5), (0.48 * w, seat - 0.06)])]
        parts.append(lathe([(0.49 * w, seat - 0.06), (0.5 * w, seat - 0.03), (0.45 * w, seat)]))
        return [*parts, soft_block(w * 0.7, h - seat, 0.07, y=seat - 0.02, z=-w * 0.4, radius=0.03)]
    parts = [*_star_base(min(w, d), seat), disc(min(w, d) * 0.47, 0.08, y=seat - 0.06)]
    parts.append(block(0.05, h - seat - 0.05, 0.02, y=seat - 0.04, z=-d * 0.42))
    return [*parts, soft_block(w * 0.75, (h - seat) * 0.6, 0.06, y=h * 0.75, z=-d * 0.42)]


def stool(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A bench where it is long, else a pouf, a padded cube, a wooden stool or a hassock."""
    kind = style % 4
    if w > 0.85:
        parts = [soft_block(w, 0.14, d, y=h - 0.14, radius=0.05, steps=3)]
        if style % 2:
            parts += [block(0.05, h - 0.1, d * 0.9, x) for x in (-w / 2 + 0.06, w / 2 - 0.06)]
            return [*parts, block(w * 0.9, 0.03, d * 0.8, y=0.12)]
        return [*parts, block(w * 0.96, 0.05, d * 0.92, y=h - 0.17), *four_legs(w, d, h - 0.14)]
    if kind == 0:
        return [
            slab(oval(w * 0.96, d * 0.96), h * 0.75, 0.03),
            slab(oval(w, d), 0.16 * h, h * 0.76),
            slab(oval(w * 0.9, d * 0.9), 0.08 * h, h * 0.92),
            slab(oval(w * 0.85, d * 0.85), 0.03),
        ]
    if kind == 1:
        body = soft_block(w, h * 0.72, d, y=0.06, radius=0.03)
        lid = soft_block(w * 1.02, h * 0.2, d * 1.02, y=h * 0.8, radius=0.04, steps=3)
        return [body, lid, *four_legs(w, d, 0.1, 0.025, 0.0)]
    if kind == 2:
        parts = [
            slab(oval(w, d), 0.05, h - 0.05),
            *four_legs(w * 0.85, d * 0.85, h - 0.04, 0.02, 0.05),
        ]
        bar = 0.35 * min(w, d)
        return [*parts, rod([-bar, h * 0.4, 0], [bar, h * 0.4, 0], 0.012),
                rod([0, h * 0.4, -bar], [0, h * 0.4, bar], 0.012)]  # fmt: skip
    parts = [soft_block(w, h * 0.35, d, y=h * 0.65, radius=0.06, steps=3)]
    return parts + four_legs(w * 0.95, d * 0.95, h * 0.7, 0.022, 0.02)
