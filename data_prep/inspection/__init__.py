"""What `inspect` prints, draws and verifies of a folder of shards."""
