"""Checks of recorded data, before anything is learned, judged or named from them."""
