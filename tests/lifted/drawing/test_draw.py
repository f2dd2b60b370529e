"""Drawing by an untrained sampler of numbers alone: seeds, conditions, and what must not happen."""

import pytest
import torch
from rooms_of_boxes import sampler_rooms, small_sampler
from torch.testing import assert_close

from sceneprior.lifted.drawing import draw as module
from sceneprior.lifted.drawing.draw import SampledRooms, draw_rooms
from sceneprior.lifted.drawing.overlaps import INTERSECTING
from sceneprior.lifted.drawing.plans import BEYOND_M, PLAIN
from sceneprior.lifted.prototypes import POSES, PosedRooms
from sceneprior.lifted.requests.floors import Floor, read_floor
from sceneprior.lifted.requests.wishes import Conditions, CountWish, Wishes
from sceneprior.lifted.sampler.frames import gaps_m, rectangles_of, shared_extents

CLASSES = ("void", "sofa", "box", "lamp", "piano")

pytestmark = [
    pytest.mark.usefixtures("few_attempts"),
    pytest.mark.filterwarnings("ignore:The floor of"),
]


@pytest.fixture(scope="module")
def sampler():
    return small_sampler(sampler_rooms())


def drawn(sampler, count: int, seed: int, floor: str | None = None, **conditions) -> SampledRooms:
    own = None if floor is None else Floor(read_floor(floor))
    return draw_rooms(sampler, Conditions(CLASSES, own, **conditions), count, seed, may_lack=True)


def exactly(**counts: int) -> Wishes:
    named = {label: counts.get(label, 0) for label in ("sofa", "box", "lamp")}
    return Wishes(tuple(CountWish(label, count, count) for label, count in named.items()))


def assert_same(some: PosedRooms, others: PosedRooms) -> None:
    assert some.is_object.any() and torch.equal(some.object_class, others.object_class)
    assert torch.equal(some.looks, others.looks)
    assert torch.equal(some.rectangle_m, others.rectangle_m)
    assert_close(some.boxes_m, others.boxes_m, atol=1e-4, rtol=0)


def test_a_seed_draws_the_same_rooms_the_first_of_them_however_many_follow(sampler):
    some, more = drawn(sampler, 9, 5).rooms, drawn(sampler, 20, 5).rooms
    assert_same(some, more.changed(lambda part: part[:9]))
    assert not torch.equal(drawn(sampler, 9, 6).rooms.boxes_m, some.boxes_m)


@pytest.mark.parametrize("wishes", [Wishes(), exactly(sofa=1, box=1)])
def test_batches_and_attempts_side_by_side_do_not_matter(sampler, monkeypatch, wishes):
    whole = drawn(sampler, 12, 1, wishes=wishes)
    monkeypatch.setattr(module, "BATCH", 5)
    assert_same(drawn(sampler, 12, 1, wishes=wishes).rooms, whole.rooms)
    monkeypatch.setattr(module, "PLAIN", module.PLAIN._replace(together=1))
    assert_same(drawn(sampler, 12, 1, wishes=wishes).rooms, whole.rooms)


@pytest.mark.parametrize("wishes", [Wishes(), exactly(sofa=1, box=1)])
def test_nothing_stands_in_what_it_may_not_or_sticks_out(sampler, wishes):
    rooms = drawn(sampler, 40, 3, "4x4", wishes=wishes).rooms
    assert not sampler.may_meet.any()
    first, second = torch.triu_indices(5, 5, 1)
    pairs = rooms.is_object[:, first] & rooms.is_object[:, second]
    a, b = rooms.boxes_m[:, first], rooms.boxes_m[:, second]
    shares = shared_extents(a, b).prod(-1) / torch.minimum(a[..., 3:].prod(-1), b[..., 3:].prod(-1))
    assert pairs.any() and shares[pairs].max() <= INTERSECTING + 1e-6
    outer = rectangles_of(rooms)[rooms.is_object.any(dim=1)]
    assert (outer[:, :2].abs() + outer[:, 2:] / 2).max() <= 2 + BEYOND_M + 1e-5


def test_objects_of_one_prototype_are_twins(sampler):
    """As large and as high, each in its own pose."""
    rooms, found = drawn(sampler, 60, 4, wishes=exactly(sofa=2, box=3)).rooms, 0
    for room in range(60):
        sizes: dict[int, list[list[float]]] = {}
        for item in rooms.is_object[room].nonzero()[:, 0].tolist():
            prototype, pose = divmod(int(rooms.looks[room, item]), POSES)
            x, height, z = rooms.boxes_m[room, item, 3:].tolist()
            bottom = float(rooms.boxes_m[room, item, 1]) - height / 2
            own = [z, height, x, bottom] if pose % 2 else [x, height, z, bottom]
            sizes.setdefault(prototype, []).append(own)
        for first, *others in sizes.values():
            found += len(others)
            assert all(own == pytest.approx(first, abs=1e-5) for own in others)
    assert found > 60


def test_a_plan_that_nothing_comes_of_is_replaced(sampler, monkeypatch):
    """The first plan leaves no room for anything; the second does."""
    kept, plans = module.plan_rooms, []

    def narrow(*given):
        plan = kept(*given)
        plans.append(plan)
        return plan._replace(pieces_m=plan.pieces_m * 0.001) if len(plans) == 1 else plan

    monkeypatch.setattr(module, "plan_rooms", narrow)
    rooms = drawn(sampler, 12, 7).rooms
    assert 1 < len(plans) <= PLAIN.attempts and rooms.is_object.any()


def test_rooms_that_leave_a_side_open_are_furnished_again_where_the_rectangle_was_drawn(
    sampler, monkeypatch
):
    rounds, kept = [], module._furnish

    def watched(sampler, conditions, plans, *rest):
        particles, best, missing = kept(sampler, conditions, plans, *rest)
        rounds.append((plans, particles, best))
        return particles, best, missing

    monkeypatch.setattr(module, "_furnish", watched)
    for floor in (None, "9x9"):
        rounds.clear()
        drawn(sampler, 60, 2, floor)
        plans, particles, best = rounds[0]
        gaps = gaps_m(particles.rooms, plans.rectangle_m[particles.room]).amax(dim=-1)
        wide = (particles.number > 0) & (gaps > module.OPEN_M)
        assert (wide.any() and (best < 0).all() != (best < 0).any()) or floor
        assert (best[wide] < 0).all() == (floor is None)


def test_what_never_finds_a_place_is_left_out_even_if_it_is_required(sampler):
    """In a strip of 30 cm nothing fits."""
    assert not drawn(sampler, 4, 0, "0.3x30").rooms.is_object.any()
    found = drawn(sampler, 2, 0, "0.3x30", wishes=exactly(sofa=2))
    assert not found.rooms.is_object.any() and found.missing == ((1, 1), (1, 1))
