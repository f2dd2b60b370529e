"""Words of requests in English."""

NOUNS: dict[str, tuple[str, ...]] = {
    "bed": ("double_bed", "single_bed", "kids_bed", "bed"),
    "double bed": ("double_bed", "bed"), "queen bed": ("double_bed",), "king bed": ("double_bed",),
    "single bed": ("single_bed", "bed"), "twin bed": ("single_bed",),
    "kids bed": ("kids_bed",), "children bed": ("kids_bed",), "bunk bed": ("kids_bed",),
    "bedside table": ("nightstand", "night stand"), "bed side table": ("nightstand", "night stand"),
    "night table": ("nightstand", "night stand"),
    "nightstand": ("nightstand", "night stand"), "night stand": ("nightstand", "night stand"),
    "closet": ("wardrobe",), "armoire": ("wardrobe",), "couch": ("sofa",), "settee": ("sofa",),
    "sofa": ("sofa",), "lounge chair": ("armchair",), "easy chair": ("armchair",),
    "dining chair": ("chair",), "office chair": ("chair",), "desk chair": ("chair",),
    "dining table": ("table",), "side table": ("table",), "writing desk": ("desk",),
    "vanity": ("dressing_table", "dresser"), "bookcase": ("bookshelf",), "cupboard": ("cabinet",),
    "chest of drawers": ("cabinet", "dresser"), "dresser": ("dresser", "cabinet"),
    "sideboard": ("cabinet",), "tv cabinet": ("tv_stand",), "tv bench": ("tv_stand",),
    "tv unit": ("tv_stand",), "television stand": ("tv_stand",), "hanging lamp": ("pendant_lamp",),
    "chandelier": ("pendant_lamp", "ceiling_lamp"), "ceiling light": ("ceiling_lamp",),
    "lamp": ("ceiling_lamp", "pendant_lamp", "lamp"), "fridge": ("refridgerator",),
    "refrigerator": ("refridgerator",), "tv": ("television",), "tub": ("bathtub",),
}  # fmt: skip
"""Classes that a noun may mean; the first class that the prior draws is used."""
RELATION_WORDS = {
    "beside": "beside", "next to": "beside", "at the side of": "beside", "alongside": "beside",
    "in front of": "in front of", "before": "in front of", "facing": "facing",
    "that faces": "facing", "which faces": "facing", "that face": "facing", "face": "facing",
    "faces": "facing", "looking at": "facing", "at": "near", "under": "under",
    "below": "under", "beneath": "under", "underneath": "under", "near": "near", "near to": "near",
    "close to": "near", "by": "near", "far from": "far from", "far away from": "far from",
    "away from": "far from",
}  # fmt: skip
"""Relations to an object, a door or a window."""
ROOM_WORDS = {
    f"{word} {article} {noun}": relation
    for noun, relation, words in (
        ("wall", "at a wall", ("at", "against", "along", "on", "by")),
        ("corner", "in a corner", ("in", "at")),
    )
    for word in words
    for article in ("a", "the", "one")
}
"""Relations to the room."""
NUMBERS = {
    "no": 0, "zero": 0, "without": 0, "a": 1, "an": 1, "one": 1, "another": 1, "two": 2, "three": 3,
    "four": 4, "five": 5, "six": 6, "seven": 7, "eight": 8, "nine": 9, "ten": 10, "eleven": 11,
    "twelve": 12,
}  # fmt: skip
BOUNDS = {"at least": ">=", "at most": "<=", "no more than": "<=", "no fewer than": ">=",
          "up to": "<=", "exactly": ""}  # fmt: skip
WALL_WORDS = {
    f"{word} the {wall}{end}": wall
    for word in ("in", "on", "to", "at")
    for wall in ("north", "east", "south", "west")
    for end in (" wall", "")
}
"""Walls of doors and windows."""
ROOMS = {
    "bedroom": ("bedroom", "all"), "living room": ("living", "all"),
    "dining room": ("dining", "all"), "library": ("library", "all"),
    "kitchen": ("kitchen", "all"), "room": (),
}  # fmt: skip
"""Room types, each with the endings of the label sets that contain it; `room` matches any."""
FILLERS = (
    "and", "with", ",", ";", ".", ":", "but", "also", "then", "please", "i", "we", "want", "would",
    "like", "need", "give", "me", "us", "make", "draw", "is", "are", "be", "stands", "stand",
    "standing", "placed", "put", "that", "which", "there", "has", "have", "having", "containing",
    "should",
)  # fmt: skip
"""Words that are skipped."""
