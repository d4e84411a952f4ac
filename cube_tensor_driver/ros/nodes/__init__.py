"""The nodes, one per file.

Importing this package sets the number of threads of numpy's matrix products, which numpy reads when
it is loaded. Nodes are started as modules of this package, so this comes first.
"""

import os

# Products of 4096 rows are the first that OpenBLAS divides among threads, which then wait in a
# loop: a reconstruction of 4108 cubes at 100 Hz took 111 instead of 13 % of a core. A number that
# the user has set stays.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
