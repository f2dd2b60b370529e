"""The `inspect` command: prints, draws and verifies the contents of a folder of shards."""
