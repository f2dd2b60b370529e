"""ScanNet's raw scan folders in (.sens, zips, JSON, PLY), labelled views of one room out."""
