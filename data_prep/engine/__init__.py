"""Plans, workers, shards and reports of data preparation, independent of the data set."""
