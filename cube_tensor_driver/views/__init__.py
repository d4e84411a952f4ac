"""How results are shown: the scene of a skin, pictures and terminal output.

`scene` says how a skin looks, for RViz and for the browser. Nothing is measured here.
"""
