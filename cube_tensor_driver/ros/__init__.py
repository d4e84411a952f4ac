"""Nodes and messages: the only folder that publishes, subscribes or offers services.

Nodes are thin: parameters, topics and services here, the work in `core`, `device` and `bags`.
"""

import os

# Products of 4096 rows are the first that OpenBLAS divides among threads, which then wait in a
# loop: a reconstruction of 4108 cubes at 100 Hz took 111 instead of 13 % of a core. numpy reads
# this when it is loaded, so it is set before; whoever has set it keeps his value.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
