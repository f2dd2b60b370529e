"""3D boxes of tracked objects from masks and cameras alone, before any network is trained."""
