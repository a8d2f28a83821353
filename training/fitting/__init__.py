"""Starting model, training steps, non-finite checks and the run folder."""
