"""States that were not recorded: a smoother over a model's dynamics."""
