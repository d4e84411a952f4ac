"""The source paper's experiments on a virtual bench: plates, rods, large deformation."""
