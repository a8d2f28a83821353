"""Where training starts from, its steps, its guards and its folder."""
