# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The page that `./cube view` serves: a skin in 3-D, its numbers and plots, tare, record, replay.

Only this folder imports viser, the library that shows the page. The arrays and meshes that are
drawn are computed in views/ and touch/surface.py. `scan` collects all values of one instant,
`update` computes what they put on the page, and `page` sends that to a browser at once.
"""
