"""Nodes and messages: the only folder that publishes, subscribes or offers services.

Nodes are thin: parameters, topics and services here, the work in `core`, `device` and `bags`.
"""
