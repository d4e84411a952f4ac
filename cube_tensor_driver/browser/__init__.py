"""The page that `./cube view` serves: a skin in 3-D, its numbers and plots, tare, record, replay.

Only this folder imports viser, the library that shows the page. The arrays that are drawn are
computed in views/scene.py and touch/surface.py, which the markers for RViz use too.
"""
