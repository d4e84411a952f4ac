# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Elasticity of the elastomer around the cubes: a half space, or a layer bonded to rigid ground.

The modules compute the stress at the cubes under loads on the surface, and covariances of this
stress under random loads. influence.py holds the response of single pads, which finite elements
computed.
"""
