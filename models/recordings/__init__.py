"""Recordings: measured or simulated motion with its commands, their schema, forms and checks."""
