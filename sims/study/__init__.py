"""The simulation study: methods trained on the same laws, compared with them, with its pages."""
