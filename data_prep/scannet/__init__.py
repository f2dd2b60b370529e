"""ScanNet as a source of rooms: its raw scan folders (.sens, zips, JSON, PLY)."""
