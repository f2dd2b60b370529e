"""Homes that the package makes itself: a seed in, a folder in 3D-FRONT's on-disk format out."""

from pathlib import Path


def make_homes(out: Path, rooms: int, room_type: str, seed: int) -> None:
    """Write furnished homes and their furniture as 3D-FRONT and 3D-FUTURE lay them out.

        OUT/3D-FRONT/<house uid>.json
        OUT/3D-FUTURE-model/<jid>/raw_model.obj, OUT/3D-FUTURE-model/model_info.json
        OUT/splits/<room type>.csv    rows `<house uid>_<room instanceid>,train|test`

    The same arguments write the same bytes, and room k does not depend on `rooms`. The folder
    appears whole or not at all.

    Args:
        out: A folder that does not exist yet, or an empty one.
        rooms: How many rooms, at least 2; nine in ten are for training.
        room_type: "bedroom" or "living".
        seed: 0 or more.

    Raises:
        InputError: an argument is out of its range, or `out` holds files or cannot be written.
    """
    # Kept out of `import data_prep.homes`: the command line must answer at once.
    from data_prep.homes.make import write_homes

    write_homes(out, rooms, room_type, seed)


__all__ = ["make_homes"]
