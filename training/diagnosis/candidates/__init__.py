"""Unmodelled structure: groups of further regressors for the wrench."""
