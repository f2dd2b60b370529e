"""Instances and NYU40 ids against the rule, pixel by pixel."""

import numpy as np
import pytest

from data_prep.readers.nyu40 import NYU40, ids_and_classes
from data_prep.readers.scannet.labels import SHELL
from sceneprior.core.classes import STUFF, label_set
from sceneprior.core.errors import InputError


def test_the_label_set_of_scannet_is_spelled_like_these_names():
    assert set(label_set("scannet")[1:]) < set(NYU40) and len(set(NYU40)) == 40
    assert set(NYU40) > SHELL


def one_by_one(instances, semantics):
    """The rule as a loop: the most frequent class of each instance, the lowest id among equals."""
    classes = {}
    for instance in set(instances.ravel().tolist()) - {-1}:
        own = [max(int(s), 0) for s in semantics[instances == instance]]
        best = max(sorted(set(own)), key=own.count)
        classes[instance + 1] = NYU40[best - 1] if best else "void"
    ids, stuff = np.zeros_like(instances), np.zeros_like(instances)
    for place in np.ndindex(instances.shape):
        if instances[place] >= 0:
            number = instances[place] + 1
            ids[place] = 0 if classes[number] in SHELL else number
        else:
            kind = semantics[place]
            ids[place] = 0 if kind > 0 and NYU40[kind - 1] in SHELL else -1
        name = NYU40[semantics[place] - 1] if semantics[place] > 0 else ""
        stuff[place] = STUFF.index(name) if name in STUFF else 0
    return ids, {k: name for k, name in classes.items() if name not in SHELL}, stuff


def test_ids_and_classes_match_the_rule(numbers):
    for _ in range(20):
        instances = numbers.integers(-1, 6, (2, 5, 7))
        semantics = numbers.choice([-1, 0, 1, 2, 5, 11, 20, 40], (2, 5, 7))
        ids, classes, stuff = ids_and_classes(instances, semantics, "scene")
        expected = one_by_one(instances, semantics)
        np.testing.assert_array_equal(ids, expected[0])
        assert classes == expected[1]
        np.testing.assert_array_equal(stuff, expected[2])


def test_ids_of_other_images_are_refused():
    with pytest.raises(InputError, match="scene: a semantic id is 41, expected NYU40's 1 to 40"):
        ids_and_classes(np.zeros((1, 1), int), np.full((1, 1), 41), "scene")
    with pytest.raises(InputError, match="scene: an instance id is 70000, expected at most 65534"):
        ids_and_classes(np.full((1, 1), 70_000), np.zeros((1, 1), int), "scene")
