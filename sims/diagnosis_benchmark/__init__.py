"""The benchmark of `diagnose` on cases with a known answer."""
