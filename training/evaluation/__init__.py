"""Evaluation of models on held-out data and on laws."""
