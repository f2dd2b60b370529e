"""Checks the plausibility of focal lengths."""

import math

FIELD_OF_VIEW_DEG = (5.0, 160.0)
"""Plausible fields of view along an image's longer side, from a 400 mm lens to a fisheye."""


def odd_field_of_view(focal_px: float, image_size: tuple[int, int]) -> str:
    """Say why a focal length is implausible and what the cause may be; "" if it is plausible.

    Example: a focal length given as a fraction of the width.

        >>> odd_field_of_view(0.8, (480, 640)).partition(",")[0]
        'a focal length of 0.8 pixels in an image of 640 x 480 sees 180 degrees'
        >>> odd_field_of_view(600.0, (480, 640))
        ''
    """
    longer = max(image_size)
    seen = math.degrees(2 * math.atan(longer / 2 / focal_px))
    least, most = FIELD_OF_VIEW_DEG
    if least <= seen <= most:
        return ""
    guess = (
        "give that of this image, not of a larger one" if seen < least
        else "give pixels, not a share of the width or millimetres"
    )  # fmt: skip
    return (
        f"a focal length of {focal_px:g} pixels in an image of {image_size[1]} x {image_size[0]} "
        f"sees {seen:.3g} degrees, expected {least:g} to {most:g}; {guess}"
    )
