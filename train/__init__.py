"""Shards train networks."""
