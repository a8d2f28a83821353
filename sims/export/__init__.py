"""Runs and recordings as MCAP files with Foxglove's well-known messages."""
