"""Data: objects are captured from all viewpoints, captures are written as shards, and shards are read as batches."""
