"""Wardrobes, chests, shelves: a size and a style in, closed parts out; doors open to +z."""

import numpy as np

from data_prep.homes.solids import Parts, ball, block, panel, rod, soft_block
from data_prep.homes.tables import square_legs


def _door(w: float, h: float, x: float, y: float, z: float, handle_x: float) -> Parts:
    """A door leaf with a frame's shadow gap and a bar handle at `handle_x`."""
    leaf = block(w - 0.012, h - 0.012, 0.02, x, y + 0.006, z)
    bar = block(0.02, min(0.3, 0.3 * h), 0.03, handle_x, y + h * 0.42, z + 0.02)
    return [leaf, bar]


def _pair(w: float, h: float, x: float, y: float, z: float) -> Parts:
    """Two doors that open away from the middle at x."""
    return _door(w / 2, h, x - w / 4, y, z, x - 0.04) + _door(w / 2, h, x + w / 4, y, z, x + 0.04)


def _drawer_column(w: float, h: float, x: float, y: float, z: float, count: int) -> Parts:
    parts = []
    each = h / count
    for k in range(count):
        bottom = y + k * each
        parts.append(block(w - 0.012, each - 0.012, 0.02, x, bottom + 0.006, z))
        parts.append(block(min(0.16, w * 0.4), 0.018, 0.025, x, bottom + each * 0.6, z + 0.02))
    return parts


def _open_box(w: float, h: float, d: float, x: float, y: float, t: float = 0.025) -> Parts:
    """Two sides, top, bottom and back: the front stays open."""
    sides = [block(t, h, d, x + s * (w - t) / 2, y) for s in (-1, 1)]
    boards = [block(w - t, t, d, x, level) for level in (y, y + h - t)]
    return [*sides, *boards, block(w - t, h - t, t / 2, x, y + t / 2, -d / 2 + t / 4)]


def _books(w: float, h: float, d: float, x: float, y: float, rng: np.random.Generator) -> Parts:
    """Runs of books of unequal height from the left, one leaning; the rest stays empty."""
    parts, edge = [], x - w / 2 + 0.01
    limit = x + w / 2 - rng.uniform(0.05, 0.4) * w
    while edge < limit:
        run = min(rng.uniform(0.06, 0.18), x + w / 2 - 0.01 - edge)
        if run < 0.03:
            break
        tall, deep = h * rng.uniform(0.55, 0.9), d * rng.uniform(0.6, 0.85)
        parts.append(block(run * 0.96, tall, deep, edge + run / 2, y, -d * 0.04))
        edge += run
    return parts


def wardrobe(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """Hinged or sliding doors over a plinth; some with drawers below or an open side."""
    kind, body, front = style % 4, d - 0.05, d / 2 - 0.03
    open_side = 0.28 * w if kind == 3 and w > 1.4 else 0.0
    closed, x = w - open_side, -open_side / 2
    parts = [block(w * 0.98, 0.08, d - 0.1, z=-0.03)]
    parts += [block(closed, h - 0.1, body, x, 0.07, -0.025)]
    parts += [block(w, 0.04, d - 0.02, 0, h - 0.04, -0.01)]
    if kind == 1:  # sliding: one leaf runs before the other
        leaves = max(2, round(closed / 0.9))
        wide = closed / leaves
        for k in range(leaves):
            middle = x - closed / 2 + (k + 0.5) * wide
            z = front - 0.012 + 0.022 * (k % 2)
            parts.append(block(wide + 0.02, h - 0.16, 0.02, middle, 0.1, z))
            parts.append(block(0.035, 0.5, 0.014, middle - wide * 0.42, h * 0.4, z + 0.014))
    else:
        pairs = max(1, round(closed / 1.0))
        drawers = 0.45 if kind == 2 else 0.0
        for k in range(pairs):
            wide = closed / pairs
            middle = x - closed / 2 + (k + 0.5) * wide
            parts += _pair(wide, h - 0.16 - drawers, middle, 0.1 + drawers, front)
            if drawers:
                parts += _drawer_column(wide, drawers - 0.02, middle, 0.1, front, 2)
    if open_side:
        x = w / 2 - open_side / 2
        parts += _open_box(open_side, h - 0.1, d - 0.04, x, 0.07)
        for level in np.linspace(0.5, h - 0.5, 4):
            parts.append(block(open_side - 0.03, 0.02, d - 0.08, x, level))
    return parts


def cabinet(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A display cabinet where it is tall, else a sideboard, a chest of drawers, or both."""
    front, legs = d / 2 - 0.025, 0.14 if style % 2 and h < 1.3 else 0.06
    body = h - legs - 0.03
    parts = [block(w * 0.98, body, d - 0.05, 0, legs, -0.02), soft_block(w, 0.035, d, y=h - 0.035)]
    if legs > 0.1:
        parts += square_legs(w * 0.94, d * 0.85, legs + 0.01, 0.04)
    else:
        parts.append(block(w * 0.95, legs + 0.01, d * 0.88, z=-0.01))
    columns = max(1, round(w / 0.62))
    wide = w * 0.98 / columns
    for k in range(columns):
        x = (k + 0.5 - columns / 2) * wide
        kind = (style // 2 + k) % 3 if columns > 1 else style % 2
        if h > 1.4:
            lower = 0.4 * body
            parts += _pair(wide, lower, x, legs, front)
            parts += _door(wide, body - lower, x, legs + lower, front, x + wide * 0.4)
        elif kind == 0:
            parts += _pair(wide, body, x, legs, front)
        else:
            parts += _drawer_column(wide, body, x, legs, front, max(2, round(body / 0.24)))
    if h > 1.4:  # glazing bars
        for level in legs + np.linspace(0.55, 0.9, 3) * body:
            parts.append(block(w * 0.94, 0.02, 0.015, 0, level, front + 0.012))
    return parts


def children_cabinet(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """Doors at one side, open cubbies with toys at the other, under a flat or gabled top."""
    gable = 0.22 if style % 3 == 1 else 0.0
    tall, front = h - gable, d / 2 - 0.025
    share = 0.5 if style % 2 else 0.36
    closed = w * share
    side = -1 if style % 4 < 2 else 1
    x_doors, x_open = side * (w - closed) / 2, -side * closed / 2
    parts = [block(w * 0.98, 0.07, d * 0.9)]
    parts += [block(closed, tall - 0.06, d - 0.05, x_doors, 0.06, -0.02)]
    parts += _pair(closed, tall * 0.62, x_doors, 0.08 + tall * 0.32, front)
    parts += _drawer_column(closed, tall * 0.3, x_doors, 0.08, front, 2)
    space = w - closed
    parts += _open_box(space, tall - 0.06, d - 0.02, x_open, 0.06)
    rows, columns = max(2, round(tall / 0.42)), max(1, round(space / 0.45))
    cell, rise = space / columns, (tall - 0.06) / rows
    for k in range(1, columns):
        parts.append(block(0.02, tall - 0.08, d - 0.05, x_open - space / 2 + k * cell, 0.07))
    for row in range(rows):
        level = 0.06 + row * rise
        if row:
            parts.append(block(space - 0.03, 0.02, d - 0.05, x_open, level))
        for k in range(columns):
            x, what = x_open - space / 2 + (k + 0.5) * cell, rng.integers(3)
            if what == 0:
                parts.append(ball(min(cell, rise, d) * 0.3, x, level + 0.02, 0, 6))
            elif what == 1:
                parts.append(soft_block(cell * 0.7, rise * 0.55, d * 0.7, x, level + 0.02))
    if gable:
        parts.append(panel([[-w / 2, tall], [w / 2, tall], [0, h]], d))
    return parts


def nightstand(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A bedside chest: two drawers on legs, on a plinth, open below, or rounded."""
    kind, front = style % 4, d / 2 - 0.02
    if kind == 1:
        parts = [
            block(w * 0.96, 0.05, d * 0.85),
            block(w * 0.98, h - 0.08, d - 0.04, 0, 0.04, -0.02),
        ]
        parts += _drawer_column(w * 0.98, h - 0.09, 0, 0.05, front, 3 if h > 0.55 else 2)
        return [*parts, block(w, 0.03, d, y=h - 0.03)]
    legs = 0.14 if kind != 3 else 0.1
    if kind == 2:
        parts = _open_box(w, (h - legs) * 0.5, d - 0.02, 0, legs)
        parts += [block(w * 0.98, (h - legs) * 0.5, d - 0.04, 0, legs + (h - legs) * 0.5, -0.02)]
        parts += _drawer_column(w, (h - legs) * 0.46, 0, legs + (h - legs) * 0.5, front, 1)
        parts += [block(w * 0.6, 0.03, d * 0.6, 0, legs + 0.025 + 0.03 * k) for k in range(2)]
    else:
        parts = [soft_block(w, h - legs, d - 0.04, 0, legs, -0.02, 0.06 if kind == 3 else 0.015)]
        parts += _drawer_column(w * 0.88, h - legs - 0.06, 0, legs + 0.03, front, 2)
    parts += [
        rod(
            [sx * w * 0.44, 0, sz * d * 0.4],
            [sx * w * 0.4, legs + 0.02, sz * d * 0.34],
            0.012,
            0.02,
        )
        for sx in (-1, 1)
        for sz in (-1, 1)
    ]
    return parts


def tv_stand(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """A long low board: doors and drawers around an open middle."""
    kind, front = style % 4, d / 2 - 0.025
    legs = 0.13 if kind in (0, 2) else 0.05
    body, third = h - legs - 0.03, w * 0.98 / 3
    parts = [soft_block(w, 0.035, d, y=h - 0.035, radius=0.015)]
    for k, x in enumerate((-third, 0.0, third)):
        if k == 1 and kind != 3:
            parts += _open_box(third, body, d - 0.05, x, legs, 0.02)
            parts.append(block(third, 0.02, d - 0.08, x, legs + body / 2))
            parts.append(block(third * 0.6, 0.06, d * 0.5, x, legs + 0.02))  # a player
            continue
        parts.append(block(third, body, d - 0.05, x, legs, -0.02))
        if kind == 0 or (kind == 3 and k != 1):
            parts += _pair(third, body, x, legs, front)
        else:
            parts += _drawer_column(third, body, x, legs, front, 2)
    if legs > 0.1:
        parts += square_legs(w * 0.94, d * 0.85, legs + 0.01, 0.04)
        return [*parts, block(0.04, legs, d * 0.7)]
    return [*parts, block(w * 0.94, legs + 0.01, d * 0.85)]


def bookshelf(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """Boards between uprights, filled with books; doors below on some."""
    columns, rows = max(1, round(w / 0.75)), max(2, round(h / 0.38))
    doors = 1 if style % 3 == 1 and rows > 3 else 0
    parts = _open_box(w, h, d, 0, 0)
    cell, rise = (w - 0.03) / columns, (h - 0.03) / rows
    for k in range(1, columns):
        parts.append(block(0.022, h - 0.03, d - 0.01, (k - columns / 2) * cell, 0.01))
    for row in range(1, rows):
        parts.append(block(w - 0.03, 0.022, d - 0.01, 0, row * rise))
    for row in range(rows):
        for k in range(columns):
            x = (k + 0.5 - columns / 2) * cell
            if row < doors * 2:
                parts += _pair(cell, rise, x, row * rise + 0.01, d / 2)
            elif rng.random() < 0.8:
                parts += _books(cell - 0.04, rise - 0.05, d, x, row * rise + 0.02, rng)
    return parts


def shelf(w: float, h: float, d: float, style: int, rng: np.random.Generator) -> Parts:
    """An airy rack: boards on four posts, a ladder that leans, or boards on one spine."""
    kind, rows = style % 3, max(3, round(h / 0.36) + 1)
    levels = np.linspace(0.08, h - 0.03, rows)
    if kind == 0:
        parts = square_legs(w, d, h, 0.025)
        depths = np.full(rows, d)
    elif kind == 1:  # the boards get shallower towards the top of the ladder
        depths = np.linspace(d, 0.5 * d, rows)
        parts = []
        for x in (-w / 2 + 0.015, w / 2 - 0.015):
            parts.append(rod([x, 0, d / 2 - 0.02], [x, h, -d * 0.02], 0.015))
            parts.append(rod([x, 0, -d / 2 + 0.02], [x, h, -d / 2 + 0.02], 0.015))
    else:
        depths = np.full(rows, d)
        parts = [block(0.06, h, 0.03, x, 0, -d / 2 + 0.015) for x in (-w * 0.3, w * 0.3)]
        parts.append(block(w * 0.9, 0.04, d, y=0))
    for level, deep in zip(levels, depths, strict=True):
        parts.append(block(w, 0.024, deep, 0, level, -d / 2 + deep / 2))
    for k in range(rows - 1):
        middle, room = -d / 2 + depths[k] / 2, levels[k + 1] - levels[k] - 0.04
        if k % 2 == style % 2:
            books = _books(w * 0.6, room, depths[k], -w * 0.12, levels[k] + 0.022, rng)
            for book in books:
                book.apply_translation([0, 0, middle])
            parts += books
        else:
            pot = ball(
                min(0.1, room * 0.4, depths[k] * 0.35), w * 0.2, levels[k] + 0.022, middle, 6
            )
            parts.append(pot)
    return parts
