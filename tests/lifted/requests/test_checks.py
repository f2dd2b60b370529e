"""Requests are refused in one sentence, or the rooms drawn for them are as they say."""

import json
import math
from typing import Any

import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from references.requests import meets

import sceneprior
from sceneprior.core.errors import InputError
from sceneprior.core.scene import SceneObject, quarter_turned
from sceneprior.core.scene_json import scene_to_json
from sceneprior.lifted.requests.request import RoomRequest

CLASSES = ("double_bed", "nightstand", "desk", "chair")
OPENINGS = ("door", "window")
WORDS = ("no", "a", "two", "three")
TO_TARGET = ("beside", "in front of", "facing", "near", "far from")
SAID = {
    **{word: word for word in (*TO_TARGET, "in a corner")}, "at a wall": "against the wall",
}  # fmt: skip
FRONTED = {"in front of", "facing", "beside"}
pytestmark = pytest.mark.filterwarnings("ignore::sceneprior.core.errors.InputWarning")


@pytest.fixture(scope="module")
def prior() -> sceneprior.Prior:
    return sceneprior.load("procthor-bedroom")


@st.composite
def sentences(draw: st.DrawFn) -> tuple[str, list[tuple], list[tuple]]:
    """A sentence, the numbers that it asks for, and its relations."""
    phrases, counts, relations = [], [], []
    exact: dict[str, int] = {}
    for label in draw(st.lists(st.sampled_from(CLASSES + OPENINGS), max_size=4)):
        noun, number = label.replace("_", " "), draw(st.integers(0, 3))
        many = f"{noun}s" if number > 1 else noun
        form = draw(st.sampled_from(["", "", "at most", "at least", "the", "the n"]))
        words = f"{WORDS[number]} {many}"
        if form == "the n":
            number = max(number, 2)
            words = f"the {WORDS[number]} {noun}s"
        phrases.append(
            {"": words, "the n": words, "the": f"the {noun}"}.get(form, f"{form} {number} {many}")
        )
        if not form and number:
            exact[label] = exact.get(label, 0) + number
        least = {"at most": 0, "the": 1}.get(form, number)
        most = number if form == "at most" or (not form and not number) else math.inf
        counts.append((label, least, most))
        if label in OPENINGS or draw(st.booleans()):
            continue
        relation = draw(st.sampled_from([*SAID]))
        target = None
        phrases[-1] += f" {SAID[relation]}"
        if relation in TO_TARGET:
            fronted = relation in FRONTED - {"facing"}
            target = draw(st.sampled_from(CLASSES if fronted else CLASSES + OPENINGS))
            phrases[-1] += f" the {target.replace('_', ' ')}"
            counts.append((target, 1, math.inf))
        if relation == "beside" and (label, target) == ("nightstand", "double_bed"):
            event("nightstands beside a bed")
        needed = 1 if form == "at most" else 1 if form == "the" else max(number, 1)
        relations.append((label, relation, target, needed))
    counts += [(label, number, number) for label, number in exact.items()]
    return ", ".join(phrases), counts, relations


@st.composite
def requests(draw: st.DrawFn) -> tuple[dict[str, Any], list[tuple], list[tuple], dict[str, Any]]:
    """Arguments of `Prior.sample`, and what they mean."""
    want: Any
    want, counts, relations = draw(sentences())
    if draw(st.booleans()):
        bounds = draw(
            st.dictionaries(
                st.sampled_from(CLASSES + OPENINGS),
                st.tuples(st.sampled_from(["", ">=", "<="]), st.integers(0, 3)),
                max_size=3,
            )
        )
        counts = [
            (label, 0 if sign == "<=" else n, math.inf if sign == ">=" else n)
            for label, (sign, n) in bounds.items()
        ]
        names = ("subject", "relation", "target", "count")
        want = {label: f"{sign}{n}" for label, (sign, n) in bounds.items()}
        want["relations"] = [
            {k: part for k, part in zip(names, each, strict=True) if part} for each in relations
        ]
    asked, parts = {"want": want or None}, {}
    if draw(st.booleans()):
        x, z = parts["size"] = draw(st.sampled_from([(4.0, 3.0), (5.0, 5.0), (2.0, 2.5)]))
        asked["floor"] = f"{x:g}x{z:g}"
    if draw(st.booleans()):
        asked["ceiling_m"] = parts["ceiling_m"] = draw(st.sampled_from([1.0, 2.1, 2.6]))
    if draw(st.booleans()):
        parts["south"] = draw(st.sampled_from(OPENINGS))
        asked["openings"] = f"{parts['south']}@south"
    places = draw(
        st.lists(
            st.tuples(
                st.sampled_from([-40.0, -1.5, 0.0, 0.2]), st.just(0.3), st.sampled_from([-1.0, 0.5])
            ),
            max_size=2,
        )
    )
    if places:
        asked["objects"], parts["given"] = draw(st.sampled_from([0, 2])), places
    return asked, counts, relations, parts


@settings(max_examples=25, deadline=None, suppress_health_check=[*HealthCheck])
@given(requests(), st.booleans())
def test_a_room_is_as_its_request_says_or_the_request_is_refused(prior, request, cad):
    asked, counts, relations, parts = request
    if "objects" in asked:
        yaw = quarter_turned((1.6, 0.6, 2.0), asked["objects"])
        bed = SceneObject("double_bed", (0.0, 0.0, 0.0), (1.6, 0.6, 2.0), turned=yaw)
        asked = {**asked, "objects": [bed.moved(place) for place in parts["given"]]}
    try:
        (room,) = prior.sample(1, seed=0, cad=cad, **asked)
    except InputError as error:
        event("refused")
        return assert_sentence(str(error))
    event("drawn")
    written = json.loads(json.dumps(scene_to_json(room)))
    said = all(each["holds"] for each in room.extra.get("wishes", []) if "implied" not in each)
    assert said == meets(written, counts, relations, parts)


TOKENS = [
    "no", "a", "the", "two", "at most", "at least", "exactly", "some", "bed", "nightstands", "door",
    "windows", "in the north wall", "near", "facing", "it", "against the wall", "bedroom", "4x3 m",
    "-2", "٣", "²", "½", "5000000000", "9" * 30, "9" * 400, "4.5", "-4x-3", "x", ":", "desk: 2",
    "desk: >=" + "9" * 50, ",", "\0", "#", "1e9", "0x3",
]  # fmt: skip


@settings(max_examples=150, deadline=None)
@given(st.lists(st.sampled_from(TOKENS), max_size=12).map(" ".join) | st.text(max_size=40)
       | st.integers(1000, 6000).map(lambda n: "nightstand: " + "9" * n))  # fmt: skip
def test_no_text_ends_raw(text):
    known = ("double_bed", "nightstand", "desk")
    try:
        found = RoomRequest.of(want=text).conditions(known, "front3d_bedroom", 13)
    except InputError as error:
        return assert_sentence(str(error))
    assert all(low <= high for low, high in found.wishes.bounds.values())


@settings(max_examples=200, deadline=None)
@given(st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=9)
    | st.integers(1, 5000).map(lambda n: 10**n)
    | st.sampled_from([-1, "beside", "door", "double_bed", ">=2"]),
    lambda part: st.lists(part, max_size=4) | st.dictionaries(
        st.sampled_from(["subject", "relation", "target", "count", "relations", "door", "desk"]),
        part, max_size=4),
    max_leaves=12,
), st.sampled_from(["want", "openings", "floor", "ceiling_m", "objects"]))  # fmt: skip
def test_no_json_ends_raw(value, part):
    try:
        RoomRequest.of(**{part: value}).conditions(("double_bed", "desk"), "front3d_bedroom", 13)
    except InputError as error:
        assert_sentence(str(error))


@pytest.mark.parametrize(("text", "doors"), [
    ("the two doors and a desk near the door", [None, None]),
    ("a desk near the two doors", [None, None]),
    ("the two doors in the north wall", ["north", "north"]),
    ("two doors, the door in the north wall", [None, "north"]),
    ("a door in the north wall, a desk near the door in the north wall", ["north"]),
    ("a 4-x-3 m bedroom", []),
])  # fmt: skip
def test_all_doors_that_a_sentence_names_are_added(text, doors):
    found = RoomRequest.of(want=text).conditions(("desk",), "front3d_bedroom", 13)
    assert [each.wall for each in found.openings] == doors


def assert_sentence(text: str) -> None:
    assert len(text) < 1200 and "\n" not in text and text.rstrip(")").endswith((".", "?"))
