"""Boxes, visibility and tracks against small images painted by hand."""

import numpy as np

from sceneprior.core.observations import observe, pixel_counts


def paint(height, width, *rectangles):
    """Rectangles (id, x1, y1, x2, y2) painted in order."""
    image = np.zeros((height, width), dtype=np.uint16)
    for number, x1, y1, x2, y2 in rectangles:
        image[y1:y2, x1:x2] = number
    return image


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
