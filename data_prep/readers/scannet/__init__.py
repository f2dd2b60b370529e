"""Source for ScanNet's raw scan folders (.sens, zips, JSON, PLY)."""
