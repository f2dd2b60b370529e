"""Boxes, visibility and tracks against small images painted by hand."""

import numpy as np

from sceneprior.core.observations import observe, pixel_counts


def paint(height, width, *rectangles):
    """Rectangles (id, x1, y1, x2, y2) painted in order."""
    image = np.zeros((height, width), dtype=np.uint16)
    for number, x1, y1, x2, y2 in rectangles:
        image[y1:y2, x1:x2] = number
    return image


def test_a_box_ends_at_the_outer_edge_of_its_last_pixel():
    seen = observe(paint(20, 40, (1, 4, 5, 14, 15))[None], [True])
    np.testing.assert_array_equal(seen.boxes, np.float32([[[4 / 40, 5 / 20, 14 / 40, 15 / 20]]]))
    assert seen.visible.tolist() == [[True]] and seen.mask_pixels.tolist() == [[100]]
    assert seen.instance_ids.dtype == np.uint8
    assert seen.boxes.dtype == np.float32 and seen.mask_pixels.dtype == np.int32


def test_four_pixels_are_too_narrow_and_five_are_not():
    images = np.stack(
        [
            paint(20, 40, (1, 0, 0, 4, 20), (2, 10, 0, 15, 5)),
            paint(20, 40, (1, 0, 0, 5, 20), (2, 10, 0, 30, 4)),
        ]
    )
    seen = observe(images, [True, True])
    assert seen.visible.tolist() == [[False, True], [True, False]]
    assert seen.mask_pixels.tolist() == [[0, 25], [100, 0]]
    assert (seen.boxes[0, 0] == 0).all() and (seen.boxes[1, 1] == 0).all()
    np.testing.assert_array_equal(seen.instance_ids, images)  # the pixels stay


def test_objects_never_visible_are_dropped_and_the_rest_renumbered():
    images = paint(20, 40, (1, 0, 0, 3, 3), (2, 10, 0, 20, 10), (4, 20, 0, 30, 10))[None]
    seen = observe(images, [True] * 4)
    assert seen.tracked.tolist() == [1, 3]
    assert set(np.unique(seen.instance_ids)) == {0, 1, 2}
    assert (seen.instance_ids[0, :10, 10:20] == 1).all()
    assert (seen.instance_ids[0, :10, 20:30] == 2).all()
    assert (seen.instance_ids[0, :3, :3] == 0).all()
    assert seen.boxes.shape == (1, 2, 4)


def test_void_is_no_object_and_hides_what_is_behind_it():
    images = paint(20, 40, (1, 0, 0, 20, 20), (2, 10, 0, 20, 20))[None]  # void in front
    seen = observe(images, [True, False])
    assert seen.tracked.tolist() == [0]
    assert (seen.instance_ids[0, :, 10:20] == 2).all() and not seen.instance_ids[0, :, 20:].any()
    assert seen.mask_pixels.tolist() == [[200]]
    assert seen.sides_clear.tolist() == [
        [[True, False, False, False]]
    ]  # void touches the corners, too
    np.testing.assert_array_equal(seen.boxes[0, 0], np.float32([0, 0, 0.25, 1]))


def test_boxes_are_tight_round_masks():
    rng = np.random.default_rng(1)
    image = np.kron(rng.integers(0, 4, (6, 8)), np.ones((7, 7), int)).astype(np.uint16)
    seen = observe(image[None], [True] * 3)
    for k in range(3):
        rows, columns = np.nonzero(image == k + 1)
        expected = np.float32(
            [columns.min() / 56, rows.min() / 42, (columns.max() + 1) / 56, (rows.max() + 1) / 42]
        )
        np.testing.assert_array_equal(seen.boxes[0, k], expected)
        assert seen.mask_pixels[0, k] == (image == k + 1).sum() == pixel_counts(image, 3)[k]
