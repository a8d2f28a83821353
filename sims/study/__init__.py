"""The simulation study: methods trained on the same laws, judged against them, told in pages."""
