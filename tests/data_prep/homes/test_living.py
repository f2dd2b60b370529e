"""Dining tables as they were arranged."""


def test_chairs_stand_by_their_tables(rooms):
    ringed = 0
    for room in rooms["living"]:
        dining = [p for p in room["pieces"] if p["class"] == "table" and p["footprint"].area > 0.5]
        chairs = [piece for piece in room["pieces"] if piece["class"] == "chair"]
        close = sum(
            any(c["footprint"].distance(t["footprint"]) < 0.15 for t in dining) for c in chairs
        )
        ringed += close >= 2
    assert ringed > 200
