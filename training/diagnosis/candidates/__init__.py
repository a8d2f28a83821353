"""Structure without a name: what a wrench could depend on besides."""
