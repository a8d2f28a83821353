"""What a model is worth on data left out: scores, forecasts, a black-box rival."""
