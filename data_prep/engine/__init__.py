"""Plans, workers, shards and reports of preparing; knows no data set."""
