"""Places of objects: they turn with the room, are likely where they are drawn, and density is 1."""

import pytest
import torch
from torch.testing import assert_close

from sceneprior.core.boxes import QUARTERS, turn_boxes
from sceneprior.lifted.prototypes import POSES, PosedRooms, turn_posed
from sceneprior.lifted.sampler import placement as module
from sceneprior.lifted.sampler.frames import (
    BESIDE_M,
    mirror_images,
    turn_places,
    turn_rectangles,
)
from sceneprior.lifted.sampler.placement import Placement, Places

CLASSES, LOOKS = 4, 3 * POSES


@pytest.fixture
def placement() -> Placement:
    """With every weight random, tables too."""
    torch.manual_seed(0)
    placement = Placement(CLASSES, 0.0).double()
    with torch.no_grad():
        for value in placement.parameters():
            value += 0.1 * torch.randn_like(value)
    return placement


def rooms_with(boxes_m: torch.Tensor, looks: torch.Tensor) -> PosedRooms:
    """Rooms with two objects, the last one with one."""
    is_object = torch.ones_like(looks, dtype=torch.bool)
    is_object[-1, -1] = False
    return PosedRooms(
        torch.arange(1, 3).expand_as(looks) * is_object, is_object, boxes_m, looks=looks
    )


def distribution(placement: Placement, rooms: PosedRooms, look, size_m, rectangle_m) -> Places:
    shown = torch.rand(LOOKS, 67, generator=torch.Generator().manual_seed(1)).double()
    label, counts = torch.ones_like(look), torch.ones(len(look), 2 * CLASSES).double()
    return placement(
        label, look, size_m, torch.full_like(size_m[:, 0], 0.1), rectangle_m, rooms, counts, shown,
        torch.tensor([0, 1, 3]),
    )  # fmt: skip


@pytest.fixture
def given():
    rng = torch.Generator().manual_seed(7)
    boxes_m = torch.rand(3, 2, 6, generator=rng).double()
    looks = torch.randint(LOOKS, (3, 2), generator=rng)
    size_m = 0.2 + torch.rand(3, 3, generator=rng).double()
    rectangle_m = torch.tensor([0.2, -0.3, 4.0, 3.0]).double().expand(3, -1)
    return rooms_with(boxes_m, looks), torch.tensor([0, 9, 22]), size_m, rectangle_m


@pytest.mark.parametrize("quarters", range(QUARTERS))
def test_places_turn_with_the_room(placement, given, quarters):
    rooms, look, size_m, rectangle_m = given
    by, no = torch.full((3,), quarters), torch.zeros(3, dtype=torch.bool)
    place_m = torch.tensor([[0.5, 0.1], [1.0, -1.0], [-1.5, 0.7]]).double()
    plain = distribution(placement, rooms, look, size_m, rectangle_m).log_prob(place_m)
    assert rooms.looks is not None
    turned = PosedRooms(
        rooms.object_class, rooms.is_object, turn_boxes(rooms.boxes_m, by),
        looks=turn_posed(rooms.looks, by, no),
    )  # fmt: skip
    there = distribution(
        placement, turned, turn_posed(look[:, None], by, no)[:, 0],
        size_m.flip(-1) if quarters % 2 else size_m, turn_rectangles(rectangle_m, by),
    )  # fmt: skip
    assert_close(there.log_prob(turn_places(place_m, by)), plain, rtol=0, atol=1e-12)


@pytest.mark.parametrize("axis", ["x", "z"])
def test_anchors_are_midway_between_objects_and_sides_where_it_fits(placement, given, axis):
    """In a frame turned by no quarter: the look's back is at low z."""
    rooms, _, size_m, rectangle_m = given
    size_m, rectangle_m = size_m * 0 + 1.0, rectangle_m + torch.tensor([0, 0, 0, 0.5]).double()
    calls = []
    score = placement.along_x if axis == "x" else placement.along_z
    with score.register_forward_hook(lambda _, given, found: calls.append(given)):
        places = distribution(placement, rooms, torch.zeros(3).long(), size_m, rectangle_m)
        places.log_prob(torch.zeros(3, 2).double())
    anchors, at = calls[0][1], "xz".index(axis)
    low, high = (
        (rectangle_m[0, at] + sign * rectangle_m[0, 2 + at] / 2).item() for sign in (-1, 1)
    )
    for room, item in ((0, 0), (0, 1), (1, 0), (2, 0), (2, 1)):
        centre, extent = rooms.boxes_m[room, item, [2 * at, 3 + 2 * at]].tolist()
        first, last = centre - extent / 2, centre + extent / 2
        for kind, middle, free in (
            (15, (low + first) / 2, first - low), (16, (last + high) / 2, high - last)
        ):  # fmt: skip
            column = int((anchors.kind == kind).nonzero()[item])
            assert anchors.at_m[room, column].item() == pytest.approx(middle)
            there = bool(rooms.is_object[room, item]) and free >= 1
            assert bool(anchors.exists[room, column]) == there
    midway = anchors.exists[:, (anchors.kind == 15) | (anchors.kind == 16)]
    assert midway.any() and not midway.all()


def log_probs(one: Places, places_m: torch.Tensor) -> torch.Tensor:
    """Log-densities of many places in one room, in parts that need little memory."""
    with torch.no_grad():
        parts = [
            one.rows(torch.zeros(len(part), dtype=torch.int64)).log_prob(part)
            for part in places_m.split(500)
        ]
    return torch.cat(parts)


@pytest.mark.parametrize("axis", ["x", "z"])
def test_scores_are_those_of_plain_layers_on_joined_features(placement, given, axis):
    """Features joined into one tensor, and padding struck from the sum at the end."""
    score = placement.along_x if axis == "x" else placement.along_z
    calls = []

    def watched(_, given, found):
        calls.append((*given, found))

    places = distribution(placement, *given)
    assert places.has_image.any(), "so that images are among the features"
    with score.register_forward_hook(watched):
        places.log_prob(torch.rand(3, 2).double())
    (places, anchors, relations, sides, found), real = calls[0], places.is_object[:, None, :, None]
    number = anchors.at_m.shape[1]
    joined = torch.cat([part.expand(-1, number, -1, -1) for part in relations], dim=-1)
    met = score.own(places.own).unsqueeze(1) + score.there(places.there)
    pooled = (torch.relu(score.relation(joined) + met.unsqueeze(1)) * real).sum(dim=2) / 2
    hidden = score.pooled(pooled) + score.sides(sides) + score.anchor(anchors.kind)
    hidden = hidden + score.anchor_own(places.own).unsqueeze(1)
    logit, shift, _ = score.out(torch.relu(hidden)).unbind(dim=-1)
    pairs = score.pair_table[places.label[:, None], places.object_class].unsqueeze(1)
    logit = logit + (joined * pairs * real).sum(dim=(2, 3))
    logit = logit + (sides * score.side_table[places.label].unsqueeze(1)).sum(dim=-1)
    logit = logit + score.anchor_table[places.label][:, anchors.kind]
    assert_close(found.weight_logits, logit.masked_fill(~anchors.exists, -torch.inf))
    assert_close(found.means[..., 0], anchors.at_m + 0.3 * shift)
    assert not real.all()


def test_density_integrates_to_one(placement, given):
    rooms, look, size_m, rectangle_m = given
    one = distribution(placement, rooms, look, size_m, rectangle_m).rows(torch.tensor([0]))
    step = 0.04
    axis = torch.arange(-5, 5, step).double()
    total = float(log_probs(one, torch.cartesian_prod(axis, axis)).exp().sum()) * step**2
    assert total == pytest.approx(1, abs=0.01)


def test_draws_follow_the_density(placement, given, monkeypatch):
    """The mean log-density of draws is that of the density itself: its negative entropy."""
    monkeypatch.setattr(module, "DENSER", 1)
    rooms, look, size_m, rectangle_m = given
    one = distribution(placement, rooms, look, size_m, rectangle_m).rows(torch.tensor([1]))
    uniform = torch.rand(8000, 4, generator=torch.Generator().manual_seed(3)).double()
    many = one.rows(torch.zeros(500, dtype=torch.int64))
    with torch.no_grad():
        drawn_m = torch.cat([
            many.draw(many.draw_x(part[:, None, None, :2], 1)[:, 0], part[:, None, 2:], False)
            for part in uniform.split(500)
        ])  # fmt: skip
    drawn = log_probs(one, drawn_m)
    axis = torch.arange(-5, 5, 0.05).double()
    density = log_probs(one, torch.cartesian_prod(axis, axis))
    wanted = float((density.exp() * density).sum()) * 0.05**2
    assert float(drawn.mean()) == pytest.approx(
        wanted, abs=4 * float(drawn.std()) / len(drawn) ** 0.5 + 0.02
    )


def test_images_are_those_found_object_by_object():
    rng = torch.Generator().manual_seed(0)
    boxes_m = torch.rand(240, 5, 6, generator=rng).double()
    boxes_m[..., [0, 2]] *= 2
    is_object = torch.arange(5) < torch.randint(2, 6, (240, 1), generator=rng)
    labels = torch.randint(1, 4, (240, 5), generator=rng) * is_object
    backs = torch.randint(QUARTERS, (240, 5), generator=rng)
    label = torch.ones(240, dtype=torch.int64)
    images_m, has_image = mirror_images(PosedRooms(labels, is_object, boxes_m), label, backs)
    for room in range(240):
        own = [
            (boxes_m[room, k, :3].numpy(), boxes_m[room, k, 3:].numpy(), int(labels[room, k]))
            for k in range(int(is_object[room].sum()))
        ]
        twins = [k for k, (*_, kind) in enumerate(own) if kind == 1]
        for k in range(5):
            found = _image(own, k, twins, int(backs[room, k])) if k in twins else None
            assert bool(has_image[room, k]) == (found is not None)
            if found is not None:
                assert_close(images_m[room, k].tolist(), found)
    assert has_image.any()
    assert not has_image[labels == 1].all()


def _image(own, k, twins, back):
    """The mirror image of object `k` whose back is at low z, by its definition."""
    centre, extents, _ = own[k]
    best = None
    for other, size, kind in own:
        apart = abs(other - centre) - (size + extents) / 2
        smaller = extents[0] * extents[2] < size[0] * size[2]
        if kind != 1 and smaller and apart[1] < 0:
            gap = max(apart[0], apart[2])
            if best is None or gap < best[0]:
                best = gap, other
    if best is None or best[0] >= BESIDE_M or back % 2:
        return None
    image, axis = centre.copy(), back  # 0 and 2 are x and z, too
    image[axis] = 2 * best[1][axis] - centre[axis]
    for twin in twins:
        away = abs(own[twin][0] - image)
        if (away[0] < own[twin][1][0] / 2) and (away[2] < own[twin][1][2] / 2):
            return None
    return [image[0], image[2]]


def test_the_next_chair_stands_beside_the_first_and_opposite_to_it():
    table, chair = [0, 0.4, 0, 1.6, 0.8, 0.9], [0.4, 0.4, -0.65, 0.5, 0.8, 0.4]
    labels = torch.tensor([[1, 2]]).repeat(3, 1)
    rooms = PosedRooms(labels, labels > 0, torch.tensor([[table, chair]]).repeat(3, 1, 1).double())
    backs = torch.tensor([[0, 0], [0, 2], [0, 1]])
    images_m, has_image = mirror_images(rooms, torch.full((3,), 2), backs)
    assert has_image.tolist() == [[False, True], [False, True], [False, False]]
    assert_close(images_m[:2, 1].tolist(), [[-0.4, -0.65], [0.4, 0.65]])
