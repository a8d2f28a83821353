"""Validation on held-out data: scores, forecasts, a black-box model to compare with."""
