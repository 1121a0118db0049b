"""A job becomes a dataset: who renders its shards, how they lie on disk, what is told about them."""
