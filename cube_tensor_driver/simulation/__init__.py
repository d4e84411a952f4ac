"""Simulated hubs: true stress fields in, bytes of the wire protocol out."""
