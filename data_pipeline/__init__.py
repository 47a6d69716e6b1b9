"""Meshes become captures, captures become shards, shards become batches."""
