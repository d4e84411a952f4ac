"""The page that `./cube view` serves: a skin in 3-D, its numbers and plots, tare, record, replay.

Only this folder imports viser. What is drawn is computed in views/scene.py and touch/surface.py,
which serve the other viewers too.
"""
