"""Results of a diagnosis: causes, ratios, text, next experiments."""
