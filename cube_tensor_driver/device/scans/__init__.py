"""Samples of all links, counted and put together into scans."""
