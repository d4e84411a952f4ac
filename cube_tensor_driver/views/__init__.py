"""How results are shown: the scene of a skin, pictures, and what commands print.

`scene` computes what a skin looks like, for RViz and for the browser. Nothing is measured here.
"""
