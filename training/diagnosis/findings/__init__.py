"""What a diagnosis says: causes, ratios, text, next experiments."""
