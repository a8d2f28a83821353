"""Checks of what a command promises, on cases whose answer is known."""
