"""Training of the networks on the shards that `data_pipeline` writes."""
