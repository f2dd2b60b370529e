"""Sofas, straight and L-shaped: a size and a style in, closed parts out; they look to +z."""

import numpy as np

from data_prep.homes.seats import four_legs
from data_prep.homes.solids import Parts, block, disc, soft_block, tilted

DEEP_M = 1.3
"""A sofa this deep has a chaise: no seat for one row of people is deeper."""


def sofa(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """L-shaped where it is deep (the chaise left or right by style), else a row of seats."""
    if d > DEEP_M:
        return _l_shaped(w, h, d, style)
    return _row(w, h, d, style)


def _seat(w: float, h: float, d: float, x: float, z_back: float, seat: float, deep: float) -> Parts:
    """One seat cushion with the back cushion that leans behind it."""
    base = soft_block(w * 0.985, 0.17, deep, x, seat - 0.15, z_back + 0.2 + deep / 2, 0.05, 3)
    foot = [x, seat, z_back + 0.24]
    back = soft_block(w * 0.96, h - seat - 0.06, 0.16, x, seat, z_back + 0.24, 0.06, 3)
    return [base, tilted(back, -0.12, [1, 0, 0], foot)]


def _arm(width: float, h: float, d: float, x: float, z: float, style: int) -> Parts:
    if style % 3 == 1:  # rolled
        roll = disc(width * 0.55, d * 0.98, segments=16)
        tilted(roll, np.pi / 2, [1, 0, 0], [0, 0, 0])
        roll.apply_translation([x, h - width * 0.55, z - d * 0.49])
        return [block(width * 0.8, h - width * 0.5, d * 0.94, x, 0.08, z), roll]
    if style % 3 == 2:  # slim
        return [soft_block(width * 0.8, h - 0.02, d, x, 0.1, z, 0.02)]
    return [soft_block(width, h - 0.1, d, x, 0.1, z, 0.05, 3)]


def _row(w: float, h: float, d: float, style: int) -> Parts:
    seat = 0.43 * min(1.0, h / 0.78)
    arm = 0.2 if style % 3 else 0.16
    inner = w - 2 * arm
    count = 1 if style % 4 == 3 and w < 2.4 else max(2, round(inner / 0.72))
    back = -d / 2
    parts = [soft_block(w * 0.97, seat - 0.24, d * 0.94, y=0.1, radius=0.03)]
    parts.append(soft_block(inner + 0.06, h - 0.14, 0.2, y=0.1, z=back + 0.1, radius=0.06, steps=3))
    for x in -w / 2 + arm + (np.arange(count) + 0.5) * inner / count:
        parts += _seat(inner / count, h, d, x, back, seat, d - 0.24)
    for x in (-w / 2 + arm / 2, w / 2 - arm / 2):
        parts += _arm(arm, seat + 0.2, d * 0.97, x, 0.0, style)
    if style % 2:  # throw cushions
        for side in (-1, 1):
            at = (side * (inner / 2 - 0.22), seat + 0.02, back + 0.4)
            pad = soft_block(0.42, 0.36, 0.13, *at, radius=0.06)
            parts.append(tilted(pad, -0.25, [1, 0, 0], at))
    return parts + four_legs(w * 0.94, d * 0.9, 0.13, 0.025, 0.0)


def _l_shaped(w: float, h: float, d: float, style: int) -> Parts:
    seat, arm, row = 0.43 * min(1.0, h / 0.78), 0.18, min(0.95, 0.62 * d)
    side = 1 if style % 2 else -1
    chaise = min(max(0.8, 0.33 * w), 1.1)
    back = -d / 2
    x_chaise = side * (w / 2 - chaise / 2)
    parts = [
        soft_block(w, seat - 0.2, row, y=0.08, z=back + row / 2, radius=0.03),
        soft_block(chaise, seat - 0.2, d, x_chaise, 0.08, radius=0.03),
        soft_block(w, h - 0.12, 0.2, y=0.1, z=back + 0.1, radius=0.06, steps=3),
    ]
    parts += _seat(chaise - 0.04, h, d, x_chaise, back, seat, d - 0.24)
    parts += _arm(arm, seat + 0.18, row, -side * (w / 2 - arm / 2), back + row / 2, style)
    parts += _arm(arm * 0.7, seat + 0.16, row, side * (w / 2 - arm * 0.35), back + row / 2, 2)
    rest = w - chaise - arm
    count = max(1, round(rest / 0.75))
    left = -w / 2 + (arm if side > 0 else chaise)
    for x in left + (np.arange(count) + 0.5) * rest / count:
        parts += _seat(rest / count, h, d, x, back, seat, row - 0.22)
    feet = [(side * (w / 2 - 0.08), d / 2 - 0.08), (side * (w / 2 - chaise + 0.08), d / 2 - 0.08)]
    feet += [(-side * (w / 2 - 0.08), back + row - 0.08), (-side * (w / 2 - 0.08), back + 0.08)]
    return parts + [block(0.06, 0.1, 0.06, x, 0, z) for x, z in feet]
