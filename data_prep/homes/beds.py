"""Beds: a size and a style in, closed parts out; the headboard is at -z, the foot at +z."""

import numpy as np

from data_prep.homes.solids import (
    Parts,
    arch,
    ball,
    block,
    disc,
    panel,
    rod,
    slab,
    soft_block,
    tilted,
)


def double_bed(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A double bed: two pillows, and a headboard in one of six shapes."""
    return _bed(w, h, d, style, rng, pillows=2)


def single_bed(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A single bed: one wide pillow, and a headboard in one of six shapes."""
    return _bed(w, h, d, style + 1, rng, pillows=1)


def _bed(w: float, h: float, d: float, style: int, rng: np.random.Generator, pillows: int) -> Parts:
    board = rng.uniform(0.05, 0.11)
    inner = w * rng.uniform(0.90, 0.97)
    parts = headboard(w, h, d, style, board)
    parts += bedding(inner, min(0.56, 0.62 * h), d - board, board / 2, pillows, rng)
    leg, foot = 0.1, d / 2 - 0.08
    parts.append(soft_block(w * 0.99, 0.2, d - board, y=leg, z=board / 2, radius=0.03))
    for x in (-w / 2 + 0.1, w / 2 - 0.1):
        parts += [block(0.07, leg, 0.07, x, 0, z) for z in (foot, -foot + 0.1)]
    if style % 6 in (2, 3):
        parts += footboard(w, min(0.62, 0.6 * h), d)
    return parts


def headboard(w: float, h: float, d: float, style: int, board: float) -> Parts:
    """Plain, arched, barred, posted, tufted or winged."""
    back = -d / 2 + board / 2
    kind = style % 6
    if kind == 0:
        return [soft_block(w, h - 0.08, board, y=0.08, z=back, radius=0.03)]
    if kind == 1:
        return [panel(arch(w, h, 0.72 * h, steps=15), board, back)]
    if kind == 2:  # two posts, a top rail and upright bars
        parts = [disc(0.035, h, x, 0, back, 10) for x in (-w / 2 + 0.035, w / 2 - 0.035)]
        parts += [block(w, 0.06, 0.05, y=level, z=back) for level in (h - 0.14, 0.35)]
        bars = np.linspace(-w / 2 + 0.15, w / 2 - 0.15, max(4, round(w / 0.2)))
        return parts + [rod([x, 0.35, back], [x, h - 0.1, back], 0.014) for x in bars]
    if kind == 3:  # a panel between posts with knobs
        parts = [block(0.09, h - 0.08, 0.09, x, 0, back) for x in (-w / 2 + 0.045, w / 2 - 0.045)]
        parts += [ball(0.05, x, h - 0.1, back, 6) for x in (-w / 2 + 0.045, w / 2 - 0.045)]
        return [*parts, panel(arch(w - 0.1, h - 0.06, 0.8 * h, steps=11), 0.04, back)]
    if kind == 4:  # upholstered columns
        count = max(3, round(w / 0.42))
        edges = np.linspace(-w / 2, w / 2, count + 1)
        width = w / count
        columns = [
            soft_block(width * 0.97, h - 0.35, board, x + width / 2, 0.35, back, 0.035)
            for x in edges[:-1]
        ]
        return [*columns, block(w, 0.4, board * 0.8, z=back)]
    wings = [
        soft_block(0.09, h * 0.92, 0.3, x, 0.06, -d / 2 + 0.15, 0.03)
        for x in (-w / 2 + 0.045, w / 2 - 0.045)
    ]
    return [soft_block(w - 0.1, h - 0.06, board, y=0.06, z=back, radius=0.04), *wings]


def footboard(w: float, h: float, d: float) -> Parts:
    """A low panel between two short posts."""
    z = d / 2 - 0.035
    parts = [block(0.08, h, 0.07, x, 0, z) for x in (-w / 2 + 0.04, w / 2 - 0.04)]
    return [*parts, block(w - 0.1, h * 0.75, 0.04, y=0.08, z=z)]


def bedding(
    w: float, top: float, d: float, z: float, pillows: int, rng: np.random.Generator
) -> Parts:
    """Mattress, blanket over its lower part, and pillows that lean on the headboard."""
    base = 0.28
    mattress = soft_block(w, top - base, d - 0.1, y=base, z=z, radius=0.06, steps=3)
    cover = (d - 0.1) * rng.uniform(0.55, 0.75)
    front = z + (d - 0.1) / 2
    blanket = soft_block(
        w + 0.04, top - base - 0.03, cover + 0.02, y=base + 0.07, z=front - cover / 2, radius=0.05
    )
    fold = soft_block(w + 0.05, 0.05, 0.22, y=top + 0.01, z=front - cover + 0.11, radius=0.02)
    parts = [mattress, blanket, fold]
    wide = min(0.72, 0.44 * w if pillows == 2 else 0.75 * w)
    for x in (-w / 4, w / 4) if pillows == 2 else (0.0,):
        at = (x, top - 0.01, z - (d - 0.1) / 2 + 0.25)
        pillow = soft_block(wide, 0.15, 0.42, *at, radius=0.07, steps=3)
        parts.append(tilted(pillow, -0.22, [1, 0, 0], at))
    return parts


def kids_bed(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A bunk bed where it is tall, else a bed with rails, a house frame or ears.

    Real ones are often wider than a mattress: what is left becomes stairs of drawers.
    """
    sleep = min(w, 1.35)
    aside = w - sleep
    x = -aside / 2
    if h > 1.65:
        parts = _bunk(sleep, h, d, rng) if style % 3 else _house(sleep, h, d, rng)
    elif style % 2:
        parts = _railed(sleep, h, d, rng)
    else:
        parts = _eared(sleep, h, d, rng)
    for part in parts:
        part.apply_translation([x, 0, 0])
    if aside > 0.25:
        parts += _stairs(aside - 0.02, min(h * 0.75, 1.3), d, w / 2 - aside / 2)
    return parts


def _posts(w: float, h: float, d: float) -> Parts:
    return [
        block(0.07, h, 0.07, x, 0, z)
        for x in (-w / 2 + 0.035, w / 2 - 0.035)
        for z in (-d / 2 + 0.035, d / 2 - 0.035)
    ]


def _rails(w: float, levels: tuple[float, ...], d: float, share: float = 1.0) -> Parts:
    """Guard rails: whole at the wall's side, `share` of the length at the other."""
    parts = []
    for level in levels:
        parts.append(block(0.03, 0.07, d, -w / 2 + 0.02, level))
        parts.append(block(0.03, 0.07, d * share, w / 2 - 0.02, level, -d * (1 - share) / 2))
        parts += [block(w, 0.07, 0.03, 0, level, z) for z in (-d / 2 + 0.02, d / 2 - 0.02)]
    return parts


def _lying(w: float, bottom: float, d: float, rng: np.random.Generator) -> Parts:
    parts = bedding(w - 0.1, 0.46, d - 0.04, 0.0, 1, rng)
    parts.append(block(w - 0.02, 0.12, d - 0.02, y=0.2))
    for part in parts:
        part.apply_translation([0, bottom - 0.2, 0])
    return parts


def _bunk(w: float, h: float, d: float, rng: np.random.Generator) -> Parts:
    upper = h - 0.62
    parts = _posts(w, h, d) + _lying(w, 0.22, d, rng) + _lying(w, upper, d, rng)
    parts += _rails(w, (h - 0.1, h - 0.25), d, share=0.72)
    side = w / 2 + 0.01
    parts += [rod([side, 0, z], [side, h - 0.05, z], 0.02) for z in (d / 2 - 0.45, d / 2 - 0.1)]
    steps = np.arange(0.28, h - 0.3, 0.28)
    return parts + [block(0.03, 0.04, 0.35, side, y, d / 2 - 0.275) for y in steps]


def _house(w: float, h: float, d: float, rng: np.random.Generator) -> Parts:
    eaves = h - min(0.45, w / 2)
    parts = _posts(w, eaves, d) + _lying(w, 0.2, d, rng) + _rails(w, (0.62,), d, share=0.6)
    for z in (-d / 2 + 0.035, d / 2 - 0.035):
        for x in (-w / 2 + 0.035, w / 2 - 0.035):
            parts.append(rod([x, eaves - 0.02, z], [0, h - 0.04, z], 0.04))
    parts.append(block(0.07, 0.07, d, y=h - 0.07))
    return parts + [block(0.06, 0.06, d, x, eaves - 0.06) for x in (-w / 2 + 0.035, w / 2 - 0.035)]


def _railed(w: float, h: float, d: float, rng: np.random.Generator) -> Parts:
    parts = _posts(w, h * 0.8, d) + _lying(w, 0.2, d, rng)
    parts += _rails(w, (h * 0.62, h * 0.74), d, share=0.6)
    bars = np.linspace(-d / 2 + 0.1, d / 2 - 0.1, 9)
    parts += [rod([-w / 2 + 0.02, 0.3, z], [-w / 2 + 0.02, h * 0.78, z], 0.014) for z in bars]
    return [*parts, panel(arch(w, h, h * 0.78, 11), 0.05, -d / 2 + 0.03)]


def _eared(w: float, h: float, d: float, rng: np.random.Generator) -> Parts:
    """A headboard like a bear's head and a low scalloped foot."""
    z = -d / 2 + 0.04
    ear = min(0.16, w / 6)
    parts = [*_lying(w, 0.2, d, rng), panel(arch(w * 0.9, h - ear * 0.6, h * 0.55, 15), 0.08, z)]
    turn = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    for x in (-w * 0.3, w * 0.3):
        outline = np.stack([x + ear * np.cos(turn), h - ear + ear * np.sin(turn)], axis=1)
        parts.append(panel(outline, 0.07, z))
    parts.append(panel(arch(w, min(0.7, 0.62 * h), 0.4, 11), 0.06, d / 2 - 0.03))
    return parts + _posts(w, 0.24, d)


def _stairs(w: float, h: float, d: float, x: float) -> Parts:
    """Drawers that climb towards the head; each step has a front with a knob."""
    count = 4
    run = d / count
    parts = []
    for step in range(count):
        rise = h * (count - step) / count
        z = -d / 2 + run * (step + 0.5)
        parts.append(block(w, rise, run, x, 0, z))
        parts.append(block(0.02, min(rise, 0.3) * 0.8, run * 0.85, x + w / 2 + 0.01, 0.04, z))
        parts.append(ball(0.02, x + w / 2 + 0.03, min(rise, 0.3) * 0.45, z, 4))
    edge = [[x - w / 2, -d / 2], [x - w / 2 + 0.03, -d / 2], [x - w / 2 + 0.03, d / 2]]
    return [*parts, slab([*edge, [x - w / 2, d / 2]], 0.12)]
