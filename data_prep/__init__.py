"""Raw data sets in, view shards out."""
