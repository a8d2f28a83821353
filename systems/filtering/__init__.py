"""Estimation as pure functions: no Drake here, so a filter runs under jit, scan and vmap."""
