# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The ROS nodes, one per file.

Importing this package limits numpy's matrix products to one thread, through an environment variable
that numpy reads when it is imported. Nodes are started as modules of this package, so that Python
executes this file before any import of numpy.
"""

import os

# OpenBLAS (numpy's matrix library) divides products of matrices with 4096 or more rows among
# threads, which wait for work in a busy loop. With its default, the reconstruction of 4108 cubes at
# 100 Hz took 111 % of a CPU core instead of 13 %. A value that the user has set is kept.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
