"""Recordings as arrays, and what is wrong with them before any physics."""
