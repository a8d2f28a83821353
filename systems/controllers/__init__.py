"""Controllers by kind; what a controller is told when the estimate is lost."""
