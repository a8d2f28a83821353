"""Which causes are there together: hypotheses, search, model selection, refits."""
