"""Recordings as arrays, and checks of the data that need no model."""
