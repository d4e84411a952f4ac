"""Shapes for RViz and Foxglove, which the node `markers` publishes."""
