"""Selection of a set of causes: hypotheses, search, model selection, refits."""
